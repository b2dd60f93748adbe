"""``python -m hil_tests.faults.launch PACKAGE ARGUMENTS``: a command with faults built in.

The process is the real one; only what cannot be done to it from outside is put in here, so that
no switch for faults stands in the code that drives:
- SIGUSR1 steps its wall clock by one hour ahead, SIGUSR2 steps it back again;
- the mock vehicle obeys the word in the file ``vehicle`` of the directory PHIL_FAULT_DIR.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import time
from pathlib import Path

from edge_runtime.vehicles import registry
from hil_tests.faults.endless import DIRECTORY
from hil_tests.faults.faulty_vehicle import FaultyMockVehicle

STEP_S = 3600


class SteppedClock:
    """The wall clock of this process, and how far it has been stepped."""

    def __init__(self) -> None:
        self.step_s = 0
        self._time, self._time_ns = time.time, time.time_ns

    def time(self) -> float:
        """As time.time."""
        return self._time() + self.step_s

    def time_ns(self) -> int:
        """As time.time_ns."""
        return self._time_ns() + self.step_s * 1_000_000_000

    def ahead(self, *_: object) -> None:
        """Step ahead."""
        self.step_s = STEP_S

    def back(self, *_: object) -> None:
        """Step back."""
        self.step_s = 0


def main(package: str) -> None:
    """Put the faults in, then be the command."""
    clock = SteppedClock()
    signal.signal(signal.SIGUSR1, clock.ahead)
    signal.signal(signal.SIGUSR2, clock.back)
    time.time, time.time_ns = clock.time, clock.time_ns
    switch = Path(os.environ[DIRECTORY]) / "vehicle"
    registry._MAKERS["mock"] = lambda setup: FaultyMockVehicle(switch)
    sys.argv = [package, *sys.argv[2:]]
    runpy.run_module(package, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1])
