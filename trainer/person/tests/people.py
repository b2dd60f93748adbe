"""People for tests: hands that follow a list, eyes that remember; pedals, and whole episodes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from trainer.environments import make_environment
from trainer.person import Reading, View, Wish
from trainer.person.recording import RecordedStep, Recorder, packed
from trainer.person.session import Sitting

LET_GO = Reading()
QUICK = 1000.0
"""Simulated seconds in one of a test's."""


class Puppet:
    """A person who does what a list says, and then ``then`` for good; ``presence``: whether the
    device is there, each time it is asked for, and then for good."""

    def __init__(self, readings: Iterable[Reading] = (), then=LET_GO, presence=()) -> None:
        self._readings, self._then, self._presence = iter(readings), then, iter(presence)
        self.views: list[View] = []

    @property
    def present(self) -> bool:
        return next(self._presence, True)

    def poll(self, now_s: float) -> Reading:
        return next(self._readings, self._then)

    def show(self, view: View) -> None:
        self.views.append(view)

    def close(self) -> None:
        """Nothing to close."""


class Discarding(Puppet):
    """Holds full brake, and throws these episodes away: in the rest after their end."""

    def __init__(self, discarded: Iterable[int], episodes: int) -> None:
        super().__init__()
        self._discarded, self._episodes = set(discarded), episodes

    def poll(self, now_s: float) -> Reading:
        seen = self.views[-1]
        wishes: set[Wish] = set()
        if seen.message.startswith("episode"):
            wishes |= {"quit"} if seen.episode + 1 == self._episodes else set()
            wishes |= {"discard"} if seen.episode in self._discarded else set()
        return Reading(-1.0, engaged=True, wishes=frozenset(wishes))


def hold(action: float) -> Reading:
    return Reading(action, engaged=True)


def wish(*wishes) -> Reading:
    return Reading(wishes=frozenset(wishes))


QUIT = wish("quit")


def make_sitting(directory: Path, person: Any) -> Sitting:
    return Sitting(person, make_environment("left_turn"), Recorder(directory), QUICK)


def record(directory: Path, steps: Iterable[RecordedStep]) -> Path:
    recorder = Recorder(directory)
    for step in steps:
        recorder.write(step)
    recorder.close()
    return recorder.path


def pictures(value: int) -> bytes:
    """Two frames that are hard to compress, others for each value, as a step has them."""
    frames = [np.random.default_rng(each).integers(0, 255, (45, 80), np.uint8)
              for each in (value, value + 1)]  # fmt: skip
    return packed(np.stack(frames))


def recorded_step(sitting: int, index: int, **changes: Any) -> RecordedStep:
    """RecordedStep ``index`` of an episode that began with the sitting."""
    step = RecordedStep(
        sitting=sitting, index=index, scenario="left_turn", seed=1, episode=0, step=index,
        time_ns=10**9 + index * 10**8, time_s=0.1 * index,
        seen=pictures(index), seen_next=pictures(index + 1),
        policy_action=0.25, human_action=-0.5, action=0.25, control="policy",
        human=False, first=False, reward=float(index), terminated=False, truncated=False,
        speed_mps=3.0,
    )  # fmt: skip
    return structs.replace(step, **changes)


FULL, NOTHING, BRAKE = (np.array([pedal], np.float32) for pedal in (1.0, 0.0, -1.0))


def episode(env, driver, seed=None):
    """The action, reward and info of each step with a driver, a function of the picture or one
    action throughout; without a seed it begins where the car is."""
    act = getattr(driver, "act", driver if callable(driver) else lambda _: driver)
    observation = env.frames if seed is None else env.reset(seed=seed)[0]
    ended = False
    while not ended:
        action = act(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        assert terminated == (info.get("outcome") in ("goal", "collision", "off_road"))
        ended = terminated or truncated
        yield action, reward, info


def drive(env, driver, seed=0):
    """The rewards of an episode, and its last info."""
    _, rewards, infos = zip(*episode(env, driver, seed), strict=True)
    return list(rewards), infos[-1]
