"""A campaign's report: JSON, and beside it the same for people, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from edge_runtime.files import check_writable, write_atomic, write_json_out
from edge_runtime.util import UserError

MARKDOWN = ".md"


def check_report(out: Path) -> None:
    """Raise UserError now, before the long work, if `write_report` would fail after it."""
    if out.suffix == MARKDOWN:
        raise UserError(f"--out {out} is for the JSON; the Markdown is written beside it")
    check_writable(out)
    check_writable(out.with_suffix(MARKDOWN))


def write_report(out: Path, report: Mapping[str, Any], lines: Sequence[str]) -> None:
    """Write ``out`` and, with its ``lines``, the Markdown beside it."""
    write_json_out(out, report)
    text = "\n".join(lines).rstrip() + "\n"
    write_atomic(out.with_suffix(MARKDOWN), text.encode())
