"""Faults of both ends, of the link between them, of the mock vehicle and of a recorder.

A function takes a driving rig, does a fault once, undoes it, and returns a `Try`. A `Row` in ROWS
describes the fault and the expected reaction. `run.py` joins the tables.

The last rows are of a drive with ride-through of RIDE_S: a shorter outage brakes nothing, a longer
one brakes RIDE_S later. A fault of the vehicle and a stop end the ride-through at once.
"""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bridge.recording import Recording, heard_of
from edge_runtime.wire import DRIVE, SAFE_STOP, State, decode_state, encode
from hil_tests.faults.inside import MOCK, SLOW, SOURCE, VEHICLE
from hil_tests.faults.observe import REACTION_LIMIT_S, RECOVERY_LIMIT_S
from hil_tests.faults.policies import VEHICLE_ID
from hil_tests.faults.rig import Rig, noisy_state
from hil_tests.processes import wait_until
from trainer.util import cores


@dataclass(frozen=True)
class Try:
    """One fault, done and undone.

    ``reaction_s``: from the last good state or feedback to the safe stop on the wire (if the wire
    is cut, in the log), or from the last drive command to the simulator's own brake; if the drive
    goes on, the longest gap between commands. ``recovery_s``: from the fault's end to the first
    drive command.
    """

    reaction_s: float | None = None
    recovery_s: float | None = None
    reason: str = ""
    wrong: list[str] = field(default_factory=list)  # Deviations, besides the times
    rejected: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    name: str
    done: str
    expected: str
    run: Callable[[Rig], Try]  # Called with a rig that drives; ``rig.number`` is the try's
    reaction_limit_s: float | None = REACTION_LIMIT_S
    recovery_limit_s: float | None = RECOVERY_LIMIT_S
    rig: Mapping[str, Any] = field(default_factory=dict)  # Options of the Rig
    policy: str = "given"  # ``given``, or one of `policies.POLICIES`.
    flows: bool = False
    """Whether the simulator's states go on through the fault: if they do not, the machine stalled,
    and the try is repeated (and counted as disturbed)."""
    alone: bool = False  # Whether it needs the machine for itself
    goes_on: bool = False  # Whether the drive goes on through the fault
    counted: Literal["", "edge", "simulator"] = ""
    """The end whose rejection counts must equal the messages that a try sent to be rejected. The
    simulator reports at the drive's end, so each try then has a rig of its own."""


def drives_on(
    name: str, done: str, run: Callable[[Rig], Try], expected: str = "drives on", **options: Any
) -> Row:
    """Make a row of a fault through which the drive goes on; ``run`` may judge more."""
    through = {"goes_on": True, "recovery_limit_s": None, "flows": True}
    return Row(name, done, expected, run, **{**through, **options})


LASTS_S = 1.0
STALLED_S = 0.6
"""Shorter than Zenoh's lease, so that the connection lives and brings all that it held at once. A
T of more than 0.24 s needs a longer one."""
SETTLED_S = 0.5
"""Steady drive before a fault: a vehicle may lag behind its last set-point."""
_FULL_AT_BYTES = 200_000  # Several of the recorder's chunks
_CANNOT_WRITE = 1  # Exit status of a recorder that cannot write
_FEWEST_STATES = 5


def at_any_phase(rig: Rig) -> None:
    """Wait a random part of the control period, so that faults come at any phase of it."""
    time.sleep(float(np.random.default_rng(rig.number).uniform(0, rig.period_s)))


def sleep_until(time_s: float) -> None:
    time.sleep(max(0.0, time_s - time.monotonic()))


def edge_killed(rig: Rig) -> Try:
    begin_s = time.monotonic()
    rig.edge.kill()
    reaction_s = rig.own_brake_s(begin_s) - rig.last_drive_s()
    rig.edge = rig.start_edge()
    ended_s = rig.edge.wait_for_line("ready")
    return Try(reaction_s, rig.recovered_after_s(ended_s), "no_command")


def edge_stopped(rig: Rig) -> Try:
    begin_s = time.monotonic()
    rig.edge.send(signal.SIGSTOP)
    reaction_s = rig.own_brake_s(begin_s) - rig.last_drive_s()
    sleep_until(begin_s + LASTS_S)
    ended_s = time.monotonic()
    rig.edge.send(signal.SIGCONT)
    recovered_s = rig.recovered_after_s(ended_s)
    return Try(reaction_s, recovered_s, "no_command", wrong=_stopped_first(rig, ended_s))


def _stopped_first(rig: Rig, since_s: float) -> list[str]:
    """Return a line if commands to piled-up states were drives."""
    modes = (c.mode for c in rig.timeline.commands if c.sent_s > since_s)
    return ["drove on without a safe stop"] if next(modes, "") == DRIVE else []


def simulator_killed(rig: Rig) -> Try:
    begin_s, states = time.monotonic(), rig.timeline.states
    rig.simulator.kill()
    stop = rig.stop_command(begin_s)
    last_s, count = rig.last_state_s(before_s=stop.seen_s), len(states)
    rig.simulator = rig.start_simulator()
    ended_s = wait_until(lambda: [*states.values()][count:], "the new simulator's states")[0]
    return Try(stop.seen_s - last_s, rig.recovered_after_s(ended_s), stop.reason)


def _link_fails(
    rig: Rig, fail: Callable[[], None], restore: Callable[[], None], lasts_s: float = 0.0
) -> Try:
    """Judge that both ends stop, and that no state that was held up is driven on."""
    begin_s = time.monotonic()
    fail()
    stop_s, reason = rig.logged_stop(begin_s)
    rig.own_brake_s(begin_s)
    sleep_until(begin_s + max(lasts_s, 2.5 * rig.period_s))  # longer than silence
    cut_until_s = time.monotonic()
    restore()
    recovered_s, wrong = rig.recovered_after_s(time.monotonic()), _stopped_first(rig, cut_until_s)
    return Try(stop_s - rig.last_state_s(before_s=begin_s), recovered_s, reason, wrong)


def router_restarted(rig: Rig) -> Try:
    def restart() -> None:
        rig.router = rig.start_router()
        rig.router.wait_for_line("ready")

    return _link_fails(rig, rig.router.kill, restart)


_STEPS = (signal.SIGUSR1, signal.SIGUSR2)  # An hour ahead, and back


def clock_stepped_edge(rig: Rig) -> Try:
    rig.edge.send(_STEPS[rig.number % 2])
    time.sleep(LASTS_S)
    return Try()


def clock_stepped_simulator(rig: Rig) -> Try:
    begin_s = time.monotonic()
    rig.simulator.send(_STEPS[rig.number % 2])
    stop = rig.stop_command(begin_s)
    return Try(stop.seen_s - begin_s, rig.recovered_after_s(stop.seen_s), stop.reason)


def slow_inference(rig: Rig) -> Try:
    begin_s, states = time.monotonic(), rig.timeline.states
    rig.switch(SLOW, "")
    stop = rig.stop_command(begin_s)
    before = [c for c in rig.timeline.commands if c.seen_s < stop.seen_s]
    last_s = max(states.get(c.place, 0.0) for c in before if c.mode == DRIVE)
    sleep_until(begin_s + 0.5)
    rig.switch(SLOW, None)
    return Try(stop.seen_s - last_s, rig.recovered_after_s(time.monotonic()), stop.reason)


def cpu_starved(rig: Rig) -> Try:
    begin_s = time.monotonic()
    words = [sys.executable, "-c", "while True: pass"]
    spinners = [subprocess.Popen(words) for _ in range(2 * cores())]
    time.sleep(2.0)
    ended_s = time.monotonic()
    for spinner in spinners:
        spinner.kill()
        spinner.wait()
    recovered_s = rig.recovered_after_s(ended_s)
    return Try(rig.timeline.longest_gap_s(begin_s, ended_s), recovered_s)


def _vehicle_is(word: str, rig: Rig) -> Try:
    """Judge that it stops for the fault, stays stopped after it, and drives once re-armed."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    rig.switch(VEHICLE, word)
    stop = rig.stop_command(begin_s)
    # A silent vehicle may still report between begin_s and the switch, and that report counts.
    # Reports of a stuck or lying vehicle after the switch do not count.
    end_s = stop.seen_s if word == "silent" else begin_s
    last_s = max(s for s, _ in rig.timeline.feedback if s < end_s)
    sleep_until(begin_s + LASTS_S)
    logged = any(f"vehicle_{word}" in line for seen_s, line in rig.edge.lines if seen_s > begin_s)
    rig.switch(VEHICLE, None)
    time.sleep(LASTS_S)
    wrong = rig.timeline.drives_between(stop.seen_s)
    wrong += [] if logged else [f"the log does not say vehicle_{word}"]
    return Try(stop.seen_s - last_s, rig.drive_again(), stop.reason, wrong)


def vehicle_fault_between_episodes(rig: Rig) -> Try:
    rig.sender.running.clear()
    rig.sender.send_next(final=True)
    time.sleep(SETTLED_S)
    rig.switch(VEHICLE, "estop")
    time.sleep(LASTS_S)
    rig.switch(VEHICLE, None)
    time.sleep(SETTLED_S)
    since_s = time.monotonic()
    rig.sender.running.set()
    time.sleep(LASTS_S)
    wrong = rig.timeline.drives_between(since_s)
    return Try(None, rig.drive_again(), "vehicle_fault", wrong)


def vehicle_not_enabled(rig: Rig) -> Try:
    rig.switch(VEHICLE, "lying")
    rig.stop_command(time.monotonic())
    rig.switch(VEHICLE, "locked")
    time.sleep(LASTS_S)
    rig.rearm()
    rearmed_s = time.monotonic()
    time.sleep(LASTS_S)
    most_mps = max(f.speed_mps for seen_s, f in rig.timeline.feedback if seen_s > rearmed_s)
    wrong = [f"it moves at {most_mps} m/s"] if most_mps > 0.0 else []
    wrong += [] if rig.timeline.commands[-1].mode == SAFE_STOP else ["it is told to drive"]
    rig.switch(VEHICLE, None)
    return Try(None, rig.drive_again(), "vehicle_fault", wrong)


def _source_is(word: str, rig: Rig) -> Try:
    """Judge that it stops, that `sense` says why and ends, and that no new one drives by itself."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    rig.switch(SOURCE, word)
    stop = rig.stop_command(begin_s)
    last_s = rig.last_state_s(before_s=stop.seen_s)
    status, text = rig.simulator.wait(), rig.simulator.errors
    wrong = [] if status == 1 and "has failed" in text else [f"status {status}: {text[-200:]!r}"]
    rig.switch(SOURCE, None)
    rig.simulator = rig.start_simulator()
    rig.simulator.wait_for_line("ready")
    time.sleep(LASTS_S)
    wrong += rig.timeline.drives_between(stop.seen_s)
    return Try(stop.seen_s - last_s, rig.drive_again(), stop.reason, wrong)


def disk_full(rig: Rig) -> Try:
    recorder, path = rig.start_recorder()
    # A limit of the file size makes writes fail as on a full disk.
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (_FULL_AT_BYTES, _FULL_AT_BYTES))
    is_told = recorder.wait() == _CANNOT_WRITE and "error: recording" in recorder.errors
    wrong = [] if is_told else [f"it said {recorder.errors[-200:]!r}"]
    return Try(wrong=wrong + _too_few(states_in(path)))


def recorder_killed(rig: Rig) -> Try:
    recorder, path = rig.start_recorder()
    time.sleep(2.5)
    sent = len(rig.timeline.states)
    recorder.kill()
    states, places = states_in(path), list(rig.timeline.states)
    last = (states[-1].session, states[-1].episode, states[-1].step) if states else None
    lost = sent - 1 - places.index(last) if last in places else sent
    lost_s = max(0, lost) * rig.period_s
    wrong = [f"{lost_s:.1f} s lost"] if lost_s > 1.0 + rig.period_s / 2 else []
    return Try(wrong=wrong + _too_few(states))


def states_in(path: Path) -> list[State]:
    """Return the readable states of a recording, whole or torn."""
    wire = heard_of(Recording(path), VEHICLE_ID)
    states = (decode_state(heard.payload) for heard in wire if heard.topic == "state")
    return [state for state in states if isinstance(state, State)]


def _too_few(states: list[State]) -> list[str]:
    return [f"only {len(states)} states can be read"] if len(states) < _FEWEST_STATES else []


RIDE_S, SHORT_S, RIDING_S = 0.5, 0.4, 0.3
"""Longest ride-through; an outage that it covers; time into an outage at which it surely rides."""


def _link_slows(periods: float, rig: Rig) -> Try:
    """Judge that it stops although states still come, and that no late one is driven on."""
    time.sleep(SETTLED_S)
    begin_s, state_bytes = time.monotonic(), len(encode(noisy_state(0, rig.task)))
    rig.relay.throttle(state_bytes / (periods * rig.period_s))
    stop_s, reason = rig.logged_stop(begin_s)
    time.sleep(LASTS_S)
    late = rig.timeline.drives_between(stop_s)
    rig.relay.restore()
    ended_s = time.monotonic()
    recovered_s = rig.drive_again() if rig.has_vehicle else rig.recovered_after_s(ended_s)
    return Try(None, recovered_s, reason, late)


def _rides(rig: Rig, fail: Callable[[], None], restore: Callable[[], None]) -> Try:
    """Judge that neither end brakes in a short outage, and that the drive goes on."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    fail()
    sleep_until(begin_s + SHORT_S)
    restore()
    recovered_s = rig.recovered_after_s(time.monotonic())
    time.sleep(SETTLED_S)
    end_s = time.monotonic()
    braked_s = [at_s for at_s, on in rig.brakes() if on]
    braked_s += [at_s for at_s, feedback in rig.timeline.feedback if feedback.self_braking]
    wrong = rig.timeline.stops_between(begin_s, end_s)
    wrong += ["braked by itself"] * any(begin_s < at_s < end_s for at_s in braked_s)
    return Try(rig.timeline.longest_gap_s(begin_s, end_s), recovered_s, wrong=wrong)


def _stops(reason: str, do: Callable[[Rig], Any] | None, rig: Rig) -> Try:
    """Judge that it stops for ``do`` during a ride-through, and stays stopped."""
    time.sleep(SETTLED_S)
    begin_s = time.monotonic()
    rig.simulator.send(signal.SIGSTOP)
    sleep_until(begin_s + RIDING_S)
    now_s = time.monotonic()
    since_s = now_s if do else rig.last_state_s(before_s=now_s)
    if do:
        do(rig)
    stop = rig.stop_command(begin_s)
    rig.simulator.send(signal.SIGCONT)
    rig.switch(VEHICLE, None)
    time.sleep(LASTS_S)
    wrong = rig.timeline.drives_between(stop.seen_s)
    wrong += [f"stopped for {stop.reason}"] * (stop.reason != reason)
    if reason == "runtime_ended":
        rig.edge.wait()
        rig.edge = rig.start_edge()
        rig.edge.wait_for_line("ready")
    else:
        rig.rearm()
    rig.wait_until_driving()
    return Try(stop.seen_s - since_s, None, stop.reason, wrong)


_OWN = "simulator brakes by itself: no_command"
_BOTH = "both ends stop, each by itself"
_STOP = "edge sends safe_stop: no_fresh_state"
_REARM = "edge sends safe_stop: vehicle_fault; stays until re-armed"
_RIDES = "rides: nobody brakes"
_LATER_S = REACTION_LIMIT_S + RIDE_S
_RELAY, _RIDES_ON = {"between": "relay"}, {"settings": f"[ride_through]\nmax_s = {RIDE_S}"}
_RIDING = {**_RIDES_ON, "vehicle": MOCK}
_STEADY: Any = {"policy": "steady"}
_MOCKED: Any = {**_STEADY, "rig": {"vehicle": MOCK}}
_STUCK: Any = {**_MOCKED, "flows": True}
_SLOW: Any = {**_STEADY, "reaction_limit_s": None}
_RIDDEN: Any = {**_STEADY, "rig": _RIDING, "reaction_limit_s": _LATER_S}
_ENDED: Any = {**_RIDDEN, "recovery_limit_s": None}
ROWS = [
    Row("edge_killed", "SIGKILL to the edge runtime; a new one", _OWN, edge_killed),
    Row("edge_stopped", "Edge runtime stopped for 1 s and continued", _OWN, edge_stopped,
        flows=True),
    Row("simulator_killed", "SIGKILL to the simulator; a new one", _STOP, simulator_killed),
    Row("link_cut", "TCP cut for 1 s and restored", _BOTH,
        lambda rig: _link_fails(rig, rig.relay.cut, rig.relay.restore, LASTS_S), rig=_RELAY),
    Row("link_stalled", "TCP held for 0.6 s, then all at once", _BOTH,
        lambda rig: _link_fails(rig, rig.relay.stall, rig.relay.restore, STALLED_S), rig=_RELAY),
    Row("router_restarted", "SIGKILL to the router; a new one", _BOTH, router_restarted,
        rig={"between": "router"}),
    drives_on("clock_stepped_edge", "Edge's wall clock 1 h ahead and back", clock_stepped_edge),
    Row("clock_stepped_simulator",
        "Simulator's wall clock 1 h ahead or back: no stamp is believed before the stop",
        _STOP, clock_stepped_simulator),
    Row("slow_inference", "Inference of about 2.5 T for 0.5 s",
        "edge sends safe_stop: inference_too_long", slow_inference, flows=True, alone=True),
    Row("cpu_starved", "Two spinning processes for each core, 2 s", "drives on or safe_stop",
        cpu_starved, alone=True),
    Row("vehicle_silent", "vehicle silent", _REARM, partial(_vehicle_is, "silent"), **_STUCK),
    Row("vehicle_stuck", "vehicle's pedal stuck", _REARM, partial(_vehicle_is, "stuck"), **_STUCK),
    Row("vehicle_lying", "vehicle reports a speed that cannot be", _REARM,
        partial(_vehicle_is, "lying"), **_STUCK),
    Row("vehicle_self_braking", "vehicle says that it brakes by itself while it is to drive",
        _REARM, partial(_vehicle_is, "self_braking"), **_STUCK,
        reaction_limit_s=REACTION_LIMIT_S + 0.1),
    *(Row(f"source_{word}", f"a robot's own sensors: observe() {does}; a new source",
          "edge sends safe_stop: no_fresh_state; stays until re-armed", partial(_source_is, word),
          policy="steady", rig={"vehicle": MOCK, "senses": True})
      for word, does in (("late", "takes 3 T"), ("hangs", "never ends"), ("raises", "raises"))),
    Row("vehicle_fault_between_episodes",
        "Emergency stop pressed for 1 s after the end of an episode",
        "nothing; then waits for a re-arm", vehicle_fault_between_episodes, **_SLOW,
        rig={"vehicle": MOCK, "sender": True, "settings": '[vehicle]\nrearm = "once"'}),
    Row("vehicle_not_enabled", "Vehicle at fault; the driver's `enable` raises at the re-arm",
        "stands; stays until an enable succeeds", vehicle_not_enabled, **_MOCKED,
        reaction_limit_s=None),
    drives_on("disk_full", "Disk full while recording", disk_full,
              "recorder says so and ends; the recording is readable; drives on"),
    drives_on("recorder_killed", "SIGKILL to the recorder", recorder_killed,
              "at most 1 s of the recording is lost; drives on"),
    Row("link_slow", "TCP slower than the states: one comes each 1.4 T, ever later", _STOP,
        partial(_link_slows, 1.4), **_SLOW, rig=_RELAY),
    Row("ride_link_slow", "TCP slower than the states: one comes each 1.4 T, ever later", _STOP,
        partial(_link_slows, 1.4), **_SLOW, rig={**_RIDING, **_RELAY}),
    Row("ride_link_slower", "TCP slower than the states: one comes each 4 T, ever later", _STOP,
        partial(_link_slows, 4.0), **_SLOW, rig={**_RIDING, **_RELAY}),
    Row("ride_states_lost", "No states for 0.4 s", _RIDES,
        lambda rig: _rides(rig, partial(rig.simulator.send, signal.SIGSTOP),
                           partial(rig.simulator.send, signal.SIGCONT)), **_RIDDEN),
    Row("ride_link_stalled", "TCP held for 0.4 s, both ways, then all at once", _RIDES,
        lambda rig: _rides(rig, rig.relay.stall, rig.relay.restore),
        **{**_RIDDEN, "rig": {**_RIDING, **_RELAY}}),
    Row("ride_too_long", "no states for longer than it may ride", f"{_STOP}; stays stopped",
        partial(_stops, "no_fresh_state", None), **_ENDED),
    Row("ride_vehicle_fault", "vehicle reports what cannot be while it is ridden",
        "edge sends safe_stop: vehicle_fault; stays stopped",
        partial(_stops, "vehicle_fault", lambda rig: rig.switch(VEHICLE, "lying")),
        **{**_ENDED, "reaction_limit_s": REACTION_LIMIT_S}),
    Row("ride_ended", "edge runtime ended while it rides; a new one",
        "edge sends safe_stop: runtime_ended; stays stopped",
        partial(_stops, "runtime_ended", lambda rig: rig.edge.send(signal.SIGTERM)),
        **{**_ENDED, "reaction_limit_s": REACTION_LIMIT_S}),
    Row("ride_edge_killed",
        "SIGKILL to the edge runtime, which the simulator rides out; a new one", _OWN,
        edge_killed, reaction_limit_s=_LATER_S, rig=_RIDES_ON),
]  # fmt: skip
