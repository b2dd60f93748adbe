"""The side-by-side table of results/README.md, made from the verdicts."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from edge_runtime.errors import UserError
from edge_runtime.files import read_bytes, write_atomic
from trainer.experiments.verdict import VERDICT_FILE

BEGIN = "[//]: # (begin of the table that `python -m trainer experiment summary` writes)"
END = "[//]: # (end of the table)"
"""Comments of Markdown; what stands between them is replaced."""
HEADER = ("what", "claim", "paper", "ours", "seeds", "holds", "command")


def write_summary(results: Path, names: Iterable[str]) -> bool:
    """Refresh the table in ``results/README.md``; whether the file has a place for it.

    Args:
        results: directory with ``experiments/<name>/verdict.json``.
        names: experiments, in the order in which they are shown.

    Raises:
        UserError: a verdict cannot be read, or the second comment is missing.
    """
    path = results / "README.md"
    if not path.is_file():
        return False
    text = path.read_text()
    if BEGIN not in text:
        return False
    before, _, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise UserError(f"{path} lacks the line {END!r} after {BEGIN!r}")
    table = "\n".join(summary_lines(results, names))
    write_atomic(path, f"{before}{BEGIN}\n\n{table}\n\n{END}{after}".encode())
    return True


def summary_lines(results: Path, names: Iterable[str]) -> list[str]:
    """The table: one row a claim, one that says so for an experiment that was never drawn."""
    lines = [_row(HEADER), _row(["---"] * len(HEADER))]
    for name in names:
        verdict = _read(results / "experiments" / name / VERDICT_FILE)
        command = f"`python -m trainer experiment {name}`"
        if verdict is None:
            lines.append(_row([name, "not run yet", "", "", "0", "undecided", command]))
            continue
        command = f"`{verdict['command']}`"
        link = f"[{name}](experiments/{name}/verdict.md)"
        for one in verdict["claims"]:
            cells = (one["text"], one["paper"], one["ours"], str(one["seeds"]), one["holds"])
            lines.append(_row([link, *cells, command]))
            link = command = ""
    return lines


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        verdict = json.loads(read_bytes(path, "verdict"))
        for one in verdict["claims"]:
            _ = [one[name] for name in ("text", "paper", "ours", "seeds", "holds")]
        _ = verdict["command"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no verdict of this project") from error
    return dict(verdict)


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
