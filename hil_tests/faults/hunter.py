"""Faults of a Hunter on a CAN bus: the edge runtime's driver against the mock as a process.

The rule, for each row: within 2 T + 50 ms after the edge can know, the set-point on the bus is
speed 0 and stays so; the vehicle stands (by the mock's own truth, whatever it reports), though
the mock would drive on by itself when the fault is over; feedback names the fault in words; only a
re-arm lets it move. When the edge can know:
- silent, bus off, late: at the last frame that came in time, for the next ones were due;
- frozen: the same, and STATUS_SILENCE_S later, for it goes on sending;
- the others: at the first frame on the bus that shows it (full lock: and DEVIATES_S later);
- stuck: at the first set-point that the vehicle should follow and does not (it may lag FOLLOWS_S).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from edge_runtime.safety import Event
from edge_runtime.vehicles.hunter import STATUS_SILENCE_S
from edge_runtime.vehicles.plausibility import DEVIATES_S, FOLLOWS_S
from hil_tests.faults.inside import BRIGHT
from hil_tests.faults.observe import (
    REACTION_LIMIT_S,
    SET_POINT,
    SPEED,
    STATUS,
    BusFrame,
    CanMonitor,
    CommandSeen,
)
from hil_tests.faults.rig import Rig
from hil_tests.faults.rows import Try, at_any_phase, fault
from hil_tests.mock_hunter import BITS, FAULTS, MODELS

QUIET_S = 0.5
"""So long it must stand when the fault is over: the mock takes set-points up again within 20 ms."""
STANDS_WITHIN_S = 2.0
"""After the fault: our reaction, the chassis's own 0.5 s where it hears nothing, the braking."""
_MOST_MPS = MODELS["hunter-2.0"].max_speed_mps
_DIFFERS_MPS = 0.15
_ASTRAY_RAD = 0.048  # a tenth of full lock, at the inner wheel; the rows' policies go straight on
_LATER_S = {
    "frozen": STATUS_SILENCE_S, "full_lock": DEVIATES_S, "stuck": FOLLOWS_S + DEVIATES_S,
}  # fmt: skip
_REFUSED = ("silent", "frozen", "bus_off", "remote", "estop")
"""While these last, the runtime refuses to be re-armed: it would be in vain."""


class Expect(NamedTuple):
    """A fault of the mock: its words in the feedback, and the first frame that shows it.

    ``can_id`` and ``shows`` tell that frame; 0 where none does.
    """

    name: str
    says: str
    can_id: int = 0
    shows: Callable[[bytes], bool] = bool


_STUCK = Expect("stuck", "stuck|speed stays")


def speed_mps(frame: BusFrame) -> float:
    """Decode the speed of SET_POINT or SPEED by hand."""
    return _number(frame.data[:2])


def _number(data: bytes) -> float:
    return int.from_bytes(data, "big", signed=True) * 1e-3


def at_fault(expect: Expect, rig: Rig, number: int) -> Try:
    """Judge that it stops for the fault, stands when it is over, and drives once re-armed."""
    rig.wait_until_driving(ready=lambda: _drives(rig.monitor))
    at_any_phase(number)
    on_s = rig.chassis.switch(expect.name, True)
    stop = rig.stop_command(on_s)
    stands_s = rig.chassis.stands_s(on_s, STANDS_WITHIN_S)
    taken = expect.name in _REFUSED and rig.try_rearm()
    wrong = ["was re-armed while the fault lasted"] if taken else []
    if expect.can_id:
        seen = (one for one in rig.monitor.of(expect.can_id, on_s) if expect.shows(one.data))
    else:
        seen = (one for one in reversed(rig.monitor.of(SPEED)) if one.seen_s <= on_s)
    known = next(seen, None)
    if known is None:
        raise TimeoutError(f"no frame shows {expect.name}")
    done = _when_over(rig, expect, on_s, known.seen_s, stop, stands_s)
    return replace(done, wrong=wrong + done.wrong)


def stuck(rig: Rig, number: int) -> Try:
    """Hold the motors' speed, which nobody can know before it is asked for another one."""
    rig.switch(BRIGHT, "")
    rig.wait_until_driving(ready=lambda: _drives(rig.monitor))
    at_any_phase(number)
    on_s = rig.chassis.switch("stuck", True)
    held_mps = speed_mps(rig.monitor.of(SPEED)[-1])
    rig.switch(BRIGHT, None)
    stop = rig.stop_command(on_s)
    stands_s = rig.chassis.stands_s(stop.seen_s, STANDS_WITHIN_S)
    asked = rig.monitor.of(SET_POINT, on_s)  # the stop's at the latest is 0
    known_s = next(one.seen_s for one in asked if held_mps - speed_mps(one) > _DIFFERS_MPS)
    rig.switch(BRIGHT, "")
    return _when_over(rig, _STUCK, on_s, known_s, stop, stands_s)


def _drives(monitor: CanMonitor) -> bool:
    recent = monitor.heard[-20:]
    return any(one.can_id == SPEED and speed_mps(one) > 0.9 * _MOST_MPS for one in recent)


def _when_over(
    rig: Rig, expect: Expect, on_s: float, known_s: float, stop: CommandSeen, stands_s: float
) -> Try:
    """Switch the fault off, look whether the stop holds, and re-arm until the vehicle moves."""
    rig.chassis.switch(expect.name, False)
    time.sleep(QUIET_S)
    quiet_s = time.monotonic()
    wrong = strange_frames(rig.monitor) + _named(rig, expect, on_s)
    wrong += rig.timeline.drives_between(stop.seen_s, quiet_s)
    if stop.reason != Event.VEHICLE.value:
        wrong.append(f"stopped for {stop.reason}")
    if rig.chassis.moved_between(stands_s, quiet_s):
        wrong.append("moved before it was re-armed")
    told_s = _told_s(rig.monitor, on_s, quiet_s)
    recovered_s = rig.drive_again(ready=lambda: rig.chassis.moves)
    return Try(told_s - known_s, recovered_s, stop.reason, wrong)


def _told_s(monitor: CanMonitor, on_s: float, until_s: float) -> float:
    """Return since when every set-point has been speed 0; ``until_s`` where it never was."""
    told_s = until_s
    for one in reversed(monitor.of(SET_POINT, on_s)):
        if speed_mps(one) != 0.0:
            break
        told_s = min(told_s, one.seen_s)
    return told_s


def strange_frames(monitor: CanMonitor) -> list[str]:
    """Return lines where a frame or a set-point was on the bus that should never be."""
    fast = [one for one in monitor.of(SET_POINT) if abs(speed_mps(one)) > _MOST_MPS]
    wrong = [f"0x{one.can_id:x} was on the bus" for one in monitor.strange[:1]]
    return wrong + [f"asked for {speed_mps(one):.2f} m/s" for one in fast[:1]]


def _named(rig: Rig, expect: Expect, since_s: float) -> list[str]:
    if not any(health.vehicle_fault for health in rig.timeline.health[-2:]):
        return ["health names no fault of the vehicle"]
    told = (feedback for seen_s, feedback in rig.timeline.feedback if seen_s > since_s)
    said = {text for feedback in told for text in feedback.faults}
    if any(one in text for one in expect.says.split("|") for text in said):
        return []
    return [f"feedback says {sorted(said)}, not {expect.says!r}"]


_EXPECTS = (
    _STUCK,
    Expect("silent", "sends no 0x2"),
    Expect("frozen", "stands still"),
    Expect("bus_off", "sends no 0x2"),
    Expect("late", "sends no 0x2"),
    Expect("full_lock", "the steering stays", SPEED, lambda d: abs(_number(d[6:])) > _ASTRAY_RAD),
    Expect("lying", "reports", SPEED, lambda d: _number(d[:2]) > 1.2 * _MOST_MPS),
    Expect("remote", "remote control", STATUS, lambda d: d[1] == 2),
    Expect("estop", "emergency stop", STATUS, lambda d: d[0] == 1),
    *(Expect(name, bit.words, STATUS, lambda d: any(d[4:6])) for name, bit in BITS.items()),
)
for _expect in _EXPECTS:
    fault(
        "set-point 0 on the bus, vehicle_fault; stands until re-armed", f"hunter_{_expect.name}",
        f"Hunter: {FAULTS[_expect.name]}", rig={"vehicle": "hunter"}, flows=True,
        reaction_limit_s=REACTION_LIMIT_S + _LATER_S.get(_expect.name, 0.0),
        policy="mean" if _expect is _STUCK else "full",
    )(stuck if _expect is _STUCK else partial(at_fault, _expect))  # fmt: skip
