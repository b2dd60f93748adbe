"""Bundles for this computer that unpack in no time: the real edge runtime, borrowed libraries.

In place of 45 MB of wheels there is one that holds a path file and points at the libraries of the
Python that makes it. The rest is as in every bundle.
"""

from __future__ import annotations

import platform
import sys
import zipfile
from pathlib import Path

import numpy

from deploy.installer.verify import Target

HERE = Target(
    name="here",
    python=f"{sys.version_info[0]}.{sys.version_info[1]}",
    machine=platform.machine(),
    glibc="2.17",
)


def host_wheel(folder: Path) -> Path:
    """A wheel that holds a path file only."""
    path = folder / "host-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr("host.pth", f"{Path(numpy.__file__).parents[1]}\n")
    return path
