"""Faults of the ends and of what is between them: killed, stopped, cut, stalled, stepped, slow."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import time

import numpy as np

from edge_runtime.wire import CONTROL_PERIOD_S, SAFE_STOP
from hil_tests.faults.link import address
from hil_tests.faults.processes import wait_until
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Row, Try
from hil_tests.faults.timeline import last_drive_s, longest_gap_s, stops_between
from hil_tests.faults.waits import (
    drive_after_s,
    last_answered_s,
    last_state_s,
    logged_stop,
    must_stop_first,
    own_brake_s,
    stop_command,
)

STOPPED_S = 1.0
CUT_S = 1.0
STALLED_S = 0.6
"""Shorter than Zenoh's lease, so that the connection lives and brings all that it held at once."""
BRIGHT_S = 0.5
STARVED_S = 2.0
STEPPED_S = 1.0


def at_any_phase(number: int) -> None:
    """Wait a part of the control period, so that faults do not all come at the same moment."""
    time.sleep(float(np.random.default_rng(number).uniform(0, CONTROL_PERIOD_S)))


def edge_killed(rig: Rig, number: int) -> Try:
    """SIGKILL; the simulator brakes by itself; a new edge runtime drives on."""
    at_any_phase(number)
    begin_s = rig.mark()
    rig.edge.kill()
    reaction_s = own_brake_s(rig, begin_s) - last_drive_s(rig.timeline)
    rig.edge = rig.start_edge()
    ended_s = rig.edge.wait_for_line("ready")
    return Try(reaction_s, drive_after_s(rig, ended_s) - ended_s, "no_command")


def edge_stopped(rig: Rig, number: int) -> Try:
    """SIGSTOP for a second: the simulator brakes by itself; what piled up is not driven on."""
    at_any_phase(number)
    begin_s = rig.mark()
    rig.edge.send(signal.SIGSTOP)
    reaction_s = own_brake_s(rig, begin_s) - last_drive_s(rig.timeline)
    time.sleep(max(0.0, begin_s + STOPPED_S - time.monotonic()))
    ended_s = rig.mark()
    rig.edge.send(signal.SIGCONT)
    recovery_s = drive_after_s(rig, ended_s) - ended_s
    return Try(reaction_s, recovery_s, "no_command", wrong=must_stop_first(rig, ended_s))


def simulator_killed(rig: Rig, number: int) -> Try:
    """SIGKILL; the edge runtime's safe stop; a new simulator has a new session."""
    at_any_phase(number)
    assert rig.simulator is not None
    begin_s = rig.mark()
    rig.simulator.kill()
    stop = stop_command(rig, begin_s)
    last_s = last_state_s(rig, before_s=stop.seen_s)
    known = set(rig.timeline.states)
    rig.simulator = rig.start_simulator()
    new = wait_until(lambda: set(rig.timeline.states) - known, "the new simulator's states")
    ended_s = min(rig.timeline.states[place] for place in new)
    return Try(stop.seen_s - last_s, drive_after_s(rig, ended_s) - ended_s, stop.reason)


def link_cut(rig: Rig, number: int) -> Try:
    """Every connection broken and refused for a second: both ends stop, each by itself."""
    assert rig.link is not None
    at_any_phase(number)
    begin_s, drive_s = rig.mark(), last_drive_s(rig.timeline)
    rig.link.cut()
    last_s = rig.link.last_state_s
    reaction_s, reason = logged_stop(rig, begin_s)
    brake_s = own_brake_s(rig, begin_s) - max(drive_s, last_drive_s(rig.timeline))
    time.sleep(max(0.0, begin_s + CUT_S - time.monotonic()))
    ended_s = rig.mark()
    rig.link.restore()
    recovery_s = drive_after_s(rig, ended_s) - ended_s
    figures = {"simulator brakes, ms": brake_s * 1e3}
    return Try(reaction_s - last_s, recovery_s, reason, figures=figures)


def link_stalled(rig: Rig, number: int) -> Try:
    """The link holds everything for a while, then brings it all at once."""
    assert rig.link is not None
    at_any_phase(number)
    begin_s = rig.mark()
    rig.link.stall()
    reaction_s, reason = logged_stop(rig, begin_s)
    last_s = rig.link.last_state_s
    time.sleep(max(0.0, begin_s + STALLED_S - time.monotonic()))
    ended_s = rig.mark()
    rig.link.restore()
    recovery_s = drive_after_s(rig, ended_s) - ended_s
    wrong = must_stop_first(rig, ended_s)
    return Try(reaction_s - last_s, recovery_s, reason, wrong=wrong)


def router_restarted(rig: Rig, number: int) -> Try:
    """SIGKILL to the router between the ends, and a new one on the same port."""
    assert rig.router is not None
    at_any_phase(number)
    begin_s = rig.mark()
    rig.router.kill()
    reaction_s, reason = logged_stop(rig, begin_s)
    rig.router = rig.start_router()
    ended_s = wait_until(lambda: listens_s(rig.router_endpoint), "the new router")
    recovery_s = drive_after_s(rig, ended_s) - ended_s
    return Try(reaction_s - last_state_s(rig, before_s=begin_s), recovery_s, reason)


def edge_clock_stepped(rig: Rig, number: int) -> Try:
    """The edge runtime's wall clock jumps an hour ahead, then back."""
    return _stepped(rig, rig.edge, number)


def simulator_clock_stepped(rig: Rig, number: int) -> Try:
    """The simulator's wall clock jumps an hour ahead, then back."""
    return _stepped(rig, rig.simulator, number)


def slow_inference(rig: Rig, number: int) -> Try:
    """Frames on which the policy takes longer than T; the last good state is the one before."""
    at_any_phase(number)
    begin_s = rig.mark()
    rig.bright(True)
    try:
        stop = stop_command(rig, begin_s)
        last_s = last_answered_s(rig, stop.seen_s)
        time.sleep(max(0.0, begin_s + BRIGHT_S - time.monotonic()))
    finally:
        rig.bright(False)
    ended_s = rig.mark()
    return Try(stop.seen_s - last_s, drive_after_s(rig, ended_s) - ended_s, stop.reason)


def cpu_starved(rig: Rig, number: int) -> Try:
    """Two spinning processes for each core, at normal priority, for two seconds."""
    at_any_phase(number)
    spinners = [
        multiprocessing.get_context("spawn").Process(target=spin, daemon=True)
        for _ in range(2 * (os.cpu_count() or 1))
    ]
    begin_s = rig.mark()
    for spinner in spinners:
        spinner.start()
    time.sleep(STARVED_S)
    ended_s = rig.mark()
    for spinner in spinners:
        spinner.kill()
        spinner.join()
    recovery_s = drive_after_s(rig, ended_s) - ended_s
    gap_s = longest_gap_s((c.seen_s for c in rig.timeline.commands), begin_s, ended_s)
    stops = sum(begin_s < m.seen_s < ended_s and m.mode == SAFE_STOP for m in rig.timeline.modes)
    return Try(gap_s, recovery_s, figures={"safe stops": stops})


def listens_s(endpoint: str) -> float | None:
    """Now, if somebody listens there."""
    try:
        socket.create_connection(address(endpoint), timeout=0.1).close()
    except OSError:
        return None
    return time.monotonic()


def spin() -> None:
    """Keep a core busy."""
    while True:
        pass


def _stepped(rig: Rig, process: object, number: int) -> Try:
    at_any_phase(number)
    begin_s = rig.mark()
    process.send(signal.SIGUSR1 if number % 2 == 0 else signal.SIGUSR2)  # type: ignore[attr-defined]
    time.sleep(STEPPED_S)
    end_s = rig.mark()
    commands = list(rig.timeline.commands)
    gap_s = longest_gap_s((c.seen_s for c in commands), begin_s, end_s)
    return Try(gap_s, wrong=stops_between(commands, begin_s, end_s))


_EXPECT_OWN = "simulator brakes by itself: no_command"
_EXPECT_EDGE = "edge sends safe_stop: no_fresh_state"
_EXPECT_BOTH = "both ends stop, each by itself"
_TO_BRAKE = "last drive command to the simulator's brake"
_TO_STOP = "last state at the probe to safe_stop on the wire"

ROWS = (
    Row("edge_killed", "SIGKILL to the edge runtime; a new one", _EXPECT_OWN, _TO_BRAKE,
        edge_killed),
    Row("edge_stopped", "edge runtime stopped for 1 s and continued", _EXPECT_OWN, _TO_BRAKE,
        edge_stopped, flows=True),
    Row("simulator_killed", "SIGKILL to the simulator; a new one", _EXPECT_EDGE, _TO_STOP,
        simulator_killed),
    Row("link_cut", "TCP cut for 1 s and restored", _EXPECT_BOTH,
        "last state through the link to safe_stop in the edge's log", link_cut,
        rig={"between": "link"}),
    Row("link_stalled", "TCP held for 0.6 s, then all at once", _EXPECT_BOTH,
        "last state through the link to safe_stop in the edge's log", link_stalled,
        rig={"between": "link"}),
    Row("router_restarted", "SIGKILL to the router; a new one", _EXPECT_BOTH,
        "last state at the router to safe_stop in the edge's log", router_restarted,
        rig={"between": "router"}),
    Row("clock_stepped_edge", "edge's wall clock 1 h ahead and back", "drives on",
        "longest gap between commands", edge_clock_stepped, recovery_limit_s=None, flows=True,
        by_arrival=True),
    Row("clock_stepped_simulator", "simulator's wall clock 1 h ahead and back", "drives on",
        "longest gap between commands", simulator_clock_stepped, recovery_limit_s=None, flows=True),
    Row("slow_inference", "inference of about 2.5 T for 0.5 s",
        "edge sends safe_stop: inference_too_long",
        "last answered state at the probe to safe_stop on the wire", slow_inference,
        policy="slow", flows=True, alone=True),
    Row("cpu_starved", "two spinning processes for each core, 2 s", "drives on or safe_stop",
        "longest gap between commands", cpu_starved, alone=True),
)  # fmt: skip
