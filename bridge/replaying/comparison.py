"""Recorded answers against replayed ones. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bridge.replaying.recorded import Answer, Exchange, Key
from edge_runtime.wire import SAFE_STOP

SHOWN_DIFFERENCES = 10


def compare(
    recorded: Mapping[Key, Exchange],
    replayed: Mapping[Key, Sequence[Answer]],
    states: Sequence[Key],
    tolerance: float,
) -> dict[str, Any]:
    """Return the part of the report that says what differs.

    ``states`` are the keys of all recorded states; those that nobody answered are counted, not
    compared. Two answers are equal where mode and reason are, and no action is further apart
    than ``tolerance``. A stop that goes on is repeated every T: whether that falls just before
    the next state or just after it, where it counts as an answer to that, is no difference.
    """
    answered = [key for key in states if key in recorded]
    kinds: dict[str, dict[str, int]] = {}
    differences: list[dict[str, Any]] = []
    largest = 0.0
    each_ours = _without_repetitions([recorded[key].answers for key in answered])
    each_theirs = _without_repetitions([replayed.get(key, []) for key in answered])
    for key, ours, theirs in zip(answered, each_ours, each_theirs, strict=True):
        same_shape, distance = _distance(ours, theirs)
        largest = max(largest, distance)
        row = kinds.setdefault(_kind(ours[-1]), {"compared": 0, "different": 0})
        row["compared"] += 1
        if not same_shape or distance > tolerance:
            row["different"] += 1
            differences.append(_describe(key, ours, theirs))
    return {
        "states": len(states),
        "compared": len(answered),
        "unanswered": len(states) - len(answered),
        "equal": len(answered) - len(differences),
        "different": len(differences),
        "largest_difference": largest,
        "tolerance": tolerance,
        "by_recorded": kinds,
        "first_differences": differences[:SHOWN_DIFFERENCES],
    }


def _without_repetitions(each: Sequence[Sequence[Answer]]) -> list[Sequence[Answer]]:
    """The answers to each state, without a first one that only repeats the stop before it."""
    kept: list[Sequence[Answer]] = []
    standing: Answer | None = None
    for answers in each:
        repeats = len(answers) > 1 and answers[0] == standing and standing.mode == SAFE_STOP
        kept.append(answers[1:] if repeats else answers)
        standing = answers[-1] if answers else None
    return kept


def _distance(ours: Sequence[Answer], theirs: Sequence[Answer]) -> tuple[bool, float]:
    """Whether modes, reasons and sizes agree, and how far apart the actions are at most."""
    same = len(ours) == len(theirs) and all(
        (one.mode, one.reason, len(one.action)) == (other.mode, other.reason, len(other.action))
        for one, other in zip(ours, theirs, strict=True)
    )
    apart = [
        abs(a - b)
        for one, other in zip(ours, theirs, strict=False)
        for a, b in zip(one.action, other.action, strict=False)
    ]
    return same, max(apart, default=0.0)


def _kind(answer: Answer) -> str:
    return f"{answer.mode}: {answer.reason}" if answer.reason else answer.mode


def _describe(key: Key, ours: Sequence[Answer], theirs: Sequence[Answer]) -> dict[str, Any]:
    session, episode, step = key
    return {
        "session": session,
        "episode": episode,
        "step": step,
        "recorded": [answer._asdict() for answer in ours],
        "replayed": [answer._asdict() for answer in theirs],
    }
