"""The real process against a real simulator session. Limits are loose: machines are busy."""

from __future__ import annotations

import fcntl
import json
import signal
import time

import pytest

from edge_runtime.commands import ask
from edge_runtime.files import Hold
from edge_runtime.tests.harness import (
    BLACK,
    PATIENCE_S,
    WHITE,
    EdgeProcess,
    Simulator,
    make_state,
    run_command,
    wait_until,
)
from edge_runtime.transport import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_BYTES

UNWANTED = {"torch", "gymnasium", "highway_env", "rerun", "rerun_sdk", "onnx", "trainer", "bridge"}
WHITE_FRAMES = bytes([WHITE]) * FRAMES_BYTES


@pytest.fixture
def edge_and_simulator(make_policy):
    """Starts a runtime with a policy of a kind and a simulator that has seen it."""
    opened: list = []

    def start(kind="constant", *flags, **options):
        endpoint = free_endpoint()
        simulator = Simulator(endpoint)
        opened.append(simulator)
        edge = EdgeProcess(*make_policy(kind, **options).flags, "--connect", endpoint, *flags)
        opened.append(edge)
        simulator.wait_for_edge()
        return edge, simulator

    yield start
    for resource in reversed(opened):
        resource.__exit__()


def drive(simulator, steps, **changes):
    """Send states at 1/T and give the commands that answer them."""
    commands = []
    for step in steps:
        begun_s = time.monotonic()
        commands.append(simulator.ask(make_state(step, **changes)))
        time.sleep(max(0.0, CONTROL_PERIOD_S - (time.monotonic() - begun_s)))
    return commands


def last_health(simulator, condition):
    return wait_until(
        lambda: next((h for h in reversed(simulator.health) if condition(h)), None),
        "a health message as expected",
    )


def test_lock_step_drives_from_the_first_state_and_ends_cleanly(edge_and_simulator):
    edge, simulator = edge_and_simulator("mean")
    assert edge.ready_line.startswith("ready ")
    for step in range(50):
        level = step * 5
        command = simulator.ask(make_state(step, frames=bytes([level]) * FRAMES_BYTES))
        assert command.received_ns <= command.sent_ns
        if command.mode == "drive":
            assert command.action == pytest.approx([level / 127.5 - 1], abs=1e-6)
        else:  # this machine paused for 2 T between two states
            assert step > 0
            assert command.reason == "no_fresh_state"
    assert simulator.alive.is_set()
    begun_s = time.monotonic()
    assert edge.end() == 0
    assert time.monotonic() - begun_s < 5.0
    assert "Traceback" not in edge.log
    wait_until(lambda: not simulator.alive.is_set(), "the token is gone")


@pytest.mark.parametrize(
    "number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGABRT, signal.SIGRTMIN]
)
def test_every_signal_that_would_end_it_in_mid_drive_is_a_stop(edge_and_simulator, number):
    ours = signal.signal(number, signal.SIG_DFL)  # under nohup SIGHUP would be ignored
    try:
        edge, simulator = edge_and_simulator("constant", "--vehicle", "mock")
    finally:
        signal.signal(number, ours)
    drive(simulator, range(5))
    edge.process.send_signal(number)
    last = wait_until(
        lambda: next((c for c in simulator.drain() if c.reason == "runtime_ended"), None),
        "a last safe stop",
    )
    assert (last.mode, last.action) == ("safe_stop", [-1.0])
    _, log = edge.process.communicate(timeout=PATIENCE_S)
    assert edge.process.returncode == 0
    assert " ended " in log


def test_a_hangup_that_is_ignored_from_the_start_stays_so(edge_and_simulator):
    ours = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        edge, simulator = edge_and_simulator()
    finally:
        signal.signal(signal.SIGHUP, ours)
    edge.process.send_signal(signal.SIGHUP)
    assert simulator.ask(make_state(0, final=True)).mode == "drive"
    assert edge.end() == 0


def test_the_process_imports_nothing_of_the_workstation(make_policy, tmp_path):
    endpoint, imports = free_endpoint(), tmp_path / "imports.txt"
    flags = [*make_policy().flags, "--connect", endpoint]

    def start(stderr):
        return EdgeProcess(*flags, python_flags=("-X", "importtime"), stderr=stderr)

    # A file, because nobody reads along: a pipe would be full before the process is ready.
    with imports.open("w") as stderr, Simulator(endpoint) as simulator, start(stderr) as edge:
        simulator.wait_for_edge()
        simulator.ask(make_state(0))
        assert edge.end() == 0
    lines = [line for line in imports.read_text().splitlines() if line.startswith("import time:")]
    packages = {line.rsplit("|", 1)[1].strip().split(".")[0] for line in lines}
    assert {"onnxruntime", "zenoh"} <= packages
    assert packages & UNWANTED == set()


def test_silence_stops_at_the_control_rate_and_fresh_states_drive_again(edge_and_simulator):
    _, simulator = edge_and_simulator()
    assert simulator.ask(make_state(0)).mode == "drive"
    begun_s = time.monotonic()
    first = simulator.next_command()
    assert time.monotonic() - begun_s < 1.0
    assert (first.mode, first.reason, first.action) == ("safe_stop", "no_fresh_state", [-1.0])
    begun_s = time.monotonic()
    for _ in range(20):
        assert simulator.next_command().mode == "safe_stop"
    assert 1.0 < time.monotonic() - begun_s < 4.0
    modes = [command.mode for command in drive(simulator, range(1, 30))]
    assert modes[:4] == ["safe_stop"] * 4
    assert "drive" in modes
    health = last_health(simulator, lambda h: h.accepted == 30)
    assert health.safe_stops >= 1
    assert health.inference_ms["p50"] > 0


def test_between_episodes_silence_is_no_fault(edge_and_simulator):
    _, simulator = edge_and_simulator()
    simulator.ask(make_state(0))
    simulator.ask(make_state(1, final=True))
    time.sleep(0.6)
    assert simulator.drain() == []
    assert simulator.ask(make_state(0, episode=1)).mode == "drive"


@pytest.mark.parametrize(
    ("kind", "options", "bad", "good", "reason"),
    [
        ("nan", {}, {"frames": WHITE_FRAMES}, {}, "output_not_finite"),
        ("odd", {"odd_shape": (1, 0)}, {"frames": WHITE_FRAMES}, {}, "inference_failed"),
        ("odd", {"odd_shape": ()}, {"frames": WHITE_FRAMES}, {}, "inference_failed"),
        ("odd", {"odd_shape": (1, 1, 1)}, {"frames": WHITE_FRAMES}, {}, "inference_failed"),
        (
            "constant", {}, {"task": "congestion, steering -1 to 1"},
            {"task": "left_turn, pedal -1 to 1"}, "other_task",
        ),
    ],
)  # fmt: skip
def test_a_state_that_cannot_be_driven_on_stops_and_good_ones_drive_again(
    edge_and_simulator, kind, options, bad, good, reason
):
    edge, simulator = edge_and_simulator(kind, **options)
    assert simulator.ask(make_state(0)).mode == "drive"
    for step in range(1, 9):
        command = simulator.ask(make_state(step, **bad))
        assert (command.mode, command.reason, command.action) == ("safe_stop", reason, [-1.0])
    assert "drive" in {command.mode for command in drive(simulator, range(9, 29), **good)}
    assert edge.end() == 0
    assert f"reason={reason}" in edge.log
    assert "Traceback" not in edge.log


def test_an_inference_that_takes_too_long_stops_while_it_runs(edge_and_simulator):
    _, simulator = edge_and_simulator("slow")
    assert simulator.ask(make_state(0)).mode == "drive"
    simulator.send(make_state(1, frames=WHITE_FRAMES))
    command = wait_until(
        lambda: next((c for c in simulator.drain() if c.reason == "inference_too_long"), None),
        "a safe stop while the policy still computes",
    )
    assert (command.mode, command.step) == ("safe_stop", 1)
    assert simulator.next_command().mode == "safe_stop"
    assert last_health(simulator, lambda h: h.deadline_misses >= 1)


def test_bad_states_are_counted_by_reason_and_not_answered(edge_and_simulator):
    _, simulator = edge_and_simulator()
    simulator.ask(make_state(5, final=True))  # standby: no safe stop comes in between
    bad = {
        "stale": make_state(4),
        "duplicate": make_state(5),
        "schema": make_state(6, schema=2),
        "frames_size": make_state(6, frames=bytes(10)),
        "oversized": make_state(6, frames=bytes(100_000)),
        "not_finite": make_state(6, speed_mps=float("inf")),
        "malformed": b"not a map",
    }
    for message in bad.values():
        simulator.send(message)
    health = last_health(simulator, lambda h: sum(h.rejected.values()) == len(bad))
    assert health.rejected == dict.fromkeys(bad, 1)
    assert simulator.drain() == []


def test_a_state_that_was_put_to_every_vehicle_is_not_its_own(edge_and_simulator):
    _, simulator = edge_and_simulator()
    wild = ("phil/*/state", "phil/hunter$*/state", "*/hunter01/state", "**/state")
    for number, key in enumerate(wild):
        simulator.send(make_state(number), key)
    assert simulator.ask(make_state(0)).mode == "drive"
    health = last_health(simulator, lambda h: h.accepted == 1)
    assert health.rejected == {}


def test_a_second_simulator_is_rejected_until_the_first_is_silent(edge_and_simulator):
    _, simulator = edge_and_simulator()
    for step in range(10):
        simulator.ask(make_state(step))
        simulator.send(make_state(step, session="simulator-b"))
    health = last_health(simulator, lambda h: h.rejected.get("foreign_session", 0) >= 1)
    assert health.accepted + sum(health.rejected.values()) == 20
    time.sleep(3 * CONTROL_PERIOD_S)
    command = simulator.ask(make_state(100, session="simulator-b"))
    assert command.session == "simulator-b"


def test_status_and_rearm_without_a_vehicle(edge_and_simulator):
    _, simulator = edge_and_simulator()
    simulator.ask(make_state(0))
    status = simulator.query("status")
    assert status["accepted"] == 1
    assert 0 < status["inference_ms"]["max"] <= status["command_ms"]["max"]
    assert 10 < status["rss_mb"] < 500
    assert status["load_1min"] >= 0
    table = run_command("status", "--connect", simulator.endpoint).stdout
    assert "1 accepted" in table
    assert f"{status['policy_id'][:12]} (left_turn)" in table
    whole = run_command("status", "--connect", simulator.endpoint, "--json").stdout
    assert set(json.loads(whole)) == set(status)
    assert status["manifest"]["scenario"] == "left_turn"
    assert {"mode", "reason", "rejected", "deadline_misses", "policy_id"} <= set(status)
    assert not simulator.query("rearm")["accepted"]


def test_a_vehicle_moves_stops_and_waits_for_the_operator(edge_and_simulator):
    _, simulator = edge_and_simulator("constant", "--vehicle", "mock", value=0.8)
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
    step = rearm_while_driving(simulator, 40)
    assert "drive" in [c.mode for c in drive(simulator, range(step, step + 10))]


def rearm_while_driving(simulator, step):
    """Send states until the operator's query, made between two of them, is taken."""
    for attempt in range(step, step + 50):
        simulator.ask(make_state(attempt, frames=bytes([BLACK]) * FRAMES_BYTES))
        if simulator.query("rearm")["accepted"]:
            return attempt + 1
    raise AssertionError("no re-arm was taken")


def test_a_second_runtime_with_the_same_vehicle_id_does_not_start(edge_and_simulator, make_policy):
    edge, simulator = edge_and_simulator()
    flags = [*make_policy().flags, "--connect", simulator.endpoint]
    second = run_command("run", *flags)
    assert (second.returncode, second.stdout) == (2, "")
    assert second.stderr.count("\n") == 1
    assert "another edge runtime" in second.stderr
    assert "hunter01" in second.stderr
    assert simulator.ask(make_state(0, final=True)).mode == "drive"
    assert edge.end() == 0


def test_of_two_runtimes_that_meet_later_the_younger_gives_way(make_policy):
    """Both started before the simulator, so that neither could know of the other."""
    endpoint, flags = free_endpoint(), make_policy().flags
    edges = [EdgeProcess(*flags, "--connect", endpoint) for _ in range(2)]
    with edges[0], edges[1], Simulator(endpoint) as simulator:
        ended = wait_until(
            lambda: [edge for edge in edges if edge.process.poll() is not None], "one of them ends"
        )
        assert [edge.process.returncode for edge in ended] == [2]
        last_line = ended[0].process.stderr.read().splitlines()[-1]
        assert last_line.startswith("error: another edge runtime")
        assert simulator.ask(make_state(0, final=True)).mode == "drive"
        assert last_health(simulator, lambda h: h.rivals == 1)
        (left,) = set(edges) - set(ended)
        assert left.end() == 0


def test_it_says_at_once_and_again_what_it_waits_for_and_ends_without_a_simulator(make_policy):
    with EdgeProcess(*make_policy().flags, "--connect", "tcp/127.0.0.1:1") as edge:
        assert edge.ready_line.startswith("ready ")
        assert edge.process.stderr is not None
        waits = (line for line in edge.process.stderr if " waiting " in line)
        begun_s = time.monotonic()
        for _ in range(2):
            assert "nobody listens on port 1 of 127.0.0.1 (connection refused)" in next(waits)
        assert 4.0 < time.monotonic() - begun_s < 15.0
        assert edge.end() == 0


def test_a_simulator_of_another_vehicle_is_named_as_what_it_waits_for(make_policy):
    endpoint = free_endpoint()
    flags = [*make_policy().flags, "--connect", endpoint]
    with Simulator(endpoint, "hunter02"), EdgeProcess(*flags) as edge:
        assert edge.process.stderr is not None
        line = next(line for line in edge.process.stderr if " waiting " in line)
        assert f"{endpoint} is there, and has sent no state for vehicle id hunter01" in line
        assert edge.end() == 0


def test_it_finds_a_simulator_that_starts_later_and_again(make_policy):
    endpoint = free_endpoint()
    with EdgeProcess(*make_policy().flags, "--connect", endpoint):
        for session in ("first", "second"):
            with Simulator(endpoint) as simulator:
                simulator.wait_for_edge()
                assert simulator.ask(make_state(0, session=session)).session == session
            time.sleep(3 * CONTROL_PERIOD_S)


def test_without_a_lock_nothing_is_held_but_what_cannot_be_read_is_not_taken_for_free(tmp_path):
    file = tmp_path / "hold"
    assert not Hold(str(file)).is_on()
    file.touch()
    assert not Hold(str(file)).is_on()
    with pytest.raises(UserError, match="cannot be read: Is a directory"):
        Hold(str(tmp_path))


def test_it_is_free_when_the_lock_is_and_stays_so(tmp_path):
    with open(tmp_path / "hold", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        hold = Hold(str(tmp_path / "hold"))
        assert hold.is_on()
        assert hold.refusal()
    assert not hold.is_on()
    with open(tmp_path / "hold", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert not hold.is_on()
        assert hold.refusal() == ""


def test_a_runtime_on_hold_hears_and_says_nothing(make_policy, tmp_path):
    endpoint, settings = free_endpoint(), tmp_path / "edge.toml"
    settings.write_text(f"hold = '{tmp_path / 'hold'}'\n")
    flags = [*make_policy().flags, "--connect", endpoint, "--config", str(settings)]
    lock = open(tmp_path / "hold", "w")  # noqa: SIM115 - closing it is what the test is about
    fcntl.flock(lock, fcntl.LOCK_EX)
    with Simulator(endpoint) as simulator, EdgeProcess(*flags, "--vehicle", "mock") as edge:
        simulator.wait_for_edge()
        steps = iter(range(1000))

        def fed(end_s: float) -> None:
            while time.monotonic() < end_s:
                simulator.send(make_state(next(steps)))
                time.sleep(0.05)

        fed(time.monotonic() + 0.5)
        assert wait_until(lambda: simulator.health[-1].accepted, "accepted states")
        assert simulator.commands.empty()
        # The vehicle has taken no command: its feedback names the last one.
        assert {feedback.step for feedback in simulator.feedback} == {-1}
        answer = ask(endpoint, "hunter01", "rearm")
        assert not answer["accepted"]
        assert "installer" in answer["detail"]
        lock.close()
        fed(time.monotonic() + 0.3)
        assert simulator.next_command().session == "simulator-a"
        assert wait_until(lambda: simulator.feedback[-1].step >= 0, "a command at the vehicle")
        assert edge.end() == 0
