"""Faults of both ends, and of the link between them.

A new row is a function that takes a driving rig and the number of its try, does the fault once,
undoes it, and returns a `Try`; its docstring says what is done. `fault` or `drives_on` above it
puts it into ROWS. Faults of messages and of a Hunter have files of their own; `run.py` names them.

The last rows are of a drive with ride-through of RIDE_S. While no state or no command comes, the
last command's plan is played: through what is shorter, nothing brakes. What is longer brakes,
RIDE_S later than without it. A fault of the vehicle and a stop end it at once.
"""

from __future__ import annotations

import math
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from bridge.recording import Recording, heard_of
from edge_runtime.wire import SAFE_STOP, State, decode_state
from hil_tests.faults.inside import MOCK, SLOW, VEHICLE
from hil_tests.faults.observe import REACTION_LIMIT_S, drives_between, stops_between
from hil_tests.faults.rig import RIDE_S, VEHICLE_ID, Rig
from hil_tests.faults.table import GAP, Try, drives_on, fault
from hil_tests.processes import Process, wait_until
from hil_tests.testing.policies import T

LASTS_S = 1.0
STALLED_S = 0.6
"""Shorter than Zenoh's lease, so that the connection lives and brings all that it held at once. A
T of more than 0.24 s needs a longer one."""
SLOWED_S = 0.5
STARVED_S = 2.0
SETTLED_S = 0.5
"""So long the drive is steady first: a vehicle may lag behind what it was asked before."""
FULL_AT_BYTES = 200_000
"""Several of the recorder's chunks: noise compresses badly, and its copies for viewers are text."""
RECORDED_S = 2.5
MOST_LOST_S = 1.0
_CANNOT_WRITE = 1  # Exit status of a recorder that cannot write
_FEWEST_STATES = 5
_EXPECT_OWN = "simulator brakes by itself: no_command"
_EXPECT_BOTH = "both ends stop, each by itself"
_TO_BRAKE = "last drive command to the simulator's brake"
_THROUGH_LINK = "last state through the link to safe_stop in the edge's log"


def at_any_phase(number: int) -> None:
    """Wait a part of the control period, so that faults do not all come at the same moment."""
    time.sleep(float(np.random.default_rng(number).uniform(0, T)))


def sleep_until(time_s: float) -> None:
    time.sleep(max(0.0, time_s - time.monotonic()))


@fault(_EXPECT_OWN, _TO_BRAKE)
def edge_killed(rig: Rig, number: int) -> Try:
    """SIGKILL to the edge runtime; a new one."""
    begin_s = time.monotonic()
    rig.edge.kill()
    reaction_s = rig.own_brake_s(begin_s) - rig.last_drive_s()
    rig.edge = rig.start_edge()
    ended_s = rig.edge.wait_for_line("ready")
    return Try(reaction_s, rig.recovered_after_s(ended_s), "no_command")


@fault(_EXPECT_OWN, _TO_BRAKE, flows=True)
def edge_stopped(rig: Rig, number: int) -> Try:
    """Edge runtime stopped for 1 s and continued."""
    begin_s = time.monotonic()
    rig.edge.send(signal.SIGSTOP)
    reaction_s = rig.own_brake_s(begin_s) - rig.last_drive_s()
    sleep_until(begin_s + LASTS_S)
    ended_s = time.monotonic()
    rig.edge.send(signal.SIGCONT)
    recovered_s = rig.recovered_after_s(ended_s)
    # What piled up meanwhile is not driven on.
    return Try(reaction_s, recovered_s, "no_command", wrong=rig.must_stop_first(ended_s))


@fault("edge sends safe_stop: no_fresh_state", "last state at the probe to safe_stop on the wire")
def simulator_killed(rig: Rig, number: int) -> Try:
    """SIGKILL to the simulator; a new one."""
    begin_s = time.monotonic()
    rig.simulator.kill()
    stop = rig.stop_command(begin_s)
    last_s = rig.last_state_s(before_s=stop.seen_s)
    known = set(rig.timeline.states)
    rig.simulator = rig.start_simulator()
    new = wait_until(lambda: set(rig.timeline.states) - known, "the new simulator's states")
    ended_s = min(rig.timeline.states[place] for place in new)
    return Try(stop.seen_s - last_s, rig.recovered_after_s(ended_s), stop.reason)


@fault(_EXPECT_BOTH, _THROUGH_LINK, rig={"between": "relay"})
def link_cut(rig: Rig, number: int) -> Try:
    """TCP cut for 1 s and restored."""
    begin_s, drive_s = time.monotonic(), rig.last_drive_s()
    rig.relay.cut()
    last_s = rig.relay.last_state_s
    stop = rig.logged_stop(begin_s)
    brake_s = rig.own_brake_s(begin_s) - max(drive_s, rig.last_drive_s())
    sleep_until(begin_s + LASTS_S)
    ended_s = time.monotonic()
    rig.relay.restore()
    recovered_s = rig.recovered_after_s(ended_s)
    figures = {"simulator brakes, ms": brake_s * 1e3}
    return Try(stop.seen_s - last_s, recovered_s, stop.reason, figures=figures)


@fault(_EXPECT_BOTH, _THROUGH_LINK, rig={"between": "relay"})
def link_stalled(rig: Rig, number: int) -> Try:
    """TCP held for 0.6 s, then all at once."""
    begin_s = time.monotonic()
    rig.relay.stall()
    stop = rig.logged_stop(begin_s)
    last_s = rig.relay.last_state_s
    sleep_until(begin_s + max(STALLED_S, 2.5 * rig.period_s))  # longer than silence
    ended_s = time.monotonic()
    rig.relay.restore()
    recovered_s = rig.recovered_after_s(ended_s)
    return Try(stop.seen_s - last_s, recovered_s, stop.reason, wrong=rig.must_stop_first(ended_s))


@fault(
    _EXPECT_BOTH, "last state at the router to safe_stop in the edge's log",
    rig={"between": "router"},
)  # fmt: skip
def router_restarted(rig: Rig, number: int) -> Try:
    """SIGKILL to the router; a new one."""
    begin_s = time.monotonic()
    rig.router.kill()
    stop = rig.logged_stop(begin_s)
    rig.router = rig.start_router()
    ended_s = rig.router.wait_for_line("ready")
    reaction_s = stop.seen_s - rig.last_state_s(before_s=begin_s)
    return Try(reaction_s, rig.recovered_after_s(ended_s), stop.reason)


@drives_on()
def clock_stepped_edge(rig: Rig, number: int) -> Try:
    """Edge's wall clock 1 h ahead and back."""
    _step(rig.edge, number)
    time.sleep(LASTS_S)
    return Try()


@fault("edge sends safe_stop: no_fresh_state", "the step to safe_stop on the wire")
def clock_stepped_simulator(rig: Rig, number: int) -> Try:
    """Simulator's wall clock 1 h ahead or back: no stamp is believed before the stop."""
    begin_s = time.monotonic()
    _step(rig.simulator, number)
    stop = rig.stop_command(begin_s)
    return Try(stop.seen_s - begin_s, rig.recovered_after_s(stop.seen_s), stop.reason)


def _step(process: Process, number: int) -> None:
    process.send(signal.SIGUSR1 if number % 2 == 0 else signal.SIGUSR2)


@fault(
    "edge sends safe_stop: inference_too_long",
    "last answered state at the probe to safe_stop on the wire",
    flows=True, alone=True,
)  # fmt: skip
def slow_inference(rig: Rig, number: int) -> Try:
    """Inference of about 2.5 T for 0.5 s."""
    begin_s = time.monotonic()
    rig.switch(SLOW, "")
    stop = rig.stop_command(begin_s)
    last_s = rig.last_answered_s(stop.seen_s)
    sleep_until(begin_s + SLOWED_S)
    rig.switch(SLOW, None)
    ended_s = time.monotonic()
    return Try(stop.seen_s - last_s, rig.recovered_after_s(ended_s), stop.reason)


@fault("drives on or safe_stop", GAP, alone=True)
def cpu_starved(rig: Rig, number: int) -> Try:
    """Two spinning processes for each core, 2 s."""
    begin_s = time.monotonic()
    words = [sys.executable, "-c", "while True: pass"]
    spinners = [subprocess.Popen(words) for _ in range(2 * (os.cpu_count() or 1))]
    time.sleep(STARVED_S)
    ended_s = time.monotonic()
    for spinner in spinners:
        spinner.kill()
        spinner.wait()
    recovered_s = rig.recovered_after_s(ended_s)
    stops = sum(begin_s < m.seen_s < ended_s and m.mode == SAFE_STOP for m in rig.timeline.modes)
    return Try(rig.longest_gap(begin_s, ended_s), recovered_s, figures={"safe stops": stops})


def _vehicle_is(word: str, rig: Rig, number: int) -> Try:
    """Judge that it stops for the fault, stays stopped after it, and drives once re-armed."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    rig.switch(VEHICLE, word)
    stop = rig.stop_command(begin_s)
    # A silent vehicle may still speak between the mark and the switch, and what it says counts.
    # What a stuck or lying vehicle says after the switch no longer counts.
    end_s = stop.seen_s if word == "silent" else begin_s
    last_s = max(s for s, _ in rig.timeline.feedback if s < end_s)
    sleep_until(begin_s + LASTS_S)
    said = any(f"vehicle_{word}" in line for seen_s, line in rig.edge.lines if seen_s > begin_s)
    rig.switch(VEHICLE, None)
    time.sleep(LASTS_S)
    wrong = drives_between(rig.timeline.commands, stop.seen_s)
    wrong += [] if said else [f"the log does not say vehicle_{word}"]
    return Try(stop.seen_s - last_s, rig.drive_again(), stop.reason, wrong=wrong)


for _word, _done, _after_s in (
    ("silent", "vehicle silent", 0.0),
    ("stuck", "vehicle's pedal stuck", 0.0),
    ("lying", "vehicle reports a speed that cannot be", 0.0),
    ("self_braking", "vehicle says that it brakes by itself while it is to drive", 0.1),
):
    fault(
        "edge sends safe_stop: vehicle_fault; stays until re-armed",
        "last good feedback at the probe to safe_stop on the wire",
        name=f"vehicle_{_word}", done=_done, rig={"vehicle": MOCK}, policy="steady", flows=True,
        reaction_limit_s=REACTION_LIMIT_S + _after_s,
    )(partial(_vehicle_is, _word))  # fmt: skip


@fault("nothing; then waits for a re-arm", "none", reaction_limit_s=None, policy="steady",
       rig={"vehicle": MOCK, "sender": True})  # fmt: skip
def vehicle_fault_between_episodes(rig: Rig, number: int) -> Try:
    """Emergency stop pressed for 1 s after the end of an episode."""
    rig.sender.end_episode()
    time.sleep(SETTLED_S)
    rig.switch(VEHICLE, "estop")
    time.sleep(LASTS_S)
    rig.switch(VEHICLE, None)
    time.sleep(SETTLED_S)
    since_s = time.monotonic()
    rig.sender.running.set()
    time.sleep(LASTS_S)
    wrong = drives_between(rig.timeline.commands, since_s)
    return Try(None, rig.drive_again(), "vehicle_fault", wrong=wrong)


@fault("stands; stays until an enable succeeds", "none", reaction_limit_s=None, policy="steady",
       rig={"vehicle": MOCK})  # fmt: skip
def vehicle_not_enabled(rig: Rig, number: int) -> Try:
    """Vehicle at fault; the driver's `enable` raises at the re-arm."""
    rig.switch(VEHICLE, "lying")
    rig.stop_command(time.monotonic())
    rig.switch(VEHICLE, "locked")
    time.sleep(LASTS_S)
    rig.rearm()
    rearmed_s = time.monotonic()
    time.sleep(LASTS_S)
    moved = [f.speed_mps for seen_s, f in rig.timeline.feedback if seen_s > rearmed_s]
    wrong = [f"it moves at {max(moved)} m/s"] if max(moved) > 0.0 else []
    wrong += [] if rig.timeline.commands[-1].mode == SAFE_STOP else ["it is told to drive"]
    rig.switch(VEHICLE, None)
    return Try(None, rig.drive_again(), "vehicle_fault", wrong=wrong)


@drives_on("recorder says so and ends; the recording is readable; drives on")
def disk_full(rig: Rig, number: int) -> Try:
    """Disk full while recording."""
    recorder, path = rig.start_recorder()
    # No file may grow beyond a limit: the same failing write as on a full disk.
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (FULL_AT_BYTES, FULL_AT_BYTES))
    status = recorder.wait()
    wrong = _too_few(states_in(path))
    if status != _CANNOT_WRITE:
        wrong.append(f"status {status}: {recorder.lines[-1:]}")
    if not any("error: recording" in line for _, line in recorder.lines):
        wrong.append(f"it does not say so: {recorder.lines[-1:]}")
    return Try(wrong=wrong)


@drives_on("at most 1 s of the recording is lost; drives on")
def recorder_killed(rig: Rig, number: int) -> Try:
    """SIGKILL to the recorder."""
    recorder, path = rig.start_recorder()
    time.sleep(RECORDED_S)
    sent = len(rig.timeline.states)
    recorder.kill()
    states, places = states_in(path), list(rig.timeline.states)
    last = (states[-1].session, states[-1].episode, states[-1].step) if states else None
    lost = sent - 1 - places.index(last) if last in places else sent
    lost_s = max(0, lost) * rig.period_s
    wrong = _too_few(states)
    wrong += [f"{lost_s:.1f} s lost"] if lost_s > MOST_LOST_S + rig.period_s / 2 else []
    return Try(wrong=wrong, figures={"lost, s": lost_s})


def states_in(path: Path) -> list[State]:
    """Return the states that can be read from a recording, whole or torn."""
    wire = heard_of(Recording(path), VEHICLE_ID)
    states = (decode_state(heard.payload) for heard in wire if heard.topic == "state")
    return [state for state in states if isinstance(state, State)]


def _too_few(states: list[State]) -> list[str]:
    return [f"only {len(states)} states can be read"] if len(states) < _FEWEST_STATES else []


SHORT_S, RIDING_S = 0.4, 0.3
"""An outage through which it rides, and where in one it surely rides."""
_LATER_S = REACTION_LIMIT_S + RIDE_S
_VEHICLE = {"ride_s": RIDE_S, "vehicle": MOCK}


def _link_slows(periods: float, rig: Rig, number: int) -> Try:
    """Judge that it stops though states go on coming, and that no late one is driven on."""
    time.sleep(SETTLED_S)
    begin_s, task = time.monotonic(), rig.task
    entries = task.observation.values()
    state_bytes = sum(math.prod(e.shape) * np.dtype(e.dtype).itemsize for e in entries)
    rig.relay.throttle(state_bytes / (periods * rig.period_s))
    stop = rig.logged_stop(begin_s)
    time.sleep(LASTS_S)
    late = drives_between(rig.timeline.commands, stop.seen_s)
    rig.relay.restore()
    ended_s = time.monotonic()
    recovered_s = rig.drive_again() if rig.has_vehicle else rig.recovered_after_s(ended_s)
    return Try(None, recovered_s, stop.reason, wrong=late)


for _name, _periods, _rig in (
    ("link_slow", 1.4, {}), ("ride_link_slow", 1.4, _VEHICLE), ("ride_link_slower", 4.0, _VEHICLE),
):  # fmt: skip
    fault("edge sends safe_stop: no_fresh_state", "none", _name,
          f"TCP slower than the states: one comes each {_periods:g} T, ever later",
          reaction_limit_s=None, policy="steady",
          rig={**_rig, "between": "relay"})(partial(_link_slows, _periods))  # fmt: skip


@fault("rides: nobody brakes", GAP, reaction_limit_s=_LATER_S, rig=_VEHICLE, policy="steady")
def ride_states_lost(rig: Rig, number: int) -> Try:
    """No states for 0.4 s."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    rig.simulator.send(signal.SIGSTOP)
    sleep_until(begin_s + SHORT_S)
    rig.simulator.send(signal.SIGCONT)
    return _rode(rig, begin_s)


@fault("rides: nobody brakes", GAP, reaction_limit_s=_LATER_S, policy="steady",
       rig={**_VEHICLE, "between": "relay"})  # fmt: skip
def ride_link_stalled(rig: Rig, number: int) -> Try:
    """TCP held for 0.4 s, both ways, then all at once."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    rig.relay.stall()
    sleep_until(begin_s + SHORT_S)
    rig.relay.restore()
    return _rode(rig, begin_s)


def _rode(rig: Rig, begin_s: float) -> Try:
    """Judge that nobody braked since a moment and that it drives on."""
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
    """Judge that it stops for what is done while it rides, and stays stopped."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    rig.simulator.send(signal.SIGSTOP)
    sleep_until(begin_s + RIDING_S)
    since_s = do(rig)
    stop = rig.stop_command(begin_s)
    rig.simulator.send(signal.SIGCONT)
    rig.switch(VEHICLE, None)
    time.sleep(LASTS_S)
    wrong = drives_between(rig.timeline.commands, stop.seen_s)
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
    fault(f"edge sends safe_stop: {_reason}; stays stopped", "cause to safe_stop on the wire",
          f"ride_{_name}", _done, reaction_limit_s=_limit_s, recovery_limit_s=None, rig=_VEHICLE,
          policy="steady")(partial(_stops, _reason, _do))  # fmt: skip
fault("simulator brakes by itself: no_command", "last drive command to the simulator's brake",
      "ride_edge_killed", "SIGKILL to the edge runtime, which the simulator rides out; a new one",
      reaction_limit_s=_LATER_S, rig={"ride_s": RIDE_S})(edge_killed)  # fmt: skip
