"""How an episode ended: the words for it, and what they mean."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

GOAL, FAILED, COLLISION = "goal", "failed", "collision"
UNKNOWN = "ended"  # The environment reports neither ``outcome`` nor ``is_success``
TRUNCATED = "truncated"  # Gymnasium's step limit ended an episode of UNKNOWN outcome
TIMEOUT = "timeout"  # The same, in an environment that reports other outcomes (`settled`)
STOPPED, RESTARTED = "stopped", "restarted"  # The person ended the episode
DISCARDED = "discarded"  # The person threw the episode away: it is shown and not learned from
UNTOLD = {UNKNOWN, TRUNCATED, STOPPED, RESTARTED, DISCARDED}
"""Outcomes that say nothing about success."""


def failed(outcome: str) -> bool:
    """Return whether an episode is known to have missed its goal."""
    return outcome != GOAL and outcome not in UNTOLD


def outcome_of(info: Mapping[str, Any], only_truncated: bool = False) -> str:
    """Return the outcome that the last step's ``info`` reports.

    Without a report: TRUNCATED where only a step limit ended the episode, else UNKNOWN.
    """
    if info.get("outcome"):
        return str(info["outcome"])
    success = info.get("is_success")
    if success is None:
        return TRUNCATED if only_truncated else UNKNOWN
    return GOAL if success else FAILED


def settled(outcomes: Iterable[str]) -> list[str]:
    """Return the outcomes, with TIMEOUT for TRUNCATED if any episode reports how it ended."""
    outcomes = list(outcomes)
    is_told = not UNTOLD.issuperset(outcomes)
    return [TIMEOUT if is_told and each == TRUNCATED else each for each in outcomes]
