"""People for tests: hands that follow a list, eyes that remember."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from trainer.drivers import make_environment
from trainer.person.interface import LET_GO, Person, Reading, View, Wish
from trainer.person.recording import Recorder, Step
from trainer.person.session import Sitting

QUICK = 1000.0
"""Simulated seconds in one of a test's."""


class Hands:
    """Reads off a list, and then nothing more, or ``quit``."""

    help = ("a test",)

    def __init__(self, readings: Iterable[Reading], then: Reading = LET_GO) -> None:
        self._readings, self._then = iter(readings), then
        self.present, self.closed = True, False

    def poll(self, now_s: float) -> Reading:
        return next(self._readings, self._then)

    def close(self) -> None:
        self.closed = True


class Discarding:
    """Hands that hold full brake, and throw these episodes away: in the rest after their end."""

    help, present = ("a test",), True

    def __init__(self, eyes: Eyes, discarded: Iterable[int], episodes: int) -> None:
        self._eyes, self._discarded, self._episodes = eyes, set(discarded), episodes

    def poll(self, now_s: float) -> Reading:
        seen = self._eyes.views[-1]
        ended = seen.message.startswith("episode")
        wishes: set[Wish] = set()
        if ended and seen.episode + 1 == self._episodes:
            wishes.add("quit")
        if ended and seen.episode in self._discarded:
            wishes.add("discard")
        return Reading(-1.0, engaged=True, wishes=frozenset(wishes))

    def close(self) -> None:
        """Nothing to close."""


class Eyes:
    """Remember every view."""

    def __init__(self) -> None:
        self.views: list[View] = []

    def show(self, view: View) -> None:
        self.views.append(view)

    def close(self) -> None:
        """Nothing to close."""


def hold(action: float) -> Reading:
    """The person holds, and says so."""
    return Reading(action, engaged=True)


def wish(*wishes) -> Reading:
    """The person wishes something, and holds nothing."""
    return Reading(wishes=frozenset(wishes))


QUIT = wish("quit")


def make_sitting(
    directory: Path, readings: Iterable[Reading], alone: bool = False, then: Reading = QUIT
) -> tuple[Sitting, Eyes]:
    """A quick sitting in the left turn of a person who does what the list says, then ``then``."""
    eyes = Eyes()
    person = Person(Hands(readings, then), eyes)
    env = make_environment("left_turn")
    return Sitting(person, Recorder(directory), env, alone, QUICK), eyes


def picture(value: int) -> bytes:
    """A frame that is hard to compress, a different one for each value."""
    return np.random.default_rng(value).integers(0, 255, (45, 80), np.uint8).tobytes()


def recorded_step(sitting: int, index: int, **changes: Any) -> Step:
    """Step ``index`` of an episode that began with the sitting."""
    values: dict[str, Any] = {
        "sitting": sitting,
        "index": index,
        "scenario": "left_turn",
        "seed": 1,
        "episode": 0,
        "step": index,
        "time_ns": 10**9 + index * 10**8,
        "time_s": 0.1 * index,
        "frames": picture(index) + picture(index + 1),
        "next_frame": picture(index + 2),
        "policy_action": 0.25,
        "human_action": -0.5,
        "action": 0.25,
        "control": "policy",
        "human": False,
        "first": False,
        "reward": float(index),
        "terminated": False,
        "truncated": False,
        "speed_mps": 3.0,
    }
    return Step(**{**values, **changes})
