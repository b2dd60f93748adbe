"""What was seen and when, in monotonic seconds, and the questions a fault asks of it. Pure.

The monotonic clock is one for all processes of a machine, so the times of the probe, of the edge
runtime's log and of the simulated vehicle can be taken from one another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np

from edge_runtime.wire import CONTROL_PERIOD_S, DRIVE, SAFE_STOP

REACTION_LIMIT_S = 2 * CONTROL_PERIOD_S + 0.05
"""After the last good state a safe stop is out, or the other end brakes by itself."""
RECOVERY_LIMIT_S = 1.0
"""From the end of the fault to the first drive command, with no vehicle attached."""

Place = tuple[str, int, int]
"""Session, episode and step of a state."""
E = TypeVar("E")


class CommandSeen(NamedTuple):
    """A command that reached the probe; ``sent_s`` by the edge's wall clock, made monotonic."""

    seen_s: float
    sent_s: float
    place: Place
    mode: str
    action: list[float]
    reason: str


class ModeSeen(NamedTuple):
    """A change of mode in the edge runtime's log."""

    seen_s: float
    mode: str
    reason: str


class BrakeSeen(NamedTuple):
    """The simulated vehicle's brake, pressed or released."""

    seen_s: float
    pressed: bool


@dataclass
class Timeline:
    """Events in order of arrival. Threads only append; a reader sees whole entries."""

    states: dict[Place, float] = field(default_factory=dict)
    """When the probe saw each acceptable state."""
    flow_s: list[float] = field(default_factory=list)
    """When the states of the drive itself came: gaps in it are the machine's, or the fault's."""
    commands: list[CommandSeen] = field(default_factory=list)
    modes: list[ModeSeen] = field(default_factory=list)
    brakes: list[BrakeSeen] = field(default_factory=list)
    feedback_s: list[float] = field(default_factory=list)
    named: list[tuple[float, str]] = field(default_factory=list)
    """When the feedback said what was wrong with the vehicle."""
    unreadable: int = 0
    """Commands that no receiver would take: outside their limits, or no commands at all."""


def first(events: Iterable[E], wanted: Callable[[E], bool]) -> E | None:
    """The first event of that kind."""
    return next((event for event in events if wanted(event)), None)


def last_drive_s(timeline: Timeline) -> float:
    """When the newest drive command came; -inf before the first."""
    times = (c.seen_s for c in reversed(timeline.commands) if c.mode == DRIVE)
    return next(times, float("-inf"))


def unsafe_commands(
    commands: Iterable[CommandSeen],
    states: Mapping[Place, float],
    low: float = -1.0,
    high: float = 1.0,
    by_arrival: bool = False,
) -> list[str]:
    """Why each unsafe command is one; empty where all is well.

    A ``drive`` is unsafe outside its limits, in answer to a state that nobody sent or that was
    to be rejected, and later than the reaction limit after the state that it answers.
    ``by_arrival`` takes the probe's time in place of the edge's clock, where that was stepped.
    """
    found = []
    for command in commands:
        if command.mode != DRIVE:
            continue
        state_s = states.get(command.place)
        if not all(low <= value <= high for value in command.action):
            found.append(f"{command.place}: action {command.action}")
        elif state_s is None:
            found.append(f"{command.place}: answers no acceptable state")
        else:
            age_s = (command.seen_s if by_arrival else command.sent_s) - state_s
            if age_s > REACTION_LIMIT_S:
                found.append(f"{command.place}: its state was {age_s:.3f} s old")
    return found


def longest_gap_s(times_s: Iterable[float], begin_s: float, end_s: float) -> float:
    """The longest stretch within [begin, end] without an event."""
    inside = [begin_s, *sorted(t for t in times_s if begin_s < t < end_s), end_s]
    return max(after - before for before, after in pairwise(inside))


def stops_between(commands: Iterable[CommandSeen], begin_s: float, end_s: float) -> list[str]:
    """A line for each reason of the safe stops in between, where the drive was to go on."""
    seen = [c for c in list(commands) if begin_s < c.seen_s < end_s and c.mode == SAFE_STOP]
    return [f"safe stop: {reason}" for reason in dict.fromkeys(c.reason for c in seen)]


def spread_ms(values_s: Iterable[float]) -> dict[str, float] | None:
    """Minimum, median and maximum in ms; None of nothing."""
    values = np.array(list(values_s)) * 1e3
    if not values.size:
        return None
    return {
        "min": round(float(values.min()), 1),
        "median": round(float(np.median(values)), 1),
        "max": round(float(values.max()), 1),
    }
