"""What an experiment says about the paper's claims, to be read by people and programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from edge_runtime.files import write_atomic, write_json
from trainer.experiments.gathered import Gathered
from trainer.experiments.statistics import Estimate, Holds

VERDICT_FILE, READABLE_FILE = "verdict.json", "verdict.md"
COLUMNS = ("claim", "paper", "ours", "what decides", "seeds", "holds", "decided by")
BAR = "bar of this project"
"""In the text of each claim that is this project's aim, not the paper's word."""


@dataclass(frozen=True)
class Claim:
    """One claim, and what we measured about it."""

    text: str
    """The paper's claim, or a bar of this project, quoted short."""
    paper: str
    """The paper's number; a dash where it gives none."""
    ours: str
    """Our number, in words."""
    holds: Holds
    seeds: int
    """Training seeds behind our number; the fewest, where several algorithms are compared."""
    rule: str
    """How it was decided."""
    decisive: float | None = None
    """The number that decides: a difference, a ratio or a value, as the rule says."""
    interval: tuple[float | None, float | None] | None = None
    """Its 95 % interval; None for an end that is infinite."""
    rival: str = ""
    """Whom or which pair it is about, where several are compared."""


def claim(
    text: str,
    paper: str,
    ours: str,
    holds: Holds,
    seeds: int,
    rule: str,
    decisive: Estimate | None = None,
    complete: bool = True,
    rival: str = "",
) -> Claim:
    """A claim; undecided wherever units are missing, whatever the numbers say so far."""
    value, interval = None, None
    if decisive is not None and decisive.size:
        value = decisive.value if math.isfinite(decisive.value) else None
        ends = [end if math.isfinite(end) else None for end in (decisive.low, decisive.high)]
        interval = (ends[0], ends[1]) if any(end is not None for end in ends) else None
    if not complete:
        holds, rule = "undecided", f"{rule}; units are missing"
    return Claim(text, paper, ours or "not measured", holds, seeds, rule, value, interval, rival)


@dataclass(frozen=True)
class Verdict:
    """An experiment's outcome."""

    name: str
    title: str
    claims: Sequence[Claim]
    wanted: int
    """Units that the experiment needs."""
    missing: Sequence[str]
    """Those that are not finished."""
    figure: str | None
    seeds: int

    @property
    def command(self) -> str:
        """What makes it."""
        return f"python -m trainer experiment {self.name} --seeds {self.seeds}"


def verdict_of(
    name: str, title: str, claims: Sequence[Claim], gathered: Gathered, figure: str
) -> Verdict:
    """The verdict of what was gathered."""
    missing = [str(unit) for unit in gathered.missing]
    return Verdict(name, title, claims, len(gathered.wanted), missing, figure, gathered.seeds)


def write_verdict(verdict: Verdict, directory: Path) -> None:
    """Write it as JSON and as Markdown."""
    write_json(directory / VERDICT_FILE, as_dict(verdict))
    write_atomic(directory / READABLE_FILE, markdown(verdict).encode())


def as_dict(verdict: Verdict) -> dict[str, Any]:
    """Plain values, for JSON."""
    return {**asdict(verdict), "command": verdict.command}


def markdown(verdict: Verdict) -> str:
    """The verdict as a page."""
    done = verdict.wanted - len(verdict.missing)
    lines = [f"# {verdict.name}: {verdict.title}", ""]
    if verdict.figure:
        lines += [f"![{verdict.title}]({verdict.figure})", ""]
    if verdict.wanted:
        lines += [f"{done} of {verdict.wanted} training runs and tests, {verdict.seeds} seeds.", ""]
    lines += [f"`{verdict.command}`", ""]
    lines += [f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    for one in verdict.claims:
        decided = decisive_text(asdict(one))
        cells = (one.text, one.paper, one.ours, decided, str(one.seeds), one.holds, one.rule)
        lines.append(f"| {' | '.join(map(_cell, cells))} |")
    if verdict.missing:
        lines += ["", "Missing:", "", *(f"- {unit}" for unit in verdict.missing)]
    return "\n".join(lines) + "\n"


def decisive_text(claim: Mapping[str, Any]) -> str:
    """The number that decides a claim, as kept in JSON, with its interval; a dash for none."""
    value = claim["decisive"]
    if value is None:
        return "–"
    low, high = claim["interval"] or (None, None)
    ends = (-math.inf if low is None else low, math.inf if high is None else high)
    number = Estimate(value, *ends, claim["seeds"]).text(3)
    return f"{number} ({claim['rival']})" if claim["rival"] else number


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
