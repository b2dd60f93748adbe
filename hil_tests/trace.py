"""What a network did to each message of one drive: recorded, played again, and shrunk.

A trace names what is disturbed and nothing else: direction, control period in which the message
left its sender, and seconds under way (none: lost; two: it came twice). All others arrive at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, TypeVar

from bridge.network import DIRECTIONS, Direction, LatencySpec, Link, make_link
from bridge.report import GOAL, TIMEOUT, TRUNCATED, EpisodeResult
from trainer.evaluation import drive_episodes

Item = TypeVar("Item")
Trace = dict[str, dict[str, list[float]]]
"""Direction -> control period, as JSON has it -> seconds under way of that message."""
UNDISTURBED: Trace = {name: {} for name in DIRECTIONS}
ROUNDING = 1e-6  # Of a control period: a tick's time is a product


@dataclass
class _Way:
    """One direction: what is noted is played; what a source does, where there is one, is noted."""

    period_s: float
    noted: dict[str, list[float]]
    source: Direction | None

    def arrivals(self, now_s: float, size_bytes: int) -> tuple[float, ...]:
        """As `LatencyModel.arrivals`."""
        period = str(int(now_s / self.period_s + ROUNDING))
        if self.source is None:
            return tuple(now_s + late_s for late_s in self.noted.get(period, (0.0,)))
        times = self.source.arrivals(now_s, size_bytes)
        if times != (now_s,):
            self.noted[period] = [time_s - now_s for time_s in times]
        return times


def drive(
    env: Any, driver: Any, condition: str, seed: int, trace: Trace, spec: LatencySpec | None = None
) -> EpisodeResult:
    """Drive one episode behind a trace; with a network behind that, and the trace is filled."""
    drawn, period_s = spec and make_link(spec, seed), env.control_period_s
    ways = (_Way(period_s, trace[name], getattr(drawn, name, None)) for name in DIRECTIONS)
    return drive_episodes(env, driver, [seed], condition, latency=Link(*ways))[0]


def shrink(items: Sequence[Item], fails: Callable[[Sequence[Item]], bool]) -> list[Item]:
    """The items of a failure without those that it does not need: none can be left out alone.

    ddmin by complements (Zeller and Hildebrandt 2002, Simplifying and isolating failure-inducing
    input, IEEE Transactions on Software Engineering 28(2), section 3.1). ``fails`` says whether a
    part of the items, in their order, still fails; all of them do.
    """
    kept, parts = list(items), 2
    while len(kept) > 1:
        parts = min(parts, len(kept))
        cuts = [len(kept) * number // parts for number in range(parts + 1)]
        rests = (kept[:low] + kept[high:] for low, high in pairwise(cuts))
        rest = next((one for one in rests if fails(one)), None)
        if rest is None and parts == len(kept):
            break
        kept, parts = (kept, 2 * parts) if rest is None else (rest, max(parts - 1, 2))
    return kept


def failing_drive(
    env: Any, driver: Any, condition: str, spec: LatencySpec, seeds: Sequence[int]
) -> tuple[int, str, Trace] | None:
    """The first drive that the network alone makes fail: seed, network, what it disturbed."""
    for seed in seeds:
        whole: Trace = {name: {} for name in DIRECTIONS}
        behind = partial(drive, env, driver, condition, seed)
        if behind(UNDISTURBED).outcome != GOAL or behind(whole, spec).outcome == GOAL:
            continue
        if behind(whole).outcome != GOAL:  # No trace tells two of one period apart.
            return seed, str(spec), whole
    return None


def shrunk(
    env: Any, driver: Any, condition: str, seed: int, network: str, whole: Trace
) -> dict[str, Any]:
    """A failing drive with the fewest messages disturbed: what it is of, how it ends, its trace."""
    behind = partial(drive, env, driver, condition, seed)

    def part(items: Sequence[tuple[str, str]]) -> Trace:
        return {
            name: {period: whole[name][period] for way, period in items if way == name}
            for name in DIRECTIONS
        }

    disturbed = [(name, period) for name in DIRECTIONS for period in whole[name]]
    items = shrink(disturbed, lambda some: behind(part(some)).outcome != GOAL)
    result = behind(part(items))
    outcome = result.outcome.replace(TRUNCATED, TIMEOUT)  # Without a network it reached the goal.
    told = {"seed": seed, "network": network, "outcome": outcome, "steps": result.steps}
    return {**told, "disturbed": len(items), "disturbed_before": len(disturbed), **part(items)}
