"""Whether a bundle is for this computer: wheels for another one would fail late and strangely."""

from __future__ import annotations

import os
import platform
import sys

from deploy.installer.errors import UserError
from deploy.installer.manifest import Target


def check_fits(target: Target) -> None:
    """Raise UserError unless Python, processor and C library are what the wheels need."""
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if python != target.python:
        raise UserError(
            f"the bundle is for Python {target.python} and this is {python}:"
            f" run it with python{target.python}"
        )
    if platform.machine() != target.machine:
        raise UserError(f"the bundle is for {target.machine}, this is {platform.machine()}")
    name, _, version = (os.confstr("CS_GNU_LIBC_VERSION") or "another").partition(" ")
    if name != "glibc" or _numbers(version) < _numbers(target.glibc):
        raise UserError(f"the bundle needs glibc {target.glibc}, this is {name} {version}")


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".") if part.isdigit()]
