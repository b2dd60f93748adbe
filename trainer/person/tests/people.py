"""People for tests: hands that follow a list, eyes that remember."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from trainer.drivers import make_environment
from trainer.person.interface import LET_GO, Person, Reading, View, Wish
from trainer.person.recording import Recorder
from trainer.person.sitting import Sitting

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
