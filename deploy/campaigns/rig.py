"""What the campaigns share: bundles to install, and a board that can lose its power."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from deploy.bundle import NAME, Inputs, build_installer, make_bundle
from deploy.campaigns.light import HERE, host_wheel
from deploy.installer.layout import LAUNCHER, POLICY, PUBLIC_KEY
from deploy.keys import write_key_pair
from deploy.wheels import ROOT, build_edge_wheel
from edge_runtime.errors import UserError
from edge_runtime.transport import free_endpoint

_POLICY = ROOT / "results/policies/left_turn.onnx"
_GONE_LIMIT_S = 20.0
_BUSY = "its inference takes"
"""`edge_runtime check` judges the time, too, and many things run on a machine that does this."""
_ATTEMPTS = 20


class Kit(NamedTuple):
    """Bundles that differ, the key to trust, and the Python that installs them."""

    bundles: list[Path]
    trust: Path
    python: str
    installer: Path


def make_kit(folder: Path) -> Kit:
    """Light bundles of the policy that comes with the repository, with different settings."""
    private, public = write_key_pair(folder / "keys")
    wheels = [build_edge_wheel(folder / "wheels"), host_wheel(folder)]
    paths = []
    for name in ("one", "two", "three"):
        config = folder / f"{name}.toml"
        config.write_text(f'connect = "{free_endpoint()}"\nlog_level = "warning"\n')
        inputs = Inputs(_POLICY, _POLICY.with_name("policy.pub"), private, config, None, wheels)
        paths.append(make_bundle(inputs, HERE, folder / name).path)
    return kit_of(paths, public, sys.executable, folder)


def kit_of(bundles: list[Path], trust: Path, python: str, folder: Path) -> Kit:
    """Bundles that are there already, with this checkout's installer.

    Raises UserError for a file or a Python that is not there.
    """
    for path in (*bundles, trust):
        if not path.is_file():
            raise UserError(f"file {path} does not exist")
    if shutil.which(python) is None:
        raise UserError(f"there is no {python} here; name another with --python")
    installer = folder / NAME
    installer.write_bytes(build_installer())
    return Kit(bundles, trust, python, installer)


def unless_busy(attempt: Callable[[], str]) -> str:
    """What an attempt complains of; again where it is only that this machine was too busy."""
    for _ in range(_ATTEMPTS):
        said = attempt()
        if _BUSY not in said:
            break
    return said


class Board:
    """A root of its own on this computer."""

    def __init__(self, root: Path, kit: Kit) -> None:
        self.root = root
        self.kit = kit

    def start(
        self, command: str, *arguments: object, prefix: Sequence[str] = ()
    ) -> subprocess.Popen[str]:
        """The installer as a process of its own, with its output."""
        line = [
            *prefix, self.kit.python, "-I", str(self.kit.installer), command,
            "--root", str(self.root), *map(str, arguments),
        ]  # fmt: skip
        return subprocess.Popen(
            line, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def run(self, command: str, *arguments: object, prefix: Sequence[str] = ()) -> tuple[int, str]:
        """Its exit status and all that it said."""
        process = self.start(command, *arguments, prefix=prefix)
        out, err = process.communicate()
        return process.returncode, out + err

    def start_install(self, bundle: Path) -> subprocess.Popen[str]:
        """Install or upgrade, with a service."""
        trust = ("--trust", self.kit.trust)
        return self.start("install", bundle, *trust, "--service", "process", "--settle", "0.2")

    def cut_power(self, installer: subprocess.Popen[str]) -> str:
        """Kill the installer and all that runs on the board; what it had said last."""
        os.killpg(installer.pid, signal.SIGKILL)
        out, _ = installer.communicate()
        end_s = time.monotonic() + _GONE_LIMIT_S
        while (left := self._processes()) and time.monotonic() < end_s:
            for pid in left:
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.02)
        lines = out.strip().splitlines()
        return lines[-1].split(" ")[0].rstrip(":") if lines else "verifying"

    def fault(self, versions: set[str]) -> str:
        """What is broken on the board; empty where it holds nothing, or one whole release."""
        if not (self.root / "current").is_symlink():
            return ""
        status, said = self.run("status", "--json")
        if status != 0:
            return said.strip()
        shown: dict[str, Any] = json.loads(said)
        if shown["current"] not in versions or shown["whole"] != "yes":
            return f"{shown['current']}: {shown['whole']}"
        return unless_busy(self._check)

    def _check(self) -> str:
        folder = (self.root / "current").resolve()
        done = subprocess.run(
            [folder / LAUNCHER, "check", POLICY, "--public-key", PUBLIC_KEY],
            cwd=folder, capture_output=True, text=True, check=False,
        )  # fmt: skip
        return done.stderr.strip() if done.returncode else ""

    def current(self) -> str:
        """The version that would start at boot; empty without one."""
        link = self.root / "current"
        return os.path.basename(os.readlink(link)) if link.is_symlink() else ""

    def _processes(self) -> list[int]:
        """Whatever still runs out of this root."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit() and int(entry.name) != os.getpid():
                try:
                    line = (entry / "cmdline").read_bytes()
                except OSError:
                    continue
                if f"{self.root}/".encode() in line or line.endswith(f"{self.root}\0".encode()):
                    found.append(int(entry.name))
        return found
