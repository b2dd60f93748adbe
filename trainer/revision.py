"""Which source made a result."""

from __future__ import annotations

import subprocess
from pathlib import Path


def source_revision() -> str:
    """The repository's commit, ``-dirty`` where files differ from it, or ``unknown``."""
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return described.stdout.strip()
