"""What runs inside the disturbed processes: a drive without an end, and commands with faults.

``python -m hil_tests.faults.inside PACKAGE ARGUMENTS`` is the real command; only what cannot be
done to it from outside is put in here, so that the code that drives has no switch for faults.
``python -m hil_tests.faults.inside router LISTEN CONNECT`` is a Zenoh router to be killed.

The directory PHIL_FAULT_DIR holds the switches, which are files: ``end`` ends the episode,
``bright`` turns pictures white, ``slow`` slows inference down, ``vehicle`` holds the fault of the
mock vehicle; ``task`` holds the task that the policy was made for. Every press and release of the
simulated brake is written to ``brakes`` there, with its monotonic time.
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

from edge_runtime.manifest import Entry, Task
from edge_runtime.policy import Policy
from edge_runtime.transport import open_session
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.mock import MockVehicle

DIRECTORY = "PHIL_FAULT_DIR"
ENVIRONMENT = "hil_tests.faults.inside:PhilEndless-v0"
MOCK = "hil_tests.faults.inside:FaultyMockVehicle"
END, BRIGHT, BRAKES, VEHICLE, TASK = "end", "bright", "brakes", "vehicle", "task"
SLOW, SLOW_S = "slow", 0.25
_FULL_MPS2, _MOST_MPS = 4.0, 12.0
_WHITE, _DARKEST_TO_BRIGHTEST = 255, 120
_STUCK_AT, _LEAP_MPS = -1.0, 8.0
_STEP_S = 3600
_ESTOP = "the emergency stop is pressed"


Observation = dict[str, np.ndarray]


class EndlessEnv(gymnasium.Env[Observation, np.ndarray]):
    """A car on a straight road, whose pedal is the first action; it sees noise."""

    def __init__(self) -> None:
        self._directory = Path(os.environ[DIRECTORY])
        self._task = task = msgspec.json.decode((self._directory / TASK).read_bytes(), type=Task)
        self.scenario, self.control_period_s = task.task, task.control_period_s
        self.action_names = tuple(one.name for one in task.action)
        seen: dict[str, spaces.Space[Any]] = {
            name: _space(entry) for name, entry in task.observation.items()
        }
        self.observation_space: Any = spaces.Dict(seen)
        ends = ((one.low, one.high, one.stop or 0.0) for one in task.action)
        low, high, self.brake_action = np.array(list(ends), np.float32).T
        self.action_space = spaces.Box(low, high)
        self._braking = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        self._speed_mps = self._distance_m = 0.0
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        first, period_s = self._task.action[0], self.control_period_s
        pedal = 2.0 * (float(action[0]) - first.low) / (first.high - first.low) - 1.0
        speed_mps = self._speed_mps + pedal * _FULL_MPS2 * period_s
        self._speed_mps = min(max(speed_mps, 0.0), _MOST_MPS)
        self._distance_m += self._speed_mps * period_s
        ended = (self._directory / END).exists()
        return self._observation(), 0.0, ended, False, self._info()

    def press_brake(self, pressed: bool) -> None:
        """Write down when the vehicle begins or ends to brake."""
        if pressed != self._braking:
            self._braking = pressed
            with (self._directory / BRAKES).open("a") as brakes:
                brakes.write(f"{time.monotonic():.6f} {int(pressed)}\n")

    def _observation(self) -> Observation:
        bright = (self._directory / BRIGHT).exists()
        return noise(self._task, self.np_random, bright)

    def _info(self) -> dict[str, Any]:
        return {"distance_m": self._distance_m, "speed_mps": self._speed_mps, "outcome": "goal"}


def noise(task: Task, generator: np.random.Generator, bright: bool = False) -> Observation:
    """Draw an observation; pictures are below half brightness, or white."""

    def draw(entry: Entry) -> np.ndarray:
        if entry.dtype == "uint8" and bright:
            return np.full(entry.shape, _WHITE, np.uint8)
        most = _DARKEST_TO_BRIGHTEST if entry.dtype == "uint8" else 2
        whole = generator.integers(0, most, entry.shape)
        return (whole if entry.dtype != "float32" else whole - 0.5).astype(entry.dtype)

    return {name: draw(entry) for name, entry in task.observation.items()}


def _space(entry: Entry) -> spaces.Box:
    low, high = (0, 255) if entry.dtype == "uint8" else (0, 1) if entry.dtype == "bool" else (-9, 9)
    return spaces.Box(low, high, tuple(entry.shape), np.dtype(entry.dtype).type)


if "PhilEndless-v0" not in gymnasium.registry:
    gymnasium.register(
        "PhilEndless-v0",
        # Not __name__: it is __main__ in a process that becomes another command.
        entry_point="hil_tests.faults.inside:EndlessEnv",
        disable_env_checker=True,
        order_enforce=False,
    )


class FaultyMockVehicle(MockVehicle):
    """The mock until its switch, a file, holds ``silent``, ``stuck``, ``lying``, ``self_braking``,
    ``estop`` (it is pressed) or ``locked`` (it cannot be enabled).
    """

    _switch = Path(os.environ.get(DIRECTORY, "")) / VEHICLE

    def enable(self, now_s: float) -> None:
        if self._word() == "locked":
            raise RuntimeError("no control of the gearbox")
        super().enable(now_s)

    def feedback(self, now_s: float) -> VehicleReport:
        word = self._word()
        report = super().feedback(now_s)
        if word == "self_braking":
            report = report._replace(self_braking=True)
        if word == "estop":
            report = report._replace(faults=[_ESTOP], standing=[_ESTOP])
        if word == "silent":
            raise TimeoutError("the vehicle says nothing")
        if word == "stuck":
            action = dict.fromkeys(report.action, _STUCK_AT)
            report = report._replace(action=action)
        if word == "lying":
            report = report._replace(speed_mps=report.speed_mps + _LEAP_MPS)
        return report

    def _word(self) -> str:
        return self._switch.read_text().strip() if self._switch.exists() else ""


def step_clock_on_signals() -> None:
    """Let SIGUSR1 step this process's wall clock one hour ahead, and SIGUSR2 back again."""
    real, real_ns, step_s = time.time, time.time_ns, [0]
    time.time = lambda: real() + step_s[0]
    time.time_ns = lambda: real_ns() + step_s[0] * 10**9
    for number, to_s in ((signal.SIGUSR1, _STEP_S), (signal.SIGUSR2, 0)):
        signal.signal(number, lambda *_, to_s=to_s: step_s.__setitem__(0, to_s))


def slow_down_on_switch() -> None:
    """Let an inference take SLOW_S more while the switch is there."""
    real, switch = Policy.act, Path(os.environ.get(DIRECTORY, "")) / SLOW

    def act(*seen: Any) -> np.ndarray:
        time.sleep(SLOW_S * switch.exists())
        return real(*seen)

    Policy.act = act  # type: ignore[method-assign, assignment]


def launch(package: str) -> None:
    """Run a package's command, with a clock to be stepped and a policy to be slowed down."""
    step_clock_on_signals()
    slow_down_on_switch()
    sys.argv = [package, *sys.argv[2:]]
    runpy.run_module(package, run_name="__main__", alter_sys=True)


def route(listen: str, connect: str) -> None:
    """Be a Zenoh router until SIGTERM."""
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    with open_session(listen=listen, connect=connect, mode="router"):
        print("ready", flush=True)
        end.wait()


if __name__ == "__main__":
    if sys.argv[1] == "router":
        route(*sys.argv[2:])
    else:
        launch(sys.argv[1])
