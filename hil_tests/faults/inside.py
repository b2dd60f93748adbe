"""Code inside the disturbed processes: an endless drive, and commands with faults.

``python -m hil_tests.faults.inside PACKAGE ARGUMENTS`` is the real command, with faults that cannot
be injected from outside. The directory PHIL_FAULT_DIR holds TASK, and switches, which are files:
END ends the episode, BRIGHT turns pictures white, SLOW slows inference down, VEHICLE and SOURCE
hold the fault of the mock vehicle and of a source of `sense`. BRAKES is the log of the simulated
brake: a line for each change, with its monotonic time and 1 where it is pressed.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium import spaces

from edge_runtime.manifest import Task
from edge_runtime.policy import Policy
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.mock import MockVehicle

ENVIRONMENT = "hil_tests.faults.inside:PhilEndless-v0"
MOCK = "hil_tests.faults.inside:FaultyMockVehicle"
SENSES = "hil_tests.faults.inside:FaultySource"
DIRECTORY = "PHIL_FAULT_DIR"
END, BRIGHT, BRAKES, VEHICLE, TASK, SLOW = "end", "bright", "brakes", "vehicle", "task", "slow"
SOURCE = "source"
HERE = Path(os.environ.get(DIRECTORY, ""))
SLOWER_S = 0.25
_FULL_MPS2, _MOST_MPS = 4.0, 12.0
_STUCK_AT, _LEAP_MPS = -1.0, 8.0
_STEP_S = 3600
_ESTOP = "the emergency stop is pressed"
_RANGES = {"uint8": (0, 255), "bool": (0, 1)}
Observation = dict[str, np.ndarray]


class EndlessEnv(gymnasium.Env[Observation, np.ndarray]):
    """A car on a straight road; its pedal is the first action, its observation noise."""

    def __init__(self) -> None:
        self._task = task = msgspec.json.decode((HERE / TASK).read_bytes(), type=Task)
        self.scenario, self.control_period_s = task.task, task.control_period_s
        self.action_names = tuple(row.name for row in task.action)
        boxes: dict[str, spaces.Space[Any]] = {}
        for name, entry in task.observation.items():
            low, high = _RANGES.get(entry.dtype, (-9, 9))
            boxes[name] = spaces.Box(low, high, tuple(entry.shape), np.dtype(entry.dtype).type)
        self.observation_space: Any = spaces.Dict(boxes)
        ends = ((row.low, row.high, row.stop or 0.0) for row in task.action)
        low, high, self.brake_action = np.array(list(ends), np.float32).T
        self.action_space = spaces.Box(low, high)
        self._braking = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        self._speed_mps = self._distance_m = 0.0
        return self._observe()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        first = self._task.action[0]
        pedal = 2.0 * (float(action[0]) - first.low) / (first.high - first.low) - 1.0
        speed_mps = self._speed_mps + pedal * _FULL_MPS2 * self.control_period_s
        self._speed_mps = min(max(speed_mps, 0.0), _MOST_MPS)
        self._distance_m += self._speed_mps * self.control_period_s
        observation, info = self._observe()
        return observation, 0.0, (HERE / END).exists(), False, info

    def press_brake(self, pressed: bool) -> None:
        if pressed != self._braking:
            self._braking = pressed
            with (HERE / BRAKES).open("a") as brakes:
                brakes.write(f"{time.monotonic():.6f} {int(pressed)}\n")

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        info = {"distance_m": self._distance_m, "speed_mps": self._speed_mps, "outcome": "goal"}
        return noise(self._task, self.np_random, (HERE / BRIGHT).exists()), info


def noise(task: Task, generator: np.random.Generator, bright: bool = False) -> Observation:
    """Draw a random observation; pictures are below half brightness, or white."""
    observation = {}
    for name, entry in task.observation.items():
        is_picture = entry.dtype == "uint8"
        values = generator.integers(0, 120 if is_picture else 2, entry.shape)
        if is_picture and bright:
            values = np.full(entry.shape, 255)
        observation[name] = (values - 0.5 * (entry.dtype == "float32")).astype(entry.dtype)
    return observation


if "PhilEndless-v0" not in gymnasium.registry:
    gymnasium.register(
        "PhilEndless-v0",
        # Not __name__: it is __main__ in a process that becomes another command.
        entry_point="hil_tests.faults.inside:EndlessEnv",
        disable_env_checker=True,
        order_enforce=False,
    )


def switched(name: str) -> str:
    """Return the word in a switch, empty where there is no such file."""
    switch = HERE / name
    return switch.read_text() if switch.exists() else ""


class FaultyMockVehicle(MockVehicle):
    """The mock, with the fault that VEHICLE holds; ``locked`` cannot be enabled."""

    def enable(self, now_s: float) -> None:
        if switched(VEHICLE) == "locked":
            raise RuntimeError("no control of the gearbox")
        super().enable(now_s)

    def feedback(self, now_s: float) -> VehicleReport:
        report = super().feedback(now_s)
        match switched(VEHICLE):
            case "silent":
                raise TimeoutError("the vehicle says nothing")
            case "self_braking":
                return report._replace(self_braking=True)
            case "estop":
                return report._replace(faults=[_ESTOP], standing=[_ESTOP])
            case "stuck":
                return report._replace(action=dict.fromkeys(report.action, _STUCK_AT))
            case "lying":
                return report._replace(speed_mps=report.speed_mps + _LEAP_MPS)
        return report


class FaultySource:
    speed_mps = 0.5

    def __init__(self) -> None:
        self._task = msgspec.json.decode((HERE / TASK).read_bytes(), type=Task)
        self._random = np.random.default_rng()

    def observe(self) -> Observation:
        match switched(SOURCE):
            case "raises":
                raise OSError("the camera is gone")
            case "late":
                time.sleep(3.0 * self._task.control_period_s)
            case "hangs":
                threading.Event().wait()
        return noise(self._task, self._random)


def launch(package: str, *arguments: str) -> None:
    """Run a package's command.

    SIGUSR1 steps its wall clock one hour ahead, SIGUSR2 back. SLOW adds SLOWER_S to an inference.
    """
    real, real_ns, act, ahead_s = time.time, time.time_ns, Policy.act, 0

    def step_clock(number: int, _: Any) -> None:
        nonlocal ahead_s
        ahead_s = _STEP_S if number == signal.SIGUSR1 else 0

    time.time = lambda: real() + ahead_s
    time.time_ns = lambda: real_ns() + ahead_s * 10**9
    for number in (signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, step_clock)

    def act_slowly(*arguments: Any) -> np.ndarray:
        time.sleep(SLOWER_S * (HERE / SLOW).exists())
        return act(*arguments)

    Policy.act = act_slowly  # type: ignore[method-assign, assignment]
    sys.argv = [package, *arguments]
    runpy.run_module(package, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    launch(*sys.argv[1:])
