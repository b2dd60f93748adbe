"""Steps a second of each scenario, with our picture and with highway-env's, in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainer.benches.effort import Effort
from trainer.benches.highway_picture import HighwayPicture, check_varies
from trainer.benches.turns import Contender, Rounds, Tick, compare, median, take_turns
from trainer.drivers import make_environment
from trainer.scenarios import SCENARIOS

OURS, HIGHWAY = "ours", "highway_env_grayscale"


class Drive:
    """Drives on where it stopped, episode after episode.

    Args:
        step: takes an action [n] and says whether the episode ended.
        reset: starts the episode with a seed.
        action_size: n.
    """

    def __init__(
        self,
        step: Callable[[NDArray[np.float32]], bool],
        reset: Callable[[int], Any],
        action_size: int,
    ) -> None:
        self._step, self._reset = step, reset
        # Equal seeds: all contenders drive the same episodes.
        self._random, self._size = np.random.default_rng(0), action_size
        self.episodes = 0
        reset(0)

    def run(self, steps: int) -> list[float]:
        """Seconds a step, resets included, under actions at random."""
        actions = self._random.uniform(-1, 1, (steps, self._size)).astype(np.float32)
        began_s = time.perf_counter()
        for action in actions:
            if self._step(action):
                self.episodes += 1
                self._reset(self.episodes)
        return [(time.perf_counter() - began_s) / steps]


def measure_environment(effort: Effort, tick: Tick) -> dict[str, Any]:
    """Each scenario's steps a second with observation, and its peer's."""
    return {name: _measure(name, effort, tick) for name in SCENARIOS}


def our_drive(scenario: str) -> Drive:
    """The scenario as it is."""
    env = make_environment(scenario)

    def step(action: NDArray[np.float32]) -> bool:
        _, _, terminated, truncated, _ = env.step(action)
        return terminated or truncated

    return Drive(step, lambda seed: env.reset(seed=seed), env.action_space.shape[0])


def highway_drive(scenario: str) -> Drive:
    """The same traffic in highway-env's picture."""
    env = make_environment(scenario)
    picture = HighwayPicture(env)
    check_varies(picture)
    return Drive(
        lambda action: picture.step(action)[1],
        lambda seed: picture.reset(seed=seed),
        env.action_space.shape[0],
    )


def summary(times_s: dict[str, Rounds]) -> dict[str, Any]:
    """Steps a second of ours and of the peer, and how many times as fast ours are."""
    ours, peer = times_s[OURS], times_s[HIGHWAY]
    ratio = compare(ours, peer)._asdict()
    return {
        "steps_per_s": 1.0 / median(ours),
        "peers": {HIGHWAY: {"steps_per_s": 1.0 / median(peer), "ratio": ratio}},
    }


def _measure(scenario: str, effort: Effort, tick: Tick) -> dict[str, Any]:
    drives = {OURS: our_drive(scenario), HIGHWAY: highway_drive(scenario)}
    steps = effort.steps_per_round
    contenders: dict[str, Contender] = {
        name: partial(drive.run, steps) for name, drive in drives.items()
    }
    times_s = take_turns(contenders, effort.environment_rounds, tick)
    return {
        "rounds": effort.environment_rounds,
        "steps_per_round": steps,
        **summary(times_s),
    }
