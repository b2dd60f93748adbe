"""The tables of results/README.md: where they stand, and the claims, made from the verdicts."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from edge_runtime.errors import UserError
from edge_runtime.files import read_bytes, write_atomic
from trainer.experiments.verdict import VERDICT_FILE

HEADER = ("what", "claim", "paper", "ours", "seeds", "holds", "command")


class Place(NamedTuple):
    """Where a table stands in ``results/README.md``: between two comments of Markdown."""

    what: str

    @property
    def begin(self) -> str:
        """The comment before it."""
        command = "`python -m trainer experiment summary`"
        return f"[//]: # (begin of the {self.what} that {command} writes)"

    @property
    def end(self) -> str:
        """The comment after it."""
        return f"[//]: # (end of the {self.what})"


UNITS, CLAIMS = Place("table of units"), Place("table of claims")


def has_place(readme: Path, place: Place) -> bool:
    """Whether there is a file with the comment before the table."""
    return readme.is_file() and place.begin in readme.read_text()


def write_table(readme: Path, place: Place, lines: Iterable[str]) -> None:
    """Replace a table for which the file has a place.

    Raises:
        UserError: the second comment is missing.
    """
    text = readme.read_text()
    before, _, rest = text.partition(place.begin)
    _, end, after = rest.partition(place.end)
    if not end:
        raise UserError(f"{readme} lacks the line {place.end!r} after {place.begin!r}")
    table = "\n".join(lines)
    write_atomic(readme, f"{before}{place.begin}\n\n{table}\n\n{place.end}{after}".encode())


def claim_lines(results: Path, names: Iterable[str]) -> list[str]:
    """The table of claims; an experiment that was never drawn has a row that says so.

    Args:
        results: directory with ``experiments/<name>/verdict.json``.
        names: experiments, in the order in which they are shown.

    Raises:
        UserError: a verdict cannot be read.
    """
    lines = [row(HEADER), row(["---"] * len(HEADER))]
    for name in names:
        verdict = _read(results / "experiments" / name / VERDICT_FILE)
        command = f"`python -m trainer experiment {name}`"
        if verdict is None:
            lines.append(row([name, "not run yet", "", "", "0", "undecided", command]))
            continue
        command = f"`{verdict['command']}`"
        link = f"[{name}](experiments/{name}/verdict.md)"
        for one in verdict["claims"]:
            cells = (one["text"], one["paper"], one["ours"], str(one["seeds"]), one["holds"])
            lines.append(row([link, *cells, command]))
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


def row(cells: Iterable[str]) -> str:
    """A row of a table in Markdown."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
