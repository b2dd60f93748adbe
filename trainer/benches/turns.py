"""Contenders in turn within one run, so that the machine's noise hits all of them alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

Contender = Callable[[], Sequence[float]]
"""Works for a moment and gives the time of each piece of its work."""
Rounds = list[list[float]]
"""The times that one contender gave, round by round."""
Tick = Callable[[str], None]
"""Told what was done, once a round."""


class Ratio(NamedTuple):
    """How many times as long the peer takes; above 1 we are faster."""

    of_medians: float
    """Median of all the peer's times over the median of all of ours."""
    median_of_rounds: float
    """Median of each round's own ratio: what slows one whole round down cancels out."""


def take_turns(
    contenders: Mapping[str, Contender], rounds: int, tick: Tick = lambda done: None
) -> dict[str, Rounds]:
    """Each contender once a round, after one round that is not counted.

    Who begins a round ends the next one: nobody is always measured first.
    """
    names = list(contenders)
    times: dict[str, Rounds] = {name: [] for name in names}
    for name in names:
        contenders[name]()
    for number in range(rounds):
        first = number % len(names)
        for name in names[first:] + names[:first]:
            times[name].append(list(contenders[name]()))
        tick(" and ".join(names))
    return times


def median(rounds: Rounds) -> float:
    """Of all the times."""
    return float(np.median([time for times in rounds for time in times]))


def compare(ours: Rounds, peer: Rounds) -> Ratio:
    """Our times against a peer's of the same rounds."""
    each = [median([theirs]) / median([own]) for own, theirs in zip(ours, peer, strict=True)]
    return Ratio(median(peer) / median(ours), float(np.median(each)))
