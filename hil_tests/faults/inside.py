"""What runs inside the disturbed processes: a drive without an end, and commands with faults.

``python -m hil_tests.faults.inside PACKAGE ARGUMENTS`` is the real command; only what cannot be
done to it from outside is put in here, so that the code that drives has no switch for faults.
``python -m hil_tests.faults.inside router LISTEN CONNECT`` is a Zenoh router to be killed.

The directory PHIL_FAULT_DIR holds the switches, which are files: ``end`` ends the episode,
``bright`` turns the frames white, ``vehicle`` holds the fault of the mock vehicle. Every press and
release of the simulated brake is written to ``brakes`` there, with its monotonic time.
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
import numpy as np
from gymnasium import spaces

from edge_runtime import vehicles
from edge_runtime.transport import open_session
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.mock import MockVehicle
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE

DIRECTORY = "PHIL_FAULT_DIR"
ENVIRONMENT = "hil_tests.faults.inside:PhilEndless-v0"
END, BRIGHT, BRAKES, VEHICLE = "end", "bright", "brakes", "vehicle"
_FULL_MPS2, _MOST_MPS = 4.0, 12.0
_WHITE, _DARKEST_TO_BRIGHTEST = 255, 120
_STUCK_AT, _LEAP_MPS = -1.0, 8.0
_STEP_S = 3600


class EndlessEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A car on a straight road; the picture is noise below half brightness, new every step."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0, 255, FRAMES_SHAPE, np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.brake_action = np.array([-1.0], np.float32)
        self._directory = Path(os.environ[DIRECTORY])
        self._braking = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Stand at the start of the road."""
        super().reset(seed=seed)
        self._speed_mps = self._distance_m = 0.0
        return self._frames(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period."""
        change_mps = float(action[0]) * _FULL_MPS2 * CONTROL_PERIOD_S
        self._speed_mps = min(max(self._speed_mps + change_mps, 0.0), _MOST_MPS)
        self._distance_m += self._speed_mps * CONTROL_PERIOD_S
        ended = (self._directory / END).exists()
        return self._frames(), 0.0, ended, False, self._info()

    def press_brake(self, pressed: bool) -> None:
        """Told every tick whether the vehicle brakes; only changes are written."""
        if pressed != self._braking:
            self._braking = pressed
            with (self._directory / BRAKES).open("a") as brakes:
                brakes.write(f"{time.monotonic():.6f} {int(pressed)}\n")

    def _frames(self) -> np.ndarray:
        if (self._directory / BRIGHT).exists():
            return np.full(FRAMES_SHAPE, _WHITE, np.uint8)
        return self.np_random.integers(0, _DARKEST_TO_BRIGHTEST, FRAMES_SHAPE, dtype=np.uint8)

    def _info(self) -> dict[str, Any]:
        return {"distance_m": self._distance_m, "speed_mps": self._speed_mps, "outcome": "goal"}


if "PhilEndless-v0" not in gymnasium.registry:
    gymnasium.register(
        "PhilEndless-v0",
        # Not __name__: it is __main__ in a process that becomes another command.
        entry_point="hil_tests.faults.inside:EndlessEnv",
        disable_env_checker=True,
        order_enforce=False,
    )


class FaultyMockVehicle(MockVehicle):
    """The mock until its switch, a file, holds ``silent``, ``stuck`` or ``lying``."""

    def __init__(self, switch: Path) -> None:
        super().__init__()
        self._switch = switch

    def feedback(self, now_s: float) -> VehicleReport:
        """The mock's report: none, one of stuck actuators, or an impossible one."""
        word = self._switch.read_text().strip() if self._switch.exists() else ""
        report = super().feedback(now_s)
        if word == "silent":
            raise TimeoutError("the vehicle says nothing")
        if word == "stuck":
            action = dict.fromkeys(report.action, _STUCK_AT)
            report = report._replace(action=action)
        if word == "lying":
            report = report._replace(speed_mps=report.speed_mps + _LEAP_MPS)
        return report


def step_clock_on_signals() -> None:
    """The wall clock of this process: SIGUSR1 steps it one hour ahead, SIGUSR2 back again."""
    real, real_ns, step_s = time.time, time.time_ns, [0]
    time.time = lambda: real() + step_s[0]
    time.time_ns = lambda: real_ns() + step_s[0] * 10**9
    for number, to_s in ((signal.SIGUSR1, _STEP_S), (signal.SIGUSR2, 0)):
        signal.signal(number, lambda *_, to_s=to_s: step_s.__setitem__(0, to_s))


def launch(package: str) -> None:
    """Put the faults in, then be the command."""
    step_clock_on_signals()
    switch = Path(os.environ[DIRECTORY]) / VEHICLE
    vehicles._mock = lambda config, scenario: FaultyMockVehicle(switch)
    sys.argv = [package, *sys.argv[2:]]
    runpy.run_module(package, run_name="__main__", alter_sys=True)


def route(listen: str, connect: str) -> None:
    """Route until SIGTERM."""
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    session = open_session(listen=listen, connect=connect, mode="router")
    print("ready", flush=True)
    end.wait()
    session.close()


if __name__ == "__main__":
    if sys.argv[1] == "router":
        route(*sys.argv[2:])
    else:
        launch(sys.argv[1])
