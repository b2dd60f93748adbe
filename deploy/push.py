"""``python -m deploy push HOST``: a bundle onto a board, over the system's ssh and scp.

The installer that runs there is this workstation's own, not the bundle's: what verifies the bundle
must not come out of it.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

from deploy.bundle import NAME, build_installer
from deploy.installer.layout import DEFAULT_ROOT
from deploy.installer.systemd import WAYS
from deploy.installer.verify import Manifest, read_bundle, read_public_key
from edge_runtime.cli import examples
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError

_UNATTENDED = ("-o", "BatchMode=yes", "-o", "ConnectTimeout=10")
"""A password asked for in the middle would hang a script, and so would a board without power."""
SSH, SCP = ("ssh", *_UNATTENDED), ("scp", "-q", "-p", *_UNATTENDED)
_HOST = re.compile(r"([A-Za-z0-9_][A-Za-z0-9_.-]*@)?[A-Za-z0-9\[][A-Za-z0-9_.:\]-]*")
_TRUST, _BUNDLE = "trust.pub", "bundle.tar"
"""Names over there, whatever the files are called here: a bundle may be called `install.pyz`."""
_SSH_FAILED = 255  # ssh's own status; any other is that of the command over there


class Step(NamedTuple):
    """One command on the workstation, and what it is for."""

    why: str
    command: list[str]


EXAMPLE = examples(
    "python -m deploy push user@board phil-jetpack5-1.tar --trust keys/policy.pub --dry-run",
    "python -m deploy push root@10.0.0.7 phil-jetpack5-1.tar --no-sudo --service systemd",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    trust = "public half of the key that signed the bundle; a new board will trust it"
    key, add = str(DEFAULT_PUBLIC_KEY), parser.add_argument
    add("host", metavar="HOST", help="[user@]name, as ssh knows it")
    add("bundle", metavar="BUNDLE.tar", help="of `python -m deploy bundle`")
    add("--trust", metavar="KEY.pub", default=key, help=trust)
    add("--root", metavar="DIR", default=DEFAULT_ROOT, help="where on the board")
    add("--service", choices=WAYS, help="who runs it there")
    add("--no-sudo", action="store_true", help="the user there needs no sudo")
    add("--dry-run", action="store_true", help="print each step and do nothing")


def run(arguments: argparse.Namespace) -> int:
    """Copy, install, and clean up; the installer's exit status."""
    if not _HOST.fullmatch(arguments.host):
        raise UserError(f"host {arguments.host!r} is not valid: write name or user@name")
    # What the board would refuse is not sent.
    key = read_public_key(arguments.trust)
    manifest = read_bundle(arguments.bundle, key).manifest
    with tempfile.TemporaryDirectory() as place:
        files = {name: Path(place) / name for name in (NAME, _TRUST)}
        files[NAME].write_bytes(build_installer())
        files[_TRUST].write_bytes(key)
        # Absolute: scp would take "a:b" for a file of the host a.
        files[_BUNDLE] = Path(arguments.bundle).absolute()
        files[f"{_BUNDLE}.sig"] = Path(f"{files[_BUNDLE]}.sig")
        probe, *copying, install, tidy = steps = _steps(arguments, manifest, files)
        if arguments.dry_run:
            for step in steps:
                print(f"# {step.why}\n{shlex.join(step.command)}")
            return 0
        _expect(probe)
        try:
            for step in copying:
                _expect(step)
            return _call(install)
        finally:
            # Whatever came of it: half a bundle may hold the vehicle's private key, too.
            _call(tidy)


def _steps(arguments: argparse.Namespace, manifest: Manifest, files: dict[str, Path]) -> list[Step]:
    """The probe, the copies of `files` by their names over there, the installation, the tidying."""
    target, folder = manifest.target, f"phil-push-{manifest.version}"
    python = f"python{target.python}"
    probe = (
        f"{python} -c 'import platform, sys;"
        f' sys.exit(platform.machine() != "{target.machine}" and'
        f' "this board is " + platform.machine() + ", the bundle is for {target.machine}")\''
    )
    install = [
        *([] if arguments.no_sudo else ["sudo", "-n"]),
        python, f"{folder}/{NAME}", "install", f"{folder}/{_BUNDLE}",
        "--trust", f"{folder}/{_TRUST}", "--root", arguments.root,
        *(["--service", arguments.service] if arguments.service else []),
    ]  # fmt: skip
    ssh = [*SSH, re.sub(r"[\[\]]", "", arguments.host)]  # Only scp wants an address in brackets.
    return [
        Step(f"has it Python {target.python} on {target.machine}?", [*ssh, probe]),
        Step("a folder of its own there", [*ssh, f"umask 077 && mkdir -p {folder}"]),
        *(
            Step(f"{name} into it", [*SCP, str(path), f"{arguments.host}:{folder}/{name}"])
            for name, path in files.items()
        ),
        Step("install", [*ssh, shlex.join(install)]),
        Step("leave nothing behind", [*ssh, f"rm -rf {folder}"]),
    ]


def _expect(step: Step) -> None:
    status = _call(step)
    if status == _SSH_FAILED:
        raise UserError(f"{step.command[0]} does not reach the board; its own line above says why")
    if status != 0:
        raise UserError(f"{step.command[0]} ended with status {status}: {step.why}")


def _call(step: Step) -> int:
    print(f"# {step.why}", flush=True)
    try:
        return subprocess.run(step.command, stdin=subprocess.DEVNULL, check=False).returncode
    except FileNotFoundError:
        raise UserError(f"{step.command[0]} is not installed here") from None
