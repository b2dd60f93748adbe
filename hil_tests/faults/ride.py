"""Faults of a drive with ride-through of RIDE_S, and a mock vehicle where a row asks for one.

While no state or no command comes, the last command's plan is played: through what is shorter,
nothing brakes. What is longer brakes, RIDE_S later than without it. A fault of the vehicle and a
stop end it at once.
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial

from edge_runtime.wire import DRIVE
from hil_tests.faults.inside import VEHICLE
from hil_tests.faults.observe import REACTION_LIMIT_S, stops_between
from hil_tests.faults.rig import RIDE_S, Rig
from hil_tests.faults.rows import (
    GAP,
    LASTS_S,
    SETTLED_S,
    Try,
    at_any_phase,
    edge_killed,
    fault,
    sleep_until,
)  # fmt: skip
from hil_tests.processes import Process

SHORT_S, RIDING_S = 0.4, 0.3
"""An outage through which it rides, and where in one it surely rides."""
_LATER_S = REACTION_LIMIT_S + RIDE_S
_VEHICLE = {"ride_s": RIDE_S, "vehicle": "mock"}


@contextlib.contextmanager
def _stopped(process: Process, number: int) -> Iterator[float]:
    """It neither hears nor says anything; since when."""
    time.sleep(SETTLED_S)
    at_any_phase(number)
    process.send(signal.SIGSTOP)
    try:
        yield time.monotonic()
    finally:
        process.send(signal.SIGCONT)


@fault("rides: nobody brakes", GAP, reaction_limit_s=_LATER_S, rig=_VEHICLE, policy="steady")
def ride_states_lost(rig: Rig, number: int) -> Try:
    """No states for 0.4 s."""
    with _stopped(rig.simulator, number) as begin_s:
        sleep_until(begin_s + SHORT_S)
    return _rode(rig, begin_s)


@fault("rides: nobody brakes", GAP, reaction_limit_s=_LATER_S, policy="steady",
       rig={**_VEHICLE, "between": "link"})  # fmt: skip
def ride_link_stalled(rig: Rig, number: int) -> Try:
    """TCP held for 0.4 s, both ways, then all at once."""
    time.sleep(SETTLED_S)
    at_any_phase(number)
    begin_s = time.monotonic()
    rig.link.stall()
    sleep_until(begin_s + SHORT_S)
    rig.link.restore()
    return _rode(rig, begin_s)


def _rode(rig: Rig, begin_s: float) -> Try:
    """Nobody braked since a moment, and from now on it drives."""
    recovered_s = rig.recovered_after_s(time.monotonic())
    end_s = time.monotonic() + SETTLED_S
    sleep_until(end_s)
    braked_s = [at_s for at_s, on in rig.brakes() if on]
    braked_s += [at_s for at_s, feedback in rig.timeline.feedback if feedback.self_braking]
    wrong = stops_between(rig.timeline.commands, begin_s, end_s)
    wrong += ["braked by itself"] * any(begin_s < at_s < end_s for at_s in braked_s)
    return Try(rig.longest_gap(begin_s, end_s), recovered_s, wrong=wrong)


def _nothing(rig: Rig) -> float:
    return rig.last_state_s(before_s=time.monotonic())


def _vehicle_lies(rig: Rig) -> float:
    rig.switch(VEHICLE, "lying")
    return time.monotonic()


def _is_ended(rig: Rig) -> float:
    rig.edge.send(signal.SIGTERM)
    return time.monotonic()


def _stops(reason: str, do: Callable[[Rig], float], rig: Rig, number: int) -> Try:
    """It stops after what is done while it rides, and stays stopped."""
    with _stopped(rig.simulator, number) as begin_s:
        sleep_until(begin_s + RIDING_S)
        since_s = do(rig)
        stop = rig.stop_command(begin_s)
    rig.switch(VEHICLE, None)
    time.sleep(LASTS_S)
    drove = any(c.seen_s > stop.seen_s and c.mode == DRIVE for c in rig.timeline.commands)
    wrong = ["drove before it was re-armed"] * drove
    wrong += [f"stopped for {stop.reason}"] * (stop.reason != reason)
    if do is _is_ended:
        rig.edge.wait()
        rig.edge = rig.start_edge()
        rig.edge.wait_for_line("ready")
    else:
        rig.rearm()
    rig.wait_until_driving()
    return Try(stop.seen_s - since_s, None, stop.reason, wrong=wrong)


for _name, _done, _reason, _do, _limit_s in (
    ("too_long", "no states for longer than it may ride", "no_fresh_state", _nothing, _LATER_S),
    ("vehicle_fault", "vehicle reports what cannot be while it is ridden", "vehicle_fault",
     _vehicle_lies, REACTION_LIMIT_S),
    ("ended", "edge runtime ended while it rides; a new one", "runtime_ended", _is_ended,
     REACTION_LIMIT_S),
):  # fmt: skip
    fault(f"edge sends safe_stop: {_reason}; stays stopped", "that to safe_stop on the wire",
          f"ride_{_name}", _done, reaction_limit_s=_limit_s, recovery_limit_s=None, rig=_VEHICLE,
          policy="steady")(partial(_stops, _reason, _do))  # fmt: skip
fault("simulator brakes by itself: no_command", "last drive command to the simulator's brake",
      "ride_edge_killed", "SIGKILL to the edge runtime, which the simulator rides out; a new one",
      reaction_limit_s=_LATER_S, rig={"ride_s": RIDE_S})(edge_killed)  # fmt: skip
