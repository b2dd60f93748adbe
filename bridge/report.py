"""Episode results, safe stops, and the report with the contract's keys (section 2)."""

from __future__ import annotations

import io
import math
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bridge.environments import finite
from bridge.inbound import BRAKE_PERIODS, NO_COMMAND, Decision
from bridge.outcomes import COLLISION, GOAL, is_told, settled, success_estimate
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError, counted, printable

ACCELERATIONS = ("lateral_acceleration_mps2", "longitudinal_acceleration_mps2")
QUANTITIES = {
    "surviving_distance_m": "distance_m",
    "episode_reward": "reward",
    "episode_time_s": "time_s",
    **{name: name for name in ACCELERATIONS},
}
"""Key of the report to field of `EpisodeResult`."""
DOTS_PER_INCH, KEPT_COLOURS = 110, 64  # Of a figure


@dataclass
class EpisodeResult:
    """One driven episode; `actions` holds the environment's action of each step.

    `outcome` is the contract's word, the environment's own, FAILED, TRUNCATED or UNKNOWN.
    Accelerations are the mean of |a| over the steps, None if unknown.
    """

    seed: int
    outcome: str = ""
    distance_m: float = 0.0
    reward: float = 0.0
    time_s: float = 0.0
    lateral_acceleration_mps2: float | None = None
    longitudinal_acceleration_mps2: float | None = None
    steps: int = 0
    actions: list[list[float]] = field(default_factory=list, repr=False)


def summarise(
    results: Sequence[EpisodeResult], scenario: str, condition: str, policy_id: str, seed: int
) -> dict[str, Any]:
    """Settle the outcomes of `results` and return the contract's summary.

    `std` is over the episodes (ddof 0). `mean` and `std` are None if no episode has the quantity.
    """
    for result, outcome in zip(results, settled(r.outcome for r in results), strict=True):
        result.outcome = outcome
    outcomes = Counter(result.outcome for result in results)
    told = is_told(outcomes)
    success = success_estimate(outcomes[GOAL], len(results)) if told else None
    columns = {key: [getattr(row, name) for row in results] for key, name in QUANTITIES.items()}
    return {
        "scenario": scenario,
        "condition": condition,
        "episodes": len(results),
        "success_rate": success and success.value,
        "success_interval": success and [success.low, success.high],
        "collision_rate": outcomes[COLLISION] / len(results) if told else None,
        **{
            key: {"mean": of_known(values), "std": of_known(values, np.std)}
            for key, values in columns.items()
        },
        "policy_id": policy_id,
        "seed": seed,
    }


def accelerations(info: Mapping[str, Any]) -> list[float | None]:
    """Return |a| of a step in the order of ACCELERATIONS; None where it is unknown."""
    values = (number_of(info, name) for name in ACCELERATIONS)
    return [None if value is None else abs(value) for value in values]


def number_of(info: Mapping[str, Any], name: str) -> float | None:
    """Return a number of a step's ``info``, None if missing; UserError if it is not finite."""
    value = info.get(name)
    return None if value is None else finite(name, value)


def of_known(values: Iterable[float | None], figure: Any = np.mean) -> float | None:
    known = [value for value in values if value is not None]
    return float(figure(known)) if known else None


@dataclass
class SafeStopEvent:
    """One unbroken stretch of braking; its fields are those of the report."""

    episode: int
    step: int  # The first tick in which the vehicle braked
    reason: str
    """``no_command`` if the simulator braked by itself, else the edge runtime's reason; with a
    vehicle in the loop also ``no_feedback`` and ``self_braking``."""


class SafeStopLog:
    """Collects the events of a whole run.

    The car also brakes after 2 T without the first command of an episode. If that command answers
    one of the first states, the braking was a round trip and is no stop.
    """

    def __init__(self) -> None:
        self.events: list[SafeStopEvent] = []
        self._open: SafeStopEvent | None = None
        self._episode, self._is_answered = -1, False

    def observe(self, episode: int, step: int, decision: Decision) -> None:
        if episode != self._episode:
            self._episode, self._open, self._is_answered = episode, None, False
        if decision.command is not None and not self._is_answered:
            self._is_answered = True
            waited = self._open is not None and self._open.reason == NO_COMMAND
            if waited and decision.command.step <= BRAKE_PERIODS:
                self.events.pop()
                self._open = None
        if not decision.brake_reason:
            self._open = None
        elif self._open is None:
            self._open = SafeStopEvent(episode, step, decision.brake_reason)
            self.events.append(self._open)


def percentiles(values: Sequence[float], **of: int) -> dict[str, float | None]:
    """Return percentiles by name, as in ``p50=50``; None each if there are no values."""
    return {
        name: float(np.percentile(values, p)) if len(values) else None for name, p in of.items()
    }


def make_report(
    results: Sequence[EpisodeResult],
    safe_stop_events: Sequence[SafeStopEvent],
    latencies_ms: Sequence[float],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Join the summary, the figures of the wire, and further rows (``facts``)."""
    policy_id = next(reversed(facts["policy_ids"]), "")
    summary = summarise(results, facts["scenario"], facts["condition"], policy_id, facts["seed"])
    return {
        **summary,
        "latency_ms": percentiles(latencies_ms, p50=50, p99=99, max=100),
        "answered_states": len(latencies_ms),
        **facts,
        "safe_stops": len(safe_stop_events),
        "safe_stop_events": [asdict(event) for event in safe_stop_events],
        "per_episode": [asdict(result) for result in results],
    }


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Iterator[str]:
    """Yield the lines of a Markdown table and an empty line; ``|`` in a cell becomes ``/``."""
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield f"| {' | '.join(str(cell).replace('|', '/') for cell in row)} |"
    yield ""


def summary_line(report: Mapping[str, Any]) -> str:
    latency, times = report["latency_ms"], "no command came"
    if latency["p50"] is not None:
        times = "latency p50 {p50:.1f} ms, p99 {p99:.1f} ms".format(**latency)
    outcomes = Counter(row["outcome"] for row in report["per_episode"])
    stops = Counter(event["reason"] for event in report["safe_stop_events"])
    return printable(
        f"{_reasons('episode', outcomes)}, return {report['episode_reward']['mean']:.1f}; {times};"
        f" {_reasons('safe stop', stops)}; {_reasons('rejected message', report['rejected'])}"
    )


def _reasons(noun: str, counts: Mapping[str, int]) -> str:
    each = ", ".join(f"{count} {reason}" for reason, count in counts.items() if count)
    return counted(sum(counts.values()), noun) + (f" ({each})" if each else "")


def write_figure(figure: Any, path: Path) -> None:
    """Write a figure of matplotlib as a PNG of few colours, which takes a third of the bytes."""
    if path.suffix != ".png":
        raise UserError(f"{path}: the file's name must end in .png")
    drawn, buffer = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DOTS_PER_INCH)
    picture = Image.open(drawn).convert("RGB").quantize(KEPT_COLOURS, dither=Image.Dither.NONE)
    picture.save(buffer, "png", optimize=True)
    write_atomic(path, buffer.getvalue())


LINE_INTERVAL_S = 15.0  # Between two lines of progress where stderr is no terminal


class ProgressBar:
    """Counts to ``total``, with figures such as ``{"success": "0.85"}``; lines on no terminal."""

    def __init__(self, what: str, total: int, done: int = 0) -> None:
        self.what, self.total, self.done = what, total, done
        self._line_s = time.monotonic()
        self._bar = Progress(
            *(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()),
            TextColumn("{task.fields[figures]}", markup=False),
            *(TextColumn("ETA"), TimeRemainingColumn()),
            speed_estimate_period=math.inf,  # One count may take hours.
            console=Console(stderr=True),
            disable=not sys.stderr.isatty(),
        )
        self._task = self._bar.add_task(what, total=total, completed=done, figures="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def advance(self, figures: dict[str, str], count: int = 1) -> None:
        self.done += count
        text = "  ".join(f"{name} {value}" for name, value in figures.items())
        self._bar.update(self._task, completed=self.done, figures=text)
        now_s = time.monotonic()
        is_due = now_s - self._line_s > LINE_INTERVAL_S or self.done >= self.total
        if self._bar.disable and is_due:
            self._line_s, left_s = now_s, self._bar.tasks[self._task].time_remaining
            left = f"{left_s / 60.0:.0f} min left  " if left_s else ""
            print(f"{self.what}: {self.done}/{self.total}  {left}{text}", file=sys.stderr)
