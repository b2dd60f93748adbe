"""Faults of the vehicle beside the edge runtime: silent, stuck, lying."""

from __future__ import annotations

import time

from edge_runtime.wire import DRIVE
from hil_tests.faults.ends import at_any_phase
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Row, Try
from hil_tests.faults.waits import drive_after_s, stop_command

SWITCH = "vehicle"
FAULT_S = 1.0
SETTLED_S = 0.5
"""So long the drive is steady first: a vehicle may lag behind what it was asked before."""


def silent(rig: Rig, number: int) -> Try:
    """No feedback any more."""
    return _at_fault(rig, number, "silent")


def stuck(rig: Rig, number: int) -> Try:
    """Its pedal stays where it is, whatever is asked."""
    return _at_fault(rig, number, "stuck")


def lying(rig: Rig, number: int) -> Try:
    """Its speed leaps as no vehicle's does."""
    return _at_fault(rig, number, "lying")


def _at_fault(rig: Rig, number: int, word: str) -> Try:
    """Stops for it, stays stopped when it is over, and drives again once re-armed."""
    time.sleep(SETTLED_S)
    at_any_phase(number)
    begin_s = rig.mark()
    rig.switch(SWITCH, word)
    stop = stop_command(rig, begin_s)
    # A silent vehicle may still speak between the mark and the switch, and what it says counts.
    # What another says after the switch is no good any more.
    end_s = stop.seen_s if word == "silent" else begin_s
    last_s = max(s for s in rig.timeline.feedback_s if s < end_s)
    time.sleep(max(0.0, begin_s + FAULT_S - time.monotonic()))
    said = any(f"vehicle_{word}" in line for seen_s, line in rig.edge.lines if seen_s > begin_s)
    rig.switch(SWITCH, None)
    time.sleep(FAULT_S)
    drove = [c for c in rig.timeline.commands if c.seen_s > stop.seen_s and c.mode == DRIVE]
    wrong = ["drove before it was re-armed"] if drove else []
    wrong += [] if said else [f"the log does not say vehicle_{word}"]
    rig.rearm()
    rearmed_s = rig.mark()
    rig.wait_until_driving()
    recovery_s = drive_after_s(rig, rearmed_s) - rearmed_s
    return Try(stop.seen_s - last_s, recovery_s, stop.reason, wrong=wrong)


_EXPECT = "edge sends safe_stop: vehicle_fault; stays until re-armed"
_TO_STOP = "last good feedback at the probe to safe_stop on the wire"
_RIG = {"vehicle": "mock"}

ROWS = tuple(
    Row(
        f"vehicle_{run.__name__}",
        done,
        _EXPECT,
        _TO_STOP,
        run,
        rig=_RIG,
        policy="steady",
        flows=True,
    )
    for run, done in (
        (silent, "vehicle silent"),
        (stuck, "vehicle's pedal stuck"),
        (lying, "vehicle reports a speed that cannot be"),
    )
)
