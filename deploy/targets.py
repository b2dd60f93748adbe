"""The boards that bundles are made for: one row and one lock each."""

from __future__ import annotations

from pathlib import Path

from deploy.installer.manifest import Target
from edge_runtime.util import UserError

ROOT = Path(__file__).parents[1]
LOCKS = ROOT / "requirements"

TARGETS = {
    target.name: target
    for target in (
        # Jetson Xavier NX with JetPack 5: Ubuntu 20.04.
        Target(name="jetpack5", python="3.8", machine="aarch64", glibc="2.31"),
        # Debian bullseye.
        Target(name="linux-aarch64", python="3.9", machine="aarch64", glibc="2.31"),
        # The twin of jetpack5 on a workstation: the same versions of everything.
        Target(name="linux-x86_64", python="3.8", machine="x86_64", glibc="2.31"),
    )
}


def find_target(name: str) -> Target:
    """The row of a name. Raises UserError with the known ones."""
    if name not in TARGETS:
        raise UserError(f"target {name!r} is not known; choose from {', '.join(TARGETS)}")
    return TARGETS[name]


def lock_path(target: Target) -> Path:
    """The file that names every wheel of a target by version and hash."""
    return LOCKS / f"bundle-{target.name}.txt"
