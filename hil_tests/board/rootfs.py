"""Debian in a folder, by debootstrap, with nothing of ours in it."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from edge_runtime.util import UserError

DEFAULT_CACHE = Path("build/board")
_LIMIT_S = 1800.0
_ENVIRONMENT = {"LC_ALL": "C", "PATH": os.defpath + ":/usr/sbin:/sbin"}


class Debian(NamedTuple):
    """A release of Debian for a processor, and what is installed beside the least of it."""

    suite: str
    architecture: str
    packages: tuple[str, ...]


AARCH64 = Debian("bullseye", "arm64", ("python3",))
"""The board's glibc 2.31, with Python 3.9."""
BOOTABLE = Debian("bookworm", "amd64", ("systemd-sysv", "dbus", "iproute2", "kmod"))
"""A systemd that this machine's processor runs by itself."""


def fresh_root(debian: Debian, folder: Path, cache: Path) -> float | None:
    """Lay a root file system into a folder.

    Args:
        debian: what is in it.
        folder: where it goes; absent or empty.
        cache: keeps the archive that debootstrap's work becomes, so that it works once.

    Returns:
        How long debootstrap took, s; None where the archive was there already.

    Raises:
        UserError: debootstrap failed, for instance without a network.
    """
    archive, took_s = cache / f"{debian.suite}-{debian.architecture}.tar", None
    if not archive.exists():
        took_s = _build(debian, archive)
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        ["tar", "--extract", "--numeric-owner", "--file", str(archive), "--directory", str(folder)],
        check=True,
    )
    return took_s


def _build(debian: Debian, archive: Path) -> float:
    """Bootstrap beside the archive, and give it its name when it is whole."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    draft = archive.with_name(f".{archive.name}.{os.getpid()}")
    root = draft.with_suffix(".root")
    begun_s = time.monotonic()
    try:
        _debootstrap(debian, root)
        took_s = time.monotonic() - begun_s
        left_out = ["./dev/*", "./proc/*", "./sys/*", "./debootstrap", "./var/cache/apt/archives/*"]
        subprocess.run(
            ["tar", "--create", "--numeric-owner", "--file", str(draft), "--directory", str(root),
             *(f"--exclude={each}" for each in left_out), "."],
            check=True,
        )  # fmt: skip
        draft.replace(archive)
    finally:
        shutil.rmtree(root, ignore_errors=True)
        draft.unlink(missing_ok=True)
    return took_s


def _debootstrap(debian: Debian, root: Path) -> None:
    """In a mount namespace of its own: what it mounts is gone with it, whatever happens."""
    done = subprocess.run(
        ["unshare", "--mount", "--pid", "--fork", "--kill-child", "debootstrap",
         f"--arch={debian.architecture}", "--variant=minbase",
         f"--include={','.join(debian.packages)}", debian.suite, str(root.resolve())],
        capture_output=True, text=True, check=False, timeout=_LIMIT_S, env=_ENVIRONMENT,
    )  # fmt: skip
    if done.returncode != 0:
        lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        raise UserError(f"debootstrap: {(lines or ['failed'])[-1]}")
