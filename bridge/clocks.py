"""The clocks by name, and the one for a vehicle in the loop."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from bridge.clock import Clock, Publish
from bridge.command_check import CommandCheck
from bridge.feedback_check import FeedbackCheck
from bridge.lockstep import LockStepClock
from bridge.realtime import RealTimeClock
from bridge.vehicle_clock import VehicleClock
from edge_runtime.latency.model import LatencySpec

REALTIME = "realtime"
CLOCKS: dict[str, Callable[[Publish, CommandCheck, LatencySpec], Clock]] = {
    "lockstep": LockStepClock,
    REALTIME: RealTimeClock,
}


@contextlib.contextmanager
def running_clock(
    name: str,
    publish: Publish,
    check: CommandCheck,
    spec: LatencySpec,
    feedback: FeedbackCheck | None = None,
) -> Iterator[Clock]:
    """Run a clock for the length of the block; with ``feedback`` that of a vehicle in the loop."""
    clock: Clock
    if feedback is not None:
        clock = VehicleClock(publish, check, spec, feedback)
    else:
        clock = CLOCKS[name](publish, check, spec)
    try:
        yield clock
    finally:
        clock.close()
