"""Faults of a Hunter on a CAN bus: the edge runtime's driver against the mock as a process.

The rule, for each row: within 2 T + 50 ms after the edge can know of the fault, the set-point on
the bus is speed 0 and stays so; the vehicle stands by the mock's own state; feedback names the
fault; only a re-arm lets it move, though the mock would drive on by itself. The edge can know:
- silent, bus off, late: at the last frame that came in time, because the next ones were due;
- frozen: the same, and STATUS_SILENCE_S later, because frames still come;
- the others: at the first frame on the bus that shows it (full lock: and DEVIATES_S later);
- stuck: at the first set-point that the vehicle should follow and does not (it may lag FOLLOWS_S).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from itertools import takewhile
from typing import NamedTuple

from edge_runtime.safety import Event
from edge_runtime.vehicles.hunter import STATUS_SILENCE_S
from edge_runtime.vehicles.plausibility import DEVIATES_S, FOLLOWS_S
from hil_tests.faults.inside import BRIGHT
from hil_tests.faults.observe import REACTION_LIMIT_S, SET_POINT, SPEED, STATUS, CanMonitor
from hil_tests.faults.rig import Rig
from hil_tests.faults.rows import Row, Try, at_any_phase
from hil_tests.mock_hunter import BITS, FAULTS, MODELS

QUIET_S = 0.5
"""It must stand for this long after the fault: the mock obeys set-points again within 20 ms."""
STANDS_WITHIN_S = 2.0
"""After the fault: our reaction, the chassis's own time-out of 0.5 s, and the braking."""
_MOST_MPS = MODELS["hunter-2.0"].max_speed_mps
_FAST_MPS = 0.97 * _MOST_MPS
_DIFFERS_MPS = 0.15
_ASTRAY_RAD = 0.048  # a tenth of full lock, at the inner wheel; the rows' policies go straight on
_LATER_S = {
    "frozen": STATUS_SILENCE_S, "full_lock": DEVIATES_S, "stuck": FOLLOWS_S + DEVIATES_S,
}  # fmt: skip
_REFUSED = ("silent", "frozen", "bus_off", "remote", "estop")
"""While these last, the runtime refuses a re-arm."""


class Expect(NamedTuple):
    """A fault of the mock, its words in the feedback, and the frame that shows it (0: none)."""

    name: str
    says: str
    can_id: int = 0
    shows: Callable[[bytes], bool] = bool


def speed_mps(data: bytes) -> float:
    return int.from_bytes(data[:2], "big", signed=True) * 1e-3


def at_fault(expect: Expect, rig: Rig) -> Try:
    """Judge that it stops for the fault, still stands after it, and drives once re-armed."""
    chassis, monitor = rig.chassis, rig.monitor
    rig.switch(BRIGHT, "")
    rig.wait_until_driving(lambda: any(speed_mps(d) > _FAST_MPS for _, d in monitor.of(SPEED)[-3:]))
    at_any_phase(rig)
    on_s = chassis.switch(expect.name, True)
    if expect.name == "stuck":  # Nobody can know before another speed is asked for.
        rig.switch(BRIGHT, None)
    stop = rig.stop_command(on_s)
    stands_s = chassis.stands_s(on_s, STANDS_WITHIN_S)
    rearmed = expect.name in _REFUSED and rig.try_rearm()
    wrong = ["was re-armed while the fault lasted"] if rearmed else []
    if expect.can_id:
        shown = (s for s, data in monitor.of(expect.can_id, on_s) if expect.shows(data))
    else:
        shown = (s for s, _ in reversed(monitor.of(SPEED)) if s <= on_s)
    known_s = next(shown, None)
    if known_s is None:
        raise TimeoutError(f"no frame shows {expect.name}")
    rig.switch(BRIGHT, "")
    chassis.switch(expect.name, False)
    time.sleep(QUIET_S)
    quiet_s = time.monotonic()
    wrong += strange_frames(monitor) + _named(rig, expect, on_s)
    wrong += rig.timeline.drives_between(stop.seen_s, quiet_s)
    wrong += [f"stopped for {stop.reason}"] * (stop.reason != Event.VEHICLE.value)
    wrong += ["moved before it was re-armed"] * chassis.moved_between(stands_s, quiet_s)
    zero_s = _zero_s(monitor, on_s, quiet_s)
    recovered_s = rig.drive_again(ready=lambda: chassis.moves)
    return Try(zero_s - known_s, recovered_s, stop.reason, wrong)


def _zero_s(monitor: CanMonitor, on_s: float, until_s: float) -> float:
    """Return since when every set-point has been speed 0; ``until_s`` if none has."""
    newest_first = reversed(monitor.of(SET_POINT, on_s))
    zeros = takewhile(lambda sent: speed_mps(sent[1]) == 0.0, newest_first)
    return min([until_s, *(seen_s for seen_s, _ in zeros)])


def strange_frames(monitor: CanMonitor) -> list[str]:
    """Return a line for a frame, and for a set-point, that should never be on the bus."""
    wrong = [f"0x{can_id:x} was on the bus" for can_id in monitor.strange[:1]]
    asked = (speed_mps(data) for _, data in monitor.of(SET_POINT))
    return wrong + [f"asked for {each:.2f} m/s" for each in asked if abs(each) > _MOST_MPS][:1]


def _named(rig: Rig, expect: Expect, since_s: float) -> list[str]:
    if not any(health.vehicle_fault for health in rig.timeline.health[-2:]):
        return ["health names no fault of the vehicle"]
    reports = (feedback for seen_s, feedback in rig.timeline.feedback if seen_s > since_s)
    faults = {text for feedback in reports for text in feedback.faults}
    if any(words in text for words in expect.says.split("|") for text in faults):
        return []
    return [f"feedback says {sorted(faults)}, not {expect.says!r}"]


_EXPECTS = (
    Expect("stuck", "stuck|speed stays", SET_POINT,
           lambda data: _FAST_MPS - speed_mps(data) > _DIFFERS_MPS),
    Expect("silent", "sends no 0x2"),
    Expect("frozen", "stands still"),
    Expect("bus_off", "sends no 0x2"),
    Expect("late", "sends no 0x2"),
    Expect("full_lock", "the steering stays", SPEED,
           lambda data: abs(int.from_bytes(data[6:], "big", signed=True)) * 1e-3 > _ASTRAY_RAD),
    Expect("lying", "reports", SPEED, lambda data: speed_mps(data) > 1.2 * _MOST_MPS),
    Expect("remote", "remote control", STATUS, lambda data: data[1] == 2),
    Expect("estop", "emergency stop", STATUS, lambda data: data[0] == 1),
    *(Expect(name, bit.words, STATUS, lambda data: any(data[4:6])) for name, bit in BITS.items()),
)  # fmt: skip
ROWS = [
    Row(f"hunter_{expect.name}", f"Hunter: {FAULTS[expect.name]}",
        "set-point 0 on the bus, vehicle_fault; stands until re-armed", partial(at_fault, expect),
        REACTION_LIMIT_S + _LATER_S.get(expect.name, 0.0), rig={"vehicle": "hunter"},
        policy="mean", flows=True)
    for expect in _EXPECTS
]  # fmt: skip
