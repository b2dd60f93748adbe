"""The tables of results/README.md: where they stand, and the two made from the verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from edge_runtime.errors import UserError
from edge_runtime.files import read_json, write_atomic
from trainer.experiments.catalogue import OURS
from trainer.experiments.statistics import Holds
from trainer.experiments.verdict import BAR, VERDICT_FILE, decisive_text

CLAIMS_HEADER = ("what", "claim", "paper", "ours", "what decides", "seeds", "holds")
ANSWERS: tuple[Holds, ...] = ("yes", "no", "undecided")
COUNTS_HEADER = ("experiment", "about", "runs", *ANSWERS, "command")
NOT_RUN = "not run yet"
PAPERS, BARS, OWN = "what the paper says", "bars of this project", "experiments of our own"
"""Whose a claim is."""


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


UNITS, CLAIMS, COUNTS = (Place(f"table of {what}") for what in ("units", "claims", "experiments"))


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


def count_lines(results: Path, names: Iterable[str]) -> list[str]:
    """The table of experiments: how many of each one's claims hold, and the command that says so;
    below, how many of the paper's, of this project's bars and of its own experiments'.

    Args:
        results: directory with ``experiments/<name>/verdict.json``.
        names: experiments, in the order in which they are shown.

    Raises:
        UserError: a verdict cannot be read.
    """
    lines = [row(COUNTS_HEADER), row(["---"] * len(COUNTS_HEADER))]
    totals = {kind: Counter[str]() for kind in (PAPERS, BARS, OWN)}
    for name, verdict in _verdicts(results, names):
        if verdict is None:
            dashes = "–" * (1 + len(ANSWERS))
            lines.append(row([name, NOT_RUN, *dashes, f"`python -m trainer experiment {name}`"]))
            continue
        counts = Counter(one["holds"] for one in verdict["claims"])
        for one in verdict["claims"]:
            totals[_whose(name, one["text"])][one["holds"]] += 1
        cells = (
            _link(name),
            verdict["title"],
            _runs(verdict),
            *_counted(counts),
            f"`{verdict['command']}`",
        )
        lines.append(row(cells))
    everything = sum(totals.values(), Counter[str]())
    lines.append(row(["all", "", "", *_counted(everything), "`python -m trainer experiment all`"]))
    return [*lines, *(row(["", kind, "", *_counted(totals[kind]), ""]) for kind in totals)]


def _whose(name: str, text: str) -> str:
    if BAR in text:
        return BARS
    return OWN if name in OURS else PAPERS


def claim_lines(results: Path, names: Iterable[str]) -> list[str]:
    """The table of claims; an experiment that was never drawn has a row that says so.

    Arguments and errors as for ``count_lines``.
    """
    lines = [row(CLAIMS_HEADER), row(["---"] * len(CLAIMS_HEADER))]
    for name, verdict in _verdicts(results, names):
        if verdict is None:
            lines.append(row([name, NOT_RUN, "", "", "", "0", "undecided"]))
            continue
        link = _link(name)
        for one in verdict["claims"]:
            decided = decisive_text(one)
            cells = (one["text"], one["paper"], one["ours"], decided, str(one["seeds"]))
            lines.append(row([link, *cells, one["holds"]]))
            link = ""
    return lines


def _link(name: str) -> str:
    return f"[{name}](experiments/{name}/verdict.md)"


def _runs(verdict: Mapping[str, Any]) -> str:
    wanted = verdict["wanted"]
    return f"{wanted - len(verdict['missing'])} of {wanted}" if wanted else "–"


def _counted(counts: Counter[str]) -> list[str]:
    return [str(counts[answer]) for answer in ANSWERS]


def _verdicts(results: Path, names: Iterable[str]) -> Iterator[tuple[str, dict[str, Any] | None]]:
    for name in names:
        yield name, _read(results / "experiments" / name / VERDICT_FILE)


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        verdict = read_json(path, "verdict")
        for one in verdict["claims"]:
            _ = (
                decisive_text(one),
                [one[key] for key in ("text", "paper", "ours", "seeds", "holds")],
            )
        _ = [verdict[name] for name in ("title", "wanted", "missing", "command")]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no verdict of this project") from error
    return dict(verdict)


def row(cells: Iterable[str]) -> str:
    """A row of a table in Markdown."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
