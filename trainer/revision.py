"""Which source made a result."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path

HERE = Path(__file__).parent
WRITTEN = ("results/paper",)
"""What the experiments write themselves. Human models, which decide trainings, count as source."""


@cache
def source_revision() -> str:
    """The repository's commit, ``-dirty`` where files differ from it, or ``unknown``.

    As it was when first asked for: what is committed later is not what this process runs. Results
    that a run has just written make no other source.
    """
    return revision_of(HERE)


def revision_of(directory: Path) -> str:
    """The revision of the repository that a directory belongs to, as it is now."""
    commit = _git(directory, "rev-parse", "HEAD")
    if commit is None:
        return "unknown"
    source = (":/", *(f":(top,exclude){path}" for path in WRITTEN))
    dirty = _git(directory, "diff", "--quiet", "HEAD", "--", *source) is None
    return f"{commit}-dirty" if dirty else commit


def _git(directory: Path, *arguments: str) -> str | None:
    """What git says; None where it fails."""
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=directory, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
