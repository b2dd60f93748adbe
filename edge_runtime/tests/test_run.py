"""The real process against a real simulator session. Limits are loose: machines are busy."""

import contextlib
import itertools
import os
import re
import signal
import time
from typing import Any

import pytest
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.commands import run_command
from hil_tests.tests.shared.drives import Simulator, run_edge
from hil_tests.tests.shared.messages import WHITE, frames, make_state
from hil_tests.tests.shared.policies import T

from edge_runtime.reach import free_endpoint

WHITE_FRAMES = {"observation": frames(WHITE)}


@pytest.fixture
def edge_and_simulator(make_policy):
    """Starts a runtime with a policy of a kind and a simulator that has seen it."""
    with contextlib.ExitStack() as opened:

        def start(kind="constant", *flags, **options):
            endpoint = free_endpoint()
            simulator = opened.enter_context(Simulator(endpoint))
            policy = make_policy(kind, **options)
            edge = opened.enter_context(run_edge(*policy.flags, "--connect", endpoint, *flags))
            simulator.wait_for_edge()
            return edge, simulator

        yield start


def drive(simulator, steps):
    commands = []
    for step in steps:
        begun_s = time.monotonic()
        commands.append(simulator.ask(make_state(step)))
        time.sleep(max(0.0, T - (time.monotonic() - begun_s)))
    return commands


def last_health(simulator, condition):
    return wait_until(
        lambda: next(filter(condition, reversed(simulator.health)), None), "such a health message"
    )


def command_of_reason(simulator, reason):
    return wait_until(
        lambda: next((c for c in simulator.drain() if c.reason == reason), None), reason
    )


def test_a_runtime_without_a_vehicle_from_its_first_state_to_its_end(
    edge_and_simulator, make_policy
):
    edge, simulator = edge_and_simulator("mean")
    assert edge.output.startswith("ready ")
    # It hears, and counts, only what was put to its own key.
    for key in ("phil/*/state", "phil/hunter$*/state", "*/hunter01/state", "**/state"):
        simulator.send(make_state(0), key)
    for step in range(50):
        level = step * 5
        command = simulator.ask(make_state(step, observation=frames(level)))
        assert command.received_ns <= command.sent_ns
        if command.mode == "drive":
            assert command.action == pytest.approx([level / 127.5 - 1], abs=1e-6)
        else:  # this machine paused for 2 T between two states
            assert step > 0
            assert command.reason == "no_fresh_state"
    simulator.ask(make_state(50, final=True))
    # In standby no safe stop comes in between.
    bad = {
        "stale": make_state(49),
        "duplicate": make_state(50),
        "schema": make_state(51, schema=1),
        "observation": make_state(51, observation={"frames": bytes(10)}),
        "oversized": make_state(51, observation={"frames": bytes(100_000)}),
        "not_finite": make_state(51, speed_mps=float("inf")),
        "malformed": b"not a map",
    }
    for message in bad.values():
        simulator.send(message)
    health = last_health(simulator, lambda h: sum(h.rejected.values()) == len(bad))
    assert (health.rejected, health.accepted) == (dict.fromkeys(bad, 1), 51)
    assert simulator.drain() == []
    status = simulator.query("status")
    assert (status["accepted"], status["manifest"]["task"]) == (51, "left_turn")
    assert 0 < status["inference_ms"]["max"] <= status["command_ms"]["max"]
    assert 10 < status["rss_mb"] < 500
    assert not simulator.query("rearm")["accepted"]
    place = ("--connect", simulator.endpoint)
    assert re.search(r"\naccepted +51\n", run_command("status", *place).stdout)
    # A second one with the same vehicle id does not start.
    second = run_command("run", *make_policy().flags, *place)
    assert (second.returncode, second.stdout, second.stderr.count("\n")) == (2, "", 1)
    assert simulator.ask(make_state(51, final=True)).mode == "drive"
    assert simulator.alive.is_set()
    begun_s = time.monotonic()
    assert edge.end() == 0
    assert time.monotonic() - begun_s < 5.0
    assert "Traceback" not in edge.errors
    wait_until(lambda: not simulator.alive.is_set(), "the token is gone")


def test_a_reader_that_stands_still_holds_neither_the_watchdog_nor_the_end(make_policy):
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while os.write(writer, bytes(4096)):
            pass
    os.set_blocking(writer, True)
    endpoint = free_endpoint()
    run = ["run", *make_policy("constant").flags, "--connect", endpoint, "--vehicle", "mock"]
    options: Any = {"stdout": writer, "stderr": writer}
    with Simulator(endpoint) as simulator, Process("edge_runtime", *run, **options) as edge:
        simulator.wait_for_edge()
        assert drive(simulator, range(15))[0].mode == "drive"
        assert command_of_reason(simulator, "no_fresh_state").mode == "safe_stop"
        assert simulator.query("status")["mode"] == "safe_stop"
        assert edge.end() == 0
    os.close(reader)
    os.close(writer)


BUSY = """
import os, time
from edge_runtime.vehicles.mock import MockVehicle

class Busy(MockVehicle):
    def feedback(self, now_s):
        if os.path.exists("busy"):
            os.remove("busy")
            time.sleep(0.8)
        return super().feedback(now_s)
    def brake(self, now_s, latch=True):
        self.note("brake")
        super().brake(now_s, latch)
    def close(self):
        self.note("close")
        while os.path.exists("hangs"):
            time.sleep(0.01)
    def note(self, word):
        with open("calls", "a") as calls:
            calls.write(word + chr(10))
"""


@pytest.mark.parametrize("hangs", [False, True])
def test_a_vehicle_is_left_braked_and_closed_or_the_log_says_that_it_hangs(
    make_policy, tmp_path, hangs
):
    (tmp_path / "busy_vehicle.py").write_text(BUSY)
    flags, endpoint = make_policy("constant").flags, free_endpoint()
    arguments = [*flags, "--connect", endpoint, "--vehicle", "busy_vehicle:Busy"]
    with Simulator(endpoint) as simulator, run_edge(*arguments, cwd=tmp_path) as edge:
        simulator.wait_for_edge()
        drive(simulator, range(5))
        (tmp_path / "busy").touch()
        if hangs:
            (tmp_path / "hangs").touch()
        wait_until(lambda: not (tmp_path / "busy").exists(), "the driver to be busy")
        assert edge.end() == 0
        assert (tmp_path / "calls").read_text().split()[-2:] == ["brake", "close"]
        assert (" driver_hangs " in edge.errors) == hangs


HELD = """
import os, threading, time
from edge_runtime.vehicles.mock import MockVehicle

class Held(MockVehicle):
    def __init__(self, *parameters):
        super().__init__(*parameters)
        self.hold("constructor")
        if os.path.exists("thread"):
            threading.Thread(target=time.sleep, args=(1e6,)).start()
    def enable(self, now_s):
        self.hold("enable")
        super().enable(now_s)
    def hold(self, where):
        if os.path.exists(where):
            open("here", "w").close()
            time.sleep(1e6)
"""


@pytest.mark.parametrize(("where", "status"), [("constructor", 2), ("enable", 2), ("thread", 0)])
def test_a_driver_that_hangs_before_the_drive_or_leaves_a_thread_does_not_hold_the_end(
    make_policy, tmp_path, where, status
):
    (tmp_path / where).touch()
    (tmp_path / "held_vehicle.py").write_text(HELD)
    run = ("run", *make_policy("constant").flags, "--connect", free_endpoint())
    vehicle = ("--vehicle", "held_vehicle:Held")
    with Process("edge_runtime", *run, *vehicle, cwd=tmp_path) as edge:
        if where == "thread":
            edge.wait_for_line("ready ")
        else:
            wait_until((tmp_path / "here").exists, "the driver to hang")
        edge.send(signal.SIGTERM)
        assert edge.wait() == status, edge.errors


def test_silence_and_nan_stop_and_fresh_states_drive_again(edge_and_simulator):
    edge, simulator = edge_and_simulator("nan")
    assert simulator.ask(make_state(0)).mode == "drive"
    begun_s = time.monotonic()
    first = simulator.next_command()
    assert time.monotonic() - begun_s < 1.0
    assert (first.mode, first.reason, first.action) == ("safe_stop", "no_fresh_state", [-1.0])
    begun_s = time.monotonic()
    assert {simulator.next_command().mode for _ in range(20)} == {"safe_stop"}
    assert 1.0 < time.monotonic() - begun_s < 4.0  # at the control rate
    modes = [command.mode for command in drive(simulator, range(1, 20))]
    assert modes[:4] == ["safe_stop"] * 4
    assert "drive" in modes
    for step in range(20, 29):
        command = simulator.ask(make_state(step, **WHITE_FRAMES))
        found = (command.mode, command.reason, command.action)
        assert found == ("safe_stop", "output_not_finite", [-1.0])
    assert "drive" in {command.mode for command in drive(simulator, range(29, 49))}
    health = last_health(simulator, lambda h: h.accepted == 49)
    assert health.safe_stops >= 2
    assert edge.end() == 0
    assert "reason=output_not_finite" in edge.errors
    assert "Traceback" not in edge.errors


def test_a_vehicle_moves_stops_and_waits_for_the_operator(edge_and_simulator):
    edge, simulator = edge_and_simulator("constant", "--vehicle", "mock", value=0.8)
    commands = drive(simulator, range(20))
    assert commands[0].mode == "drive"
    for command in commands:
        if command.mode == "drive":
            assert command.action == pytest.approx([0.8], abs=1e-6)
    wait_until(lambda: any(f.speed_mps > 0.1 for f in simulator.feedback), "the mock moves")
    assert simulator.next_command().mode == "safe_stop"
    wait_until(lambda: simulator.feedback[-1].speed_mps == 0.0, "the mock stands")
    assert not simulator.query("rearm")["accepted"]  # the link is not back
    assert {c.mode for c in drive(simulator, range(20, 40))} == {"safe_stop"}
    assert last_health(simulator, lambda h: h.needs_rearm)
    simulator.steps = itertools.count(40)

    def moves():
        return simulator.feedback[-1].speed_mps > 0.1

    simulator.drive_until(moves, "the mock moves again", rearms=True)
    simulator.send(make_state(next(simulator.steps), final=True))
    wait_until(lambda: simulator.feedback[-1].speed_mps == 0.0, "it stands between two episodes")
    simulator.steps, told = itertools.count(), []
    for _ in range(8):
        told.append(simulator.ask(make_state(next(simulator.steps), episode=1)))
        time.sleep(0.1)
    assert {(command.mode, command.reason) for command in told} == {("safe_stop", "episode")}
    assert not moves()
    simulator.drive_until(moves, "the next drive", rearms=True, episode=1)
    edge.send(signal.SIGINT)  # as SIGTERM
    last = command_of_reason(simulator, "runtime_ended")
    assert (last.mode, last.action) == ("safe_stop", [-1.0])
    assert edge.wait() == 0
    assert " ended " in edge.errors


def test_a_leash_needs_a_re_arm_and_ends_within_its_length(edge_and_simulator, tmp_path):
    path = tmp_path / "edge.toml"
    path.write_text("[vehicle]\ndriver = 'mock'\nmax_speed_mps = 2.0\nleash_m = 1.0\n")
    edge, simulator = edge_and_simulator("constant", "--config", path, value=0.8)
    assert {command.reason for command in drive(simulator, range(7))} == {"not_armed"}
    simulator.steps = itertools.count(7)

    def is_used():
        return simulator.health[-1].reason == "leash"

    assert simulator.query("rearm")["accepted"]
    simulator.drive_until(is_used, "the end of the leash")
    health = simulator.health[-1]
    assert (health.needs_rearm, health.leash_m, health.max_speed_mps) == (True, 1.0, 2.0)
    wait_until(lambda: simulator.feedback[-1].speed_mps == 0.0, "a stand")
    told = [(feedback.sent_ns * 1e-9, feedback.speed_mps) for feedback in simulator.feedback]
    pairs = list(zip(told, told[1:]))
    at_m = sum(0.5 * (v + w) * (t - s) for (s, v), (t, w) in pairs)
    assert at_m <= 1.0 + 2.0**2 / (2 * 4.0) + 2.0 * 0.1  # its stopping distance
    assert max(speed_mps for _, speed_mps in told) <= 2.0 * 1.03
    assert edge.end() == 0


def test_of_two_runtimes_that_meet_later_the_younger_gives_way(make_policy):
    """Both started before the simulator, so that neither could know of the other."""
    endpoint, flags = free_endpoint(), make_policy().flags
    edges = [run_edge(*flags, "--connect", endpoint) for _ in range(2)]
    with edges[0], edges[1], Simulator(endpoint) as simulator:
        ended = wait_until(lambda: [edge for edge in edges if edge.has_ended], "one of them ends")
        assert [edge.wait() for edge in ended] == [2]
        *log, last_line = ended[0].errors.splitlines()
        assert last_line.startswith("error: another edge runtime")
        # The elder one sees it twice only where the younger one lives so long: see test_link.py.
        assert sum(" another_edge " in line for line in log) == 1
        assert simulator.ask(make_state(0, final=True)).mode == "drive"
        (left,) = set(edges) - set(ended)
        assert left.end() == 0
