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
from hil_tests.faults.observe import (
    REACTION_LIMIT_S,
    BusFrame,
    CanMonitor,
    CommandSeen,
    drives_between,
)  # fmt: skip
from hil_tests.faults.rig import Rig
from hil_tests.faults.rows import at_any_phase
from hil_tests.faults.table import Try, fault
from hil_tests.mock_hunter import BITS, FAULTS, MODELS

MODEL = "hunter-2.0"
QUIET_S = 0.5
"""So long it must stand when the fault is over: the mock takes set-points up again within 20 ms."""
STANDS_WITHIN_S = 2.0
"""After the fault: our reaction, the chassis's own 0.5 s where it hears nothing, the braking."""
_FAST_MPS = 0.9 * MODELS[MODEL].max_speed_mps
_IMPOSSIBLE_MPS = 1.2 * MODELS[MODEL].max_speed_mps
_DIFFERS_MPS = 0.15
_ASTRAY_RAD = 0.048  # a tenth of full lock, at the inner wheel; the rows' policies go straight on
_LATER_S = {"frozen": STATUS_SILENCE_S, "full_lock": DEVIATES_S}
_REFUSED = ("silent", "frozen", "bus_off", "remote", "estop")
"""While these last, the runtime refuses to be re-armed: it would be in vain."""


class Expect(NamedTuple):
    """A fault of the mock: its words in the feedback, and which frame shows it first, if any."""

    name: str
    says: str
    shown: Callable[[BusFrame], bool] | None = None


def speed_mps(frame: BusFrame) -> float:
    """Decode the speed of 0x111 or 0x221 by hand."""
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
    known_s = _known_s(expect, rig.monitor, on_s)
    figures = {"stands, ms": (stands_s - on_s) * 1e3, "safe_stop, ms": (stop.seen_s - on_s) * 1e3}
    done = _when_over(rig, expect, on_s, known_s, stop, stands_s)
    return replace(done, wrong=wrong + done.wrong, figures=figures)


def stuck(rig: Rig, number: int) -> Try:
    """Hold the motors' speed, which nobody can know before it is asked for another one."""
    rig.bright(True)
    rig.wait_until_driving(ready=lambda: _drives(rig.monitor))
    at_any_phase(number)
    on_s = rig.chassis.switch("stuck", True)
    held_mps = speed_mps(rig.monitor.of(0x221)[-1])
    rig.bright(False)
    stop = rig.stop_command(on_s)
    stands_s = rig.chassis.stands_s(stop.seen_s, STANDS_WITHIN_S)
    known_s = next(  # the stop at the latest: its set-point is 0
        one.seen_s
        for one in rig.monitor.of(0x111, on_s)
        if held_mps - speed_mps(one) > _DIFFERS_MPS
    )
    rig.bright(True)
    expect = Expect("stuck", "stuck|speed stays")
    done = _when_over(rig, expect, on_s, known_s, stop, stands_s)
    return replace(done, figures={"stands after the stop, ms": (stands_s - stop.seen_s) * 1e3})


def _when_over(
    rig: Rig, expect: Expect, on_s: float, known_s: float, stop: CommandSeen, stands_s: float
) -> Try:
    """Switch the fault off, look whether the stop holds, and re-arm until the vehicle moves."""
    rig.chassis.switch(expect.name, False)
    time.sleep(QUIET_S)
    quiet_s = time.monotonic()
    wrong = _stayed(rig, stop, stands_s, quiet_s) + _named(rig, expect, on_s)
    told_s = _told_s(rig.monitor, on_s, quiet_s)
    recovered_s = rig.drive_again(ready=lambda: rig.chassis.moves)
    return Try(told_s - known_s, recovered_s, stop.reason, wrong=wrong)


def _drives(monitor: CanMonitor) -> bool:
    # By its reports: all is well still.
    recent = monitor.heard[-20:]
    return any(one.can_id == 0x221 and speed_mps(one) > _FAST_MPS for one in recent)


def _known_s(expect: Expect, monitor: CanMonitor, on_s: float) -> float:
    if expect.shown is None:
        return max(one.seen_s for one in monitor.of(0x221) if one.seen_s <= on_s)
    for one in list(monitor.heard):
        if one.seen_s > on_s and expect.shown(one):
            return one.seen_s
    raise TimeoutError(f"no frame shows {expect.name}")


def _told_s(monitor: CanMonitor, on_s: float, until_s: float) -> float:
    """Return since when every set-point has been speed 0; ``until_s`` where it never was."""
    asked = [one for one in monitor.of(0x111, on_s) if one.seen_s < until_s]
    moving = [place for place, one in enumerate(asked) if speed_mps(one) != 0.0]
    after = asked[moving[-1] + 1 :] if moving else asked
    return after[0].seen_s if after else until_s


def _stayed(rig: Rig, stop: CommandSeen, stands_s: float, until_s: float) -> list[str]:
    wrong = _kept_to_its_own(rig.monitor)
    if stop.reason != Event.VEHICLE.value:
        wrong.append(f"stopped for {stop.reason}")
    if rig.chassis.moved_between(stands_s, until_s):
        wrong.append("moved before it was re-armed")
    return wrong + drives_between(rig.timeline.commands, stop.seen_s, until_s)


def _kept_to_its_own(monitor: CanMonitor) -> list[str]:
    """Return lines where a frame or a set-point was on the bus that should never be."""
    most_mps = MODELS[MODEL].max_speed_mps
    fast = [one for one in monitor.of(0x111) if abs(speed_mps(one)) > most_mps]
    wrong = [f"0x{one.can_id:x} was on the bus" for one in monitor.strange[:1]]
    return wrong + [f"asked for {speed_mps(one):.2f} m/s" for one in fast[:1]]


def _named(rig: Rig, expect: Expect, since_s: float) -> list[str]:
    if not any(health.vehicle_fault for health in rig.probe.health[-2:]):
        return ["health names no fault of the vehicle"]
    told = (feedback for seen_s, feedback in rig.timeline.feedback if seen_s > since_s)
    said = [text for feedback in told for text in feedback.faults]
    if any(one in text for one in expect.says.split("|") for text in said):
        return []
    return [f"feedback says {sorted(set(said))}, not {expect.says!r}"]


def _status(test: Callable[[bytes], bool]) -> Callable[[BusFrame], bool]:
    return lambda frame: frame.can_id == 0x211 and test(frame.data)


_EXPECTS = (
    Expect("silent", "sends no 0x2"),
    Expect("frozen", "stands still"),
    Expect("bus_off", "sends no 0x2"),
    Expect("late", "sends no 0x2"),
    Expect(
        "full_lock",
        "the steering stays",
        lambda frame: frame.can_id == 0x221 and abs(_number(frame.data[6:])) > _ASTRAY_RAD,
    ),
    Expect(
        "lying",
        "reports",
        lambda frame: frame.can_id == 0x221 and speed_mps(frame) > _IMPOSSIBLE_MPS,
    ),
    Expect("remote", "remote control", _status(lambda data: data[1] == 2)),
    Expect("estop", "emergency stop", _status(lambda data: data[0] == 1)),
    *(Expect(name, bit.words, _status(lambda data: any(data[4:6]))) for name, bit in BITS.items()),
)
_hunter = partial(
    fault, expected="set-point 0 on the bus, vehicle_fault; stands until re-armed",
    rig={"vehicle": "hunter"}, flows=True,
)  # fmt: skip

for _expect in _EXPECTS:
    _hunter(
        done=f"Hunter: {FAULTS[_expect.name]}",
        name=f"hunter_{_expect.name}",
        measured="last frame in time on the bus to set-point 0"
        if _expect.shown is None
        else "first frame on the bus that shows it to set-point 0",
        reaction_limit_s=REACTION_LIMIT_S + _LATER_S.get(_expect.name, 0.0),
        policy="full",
    )(partial(at_fault, _expect))

_hunter(
    done=f"Hunter: {FAULTS['stuck']}",
    name="hunter_stuck",
    measured="first set-point that it does not follow to set-point 0",
    reaction_limit_s=FOLLOWS_S + DEVIATES_S + REACTION_LIMIT_S,
    policy="mean",
)(stuck)
