"""aarch64 on this machine: qemu-user, made known to the kernel for as long as it is needed."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

_KERNEL = Path("/proc/sys/fs/binfmt_misc")
_NAME = "qemu-aarch64"
_DESCRIPTION = Path("/usr/lib/binfmt.d/qemu-aarch64.conf")
_PROGRAMS = {
    "debootstrap": "debootstrap",
    "qemu-aarch64-static": "qemu-user-static",
    "ip": "iproute2",
    "unshare": "util-linux",
    "nsenter": "util-linux",
}


def why_not() -> str:
    """What is missing to run an aarch64 root file system here; empty if nothing is."""
    if os.geteuid() != 0:
        return "a root file system needs root"
    for program, package in _PROGRAMS.items():
        if shutil.which(program) is None:
            return f"{program} is not there (Debian's package {package})"
    if not (_DESCRIPTION.exists() or _is_known()):
        return f"{_DESCRIPTION} is not there (Debian's package qemu-user-static)"
    try:
        with emulated():
            return ""
    except OSError as error:
        return f"the kernel takes no foreign programs: {error.strerror}"


@contextlib.contextmanager
def emulated() -> Iterator[None]:
    """Let the kernel start aarch64 programs through qemu; what was not so before is undone."""
    mounted = registered = False
    try:
        if not (_KERNEL / "register").exists():
            _mount()
            mounted = True
        if not _is_known():
            # F in its flags: the kernel opens qemu now, so no root file system need hold it.
            (_KERNEL / "register").write_text(_with_fix(_DESCRIPTION.read_text().strip()))
            registered = True
        yield
    finally:
        if registered:
            (_KERNEL / _NAME).write_text("-1")
        if mounted:
            subprocess.run(["umount", str(_KERNEL)], check=True)


def _is_known() -> bool:
    return (_KERNEL / _NAME).exists()


def _with_fix(description: str) -> str:
    """The flag F at its end, which some distributions leave out."""
    return description if "F" in description.rpartition(":")[2] else f"{description}F"


def _mount() -> None:
    command = ["mount", "-t", "binfmt_misc", "binfmt_misc", str(_KERNEL)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise OSError(done.returncode, f"binfmt_misc: {done.stderr.strip()}")
