"""Environments with one oddity each, of the trainer's tests. Importing this registers them."""

import os
from typing import Any

import numpy as np

from bridge.tests.odd import Plain, register


class Single(Plain):
    """Only one may live in a process."""

    control_period_s, alive = 0.1, False

    def __init__(self) -> None:
        if Single.alive:
            raise RuntimeError("another instance of this simulator is alive in this process")
        Single.alive = True

    def close(self) -> None:
        Single.alive = False


class Wanders(Single):
    """Changes the working directory in every call."""

    def __init__(self) -> None:
        os.chdir("/tmp")

    def step(self, action: Any) -> Any:
        os.chdir("/")
        return super().step(action)


class Huge(Plain):
    control_period_s = 0.1

    def seen(self) -> Any:
        return np.full(3, 1e6, np.float32)


class Flat(Plain):
    """Pays the same whatever is done."""

    control_period_s = 0.1

    def step(self, action: Any) -> Any:
        seen, _, *end = super().step(action)
        return seen, 0.0, *end


class Tells(Plain):
    """Tells of its goals; every third seed comes to none."""

    control_period_s = 0.1

    def step(self, action: Any) -> Any:
        *seen, info = super().step(action)
        if self.steps == 10 and (self.seed or 0) % 3:
            seen[2], info = True, {"outcome": "goal", "lateral_acceleration_mps2": -2.0}
        return *seen, info


register(Single, Wanders, Huge, Flat, Tells)


def odd(name: str) -> str:
    """How it is asked for, also one of bridge.tests.odd."""
    return f"{__name__}:odd/{name}-v0"
