"""The driver on real Zenoh sessions; the ROS machine in its place speaks through rosbags."""

from __future__ import annotations

import threading
import time

import pytest

from edge_runtime.config import Config, Ros2Settings, load_config
from edge_runtime.tests.harness import (
    PATIENCE_S,
    EdgeProcess,
    Simulator,
    make_state,
    run_command,
    wait_until,
)
from edge_runtime.tests.policies import write_policy
from edge_runtime.transport import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.vehicles import stream
from edge_runtime.vehicles.core import Event, State
from edge_runtime.vehicles.mapping import CARS, SPECS, similarity_to
from edge_runtime.vehicles.registry import vehicle_limits
from edge_runtime.vehicles.ros2.tests import second
from edge_runtime.vehicles.ros2.tests.ros_hunter import RosHunter
from edge_runtime.vehicles.ros2.vehicle import Ros2Vehicle
from edge_runtime.wire import CONTROL_PERIOD_S

SPEC = SPECS["2.0"]


made: list[Ros2Vehicle] = []


@pytest.fixture(autouse=True)
def all_closed():
    """An open session would hang the process of a test that fails."""
    yield
    while made:
        made.pop().close()


def make_vehicle(scenario="left_turn", **changes):
    made.append(Ros2Vehicle(Ros2Settings(**changes), similarity_to(CARS[scenario], SPEC)))
    return made[-1]


class Commands:
    """A control loop in its place: one action again and again, at 20 Hz."""

    def __init__(self, vehicle, action, scenario_speed_mps=None):
        self._arguments = vehicle, action, scenario_speed_mps
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        vehicle, action, scenario_speed_mps = self._arguments
        while not self._stopping.wait(0.05):
            vehicle.command(action, time.monotonic(), scenario_speed_mps)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join()


def report(vehicle):
    return vehicle.feedback(time.monotonic())


@pytest.fixture(params=["we listen", "the bridge listens"])
def pair(request):
    endpoint = free_endpoint()
    if request.param == "we listen":
        vehicle = make_vehicle(listen=endpoint)
        assert vehicle.limits == vehicle_limits("ros2", Config(), "left_turn")
        vehicle.enable(time.monotonic())
        hunter = RosHunter(connect=endpoint)
    else:
        hunter = RosHunter(listen=endpoint)
        vehicle = make_vehicle(connect=endpoint)
        vehicle.enable(time.monotonic())
    yield vehicle, hunter
    vehicle.close()
    hunter.__exit__()


@pytest.fixture
def enabled():
    """A vehicle that listens, and the Hunter whose odometry has confirmed it."""
    endpoint = free_endpoint()
    vehicle = make_vehicle(listen=endpoint)
    vehicle.enable(time.monotonic())
    with RosHunter(connect=endpoint) as hunter:
        enable(vehicle)
        yield vehicle, hunter
        vehicle.close()


def enable(vehicle):
    """As an operator's re-arm: again, until it is confirmed."""

    def is_enabled():
        if vehicle.state is State.STOPPED:
            vehicle.enable(time.monotonic())
        return vehicle.state is State.ENABLED

    wait_until(is_enabled, "odometry to confirm")


def drive(vehicle, hunter, over_mps):
    """Until it is as quick; where this machine paused for too long, it was stopped: once more."""

    def is_quick():
        if vehicle.state is State.STOPPED:
            vehicle.enable(time.monotonic())
        return hunter.speed_mps > over_mps

    wait_until(is_quick, "the Hunter to drive")


def test_a_pedal_drives_the_hunter_and_a_brake_stands_until_enabled_again(pair):
    vehicle, hunter = pair
    enable(vehicle)
    with Commands(vehicle, {"pedal": 1.0}):
        drive(vehicle, hunter, 0.5)
        wait_until(lambda: report(vehicle).speed_mps > 0.3, "its odometry")
        vehicle.brake(time.monotonic())
        wait_until(lambda: hunter.asked_mps == 0.0, "speed 0")
        wait_until(lambda: hunter.speed_mps < 0.02, "the Hunter to stand")
        time.sleep(0.3)  # the commands go on, to nobody
        assert hunter.asked_mps == 0.0
        drive(vehicle, hunter, 0.3)
        assert report(vehicle).faults == []


def test_nothing_is_published_before_enable():
    endpoint = free_endpoint()
    with RosHunter(listen=endpoint) as hunter:
        vehicle = make_vehicle(connect=endpoint)
        vehicle.command({"pedal": 1.0}, time.monotonic())
        time.sleep(0.3)
        wait_until(lambda: len(hunter.tokens) == 3, "the tokens: a bridge may get ready")
        assert not hunter.twists
        vehicle.close()


def test_both_kinds_of_command_below_a_namespace_and_their_tokens():
    endpoint = free_endpoint()
    vehicle = make_vehicle(
        "congestion", listen=endpoint, namespace="/robot", ackermann_topic="ackermann_cmd"
    )
    vehicle.enable(time.monotonic())
    with RosHunter(connect=endpoint, namespace="robot") as hunter:
        enable(vehicle)
        with Commands(vehicle, {"steering": -1.0}, scenario_speed_mps=4.0):
            drive(vehicle, hunter, 0.9)
            steering = wait_until(
                lambda: hunter.drives[-1]["drive"]["speed"] > 0.99 and hunter.drives[-1]["drive"],
                "the drive",
            )["steering_angle"]
            # What hunter_ros2 makes of speed and yaw rate is the inner wheel of the same circle.
            wait_until(lambda: abs(hunter.inner_rad) > steering, "the wheels")
            wait_until(
                lambda: report(vehicle).action["steering"] == pytest.approx(-1.0, abs=0.01),
                "the odometry's word on the steering",
            )
        assert steering > 0  # -1 turns left
        chunks = sorted("/".join(token.split("/")[3:5]) for token in hunter.tokens)
        assert chunks == ["", "MP/robot§ackermann_cmd", "MP/robot§cmd_vel", "MS/robot§odom"]
        vehicle.close()
        wait_until(lambda: not hunter.tokens, "the tokens to go")
        assert hunter.asked_mps == 0.0


def test_silence_stops_it_and_only_an_enable_leads_out(enabled):
    vehicle, hunter = enabled
    with Commands(vehicle, {"pedal": 1.0}):
        for _ in range(4):
            drive(vehicle, hunter, 0.3)
            hunter.silent = True
            wait_until(lambda: vehicle.state is State.STOPPED, "the stop")
            faults = report(vehicle).faults
            hunter.silent = False
            if vehicle._core.cause is not Event.COMMAND_LATE:  # this machine paused itself
                break
        assert vehicle._core.cause is Event.SILENT
        assert faults[0] == "no fresh odometry on odom"
        time.sleep(0.3)
        assert vehicle.state is State.STOPPED
        assert hunter.asked_mps == 0.0
        drive(vehicle, hunter, 0.3)


def test_a_message_that_was_held_up_is_followed_at_once_by_one_of_now(enabled, monkeypatch):
    vehicle, _ = enabled
    sent: list = []

    def stopped_in_between(motion):
        if not sent and motion.speed_mps > 0.1:
            monkeypatch.setattr(stream, "PERIOD_S", 0.4)
            time.sleep(0.5)  # the whole process, as far as the message can tell
        if sent or motion.speed_mps > 0.1:
            sent.append((time.monotonic(), motion.speed_mps))

    vehicle._publish.append(stopped_in_between)
    with Commands(vehicle, {"pedal": 1.0}):
        wait_until(lambda: sent, "a message")
    wait_until(lambda: len(sent) > 1, "the next message")
    assert sent[1][0] - sent[0][0] < 0.15


def test_the_stream_goes_on_with_zeros_while_stopped(enabled):
    """The chassis is never left to its own time-out, after which any frame gives control back."""
    vehicle, hunter = enabled
    vehicle.brake(time.monotonic())
    count = len(hunter.twists)
    wait_until(lambda: len(hunter.twists) > count + 25, "half a second of messages")
    assert {twist["linear"]["x"] for _, twist in hunter.twists} == {0.0}


def test_at_the_end_zeros_go_out_until_it_stands(enabled):
    vehicle, hunter = enabled
    with Commands(vehicle, {"pedal": 1.0}):
        drive(vehicle, hunter, 0.5)
    vehicle.close()
    assert hunter.speed_mps < 0.1
    assert [twist["linear"]["x"] for _, twist in hunter.twists[-5:]] == [0.0] * 5


def test_what_is_no_odometry_is_counted_and_confirms_nothing():
    endpoint = free_endpoint()
    with RosHunter(listen=endpoint) as hunter:
        hunter.silent = True
        vehicle = make_vehicle(connect=endpoint)
        vehicle.enable(time.monotonic())
        good = hunter._message()
        wrong = dict(
            good, twist={"twist": good["twist"]["twist"], "covariance": [float("nan")] * 36}
        )
        bad = [b"", b"\0\1\0\0", second.serialize("nav_msgs/msg/Odometry", wrong)]

        def all_are_counted():
            for payload in bad:
                hunter.put(payload)
            return {"malformed", "not_finite"} <= set(vehicle.rejected)

        wait_until(all_are_counted, "the rejections")
        assert vehicle.state is not State.ENABLED
        vehicle.close()


def test_it_closes_twice_and_without_having_been_enabled():
    for enables in (False, True):
        vehicle = make_vehicle(listen=free_endpoint())
        if enables:
            vehicle.enable(time.monotonic())
        vehicle.close()
        vehicle.close()
        vehicle.enable(time.monotonic())
        assert vehicle.state is State.DISABLED


def test_a_busy_port_is_told_by_the_settings_name():
    endpoint = free_endpoint()
    make_vehicle(listen=endpoint)
    with pytest.raises(UserError, match=r"in use; choose another with \[ros2\] listen$"):
        make_vehicle(listen=endpoint)


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"listen": "tcp/127.0.0.1:1", "connect": "tcp/127.0.0.1:1"}, "give one of them"),
        ({"connect": "tls/127.0.0.1:7448"}, "plain text"),
        ({"connect": "nowhere"}, "endpoint 'nowhere'"),
        ({"model": "3.0"}, "ros2.model '3.0'"),
        ({"twist_topic": ""}, "no topic to command by"),
        ({"odometry_topic": ""}, "no odometry_topic"),
        ({"odometry_topic": "/cmd_vel"}, "a topic twice: cmd_vel, cmd_vel"),
        ({"twist_topic": "a b"}, "topic 'a b'"),
        ({"namespace": "9"}, "namespace '9'"),
        ({"twist_angular": "degrees"}, "yaw_rate, steering"),
    ],
)
def test_settings_that_cannot_be_are_one_line(changes, part):
    with pytest.raises(UserError) as caught:
        make_vehicle(**changes)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture
def policy(tmp_path):
    path = tmp_path / "full.onnx"
    write_policy(path, "constant", 1.0)
    return path


def drive_until(simulator, step, condition, what):
    """Send states at 10 Hz, each answered, until the condition holds; return the next step."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, what
        simulator.ask(make_state(step))
        step += 1
        time.sleep(CONTROL_PERIOD_S)
    return step


class Drives:
    """Whether the Hunter is as quick; an operator beside it re-arms where that is asked."""

    def __init__(self, simulator, hunter, over_mps):
        self._simulator, self._hunter, self._over_mps = simulator, hunter, over_mps

    def __call__(self):
        if self._simulator.health[-1].needs_rearm:
            self._simulator.query("rearm")
        return self._hunter.speed_mps > self._over_mps


def test_it_drives_stops_with_the_link_and_drives_again_only_after_a_rearm(policy, tmp_path):
    endpoint, ros_endpoint = free_endpoint(), free_endpoint()
    settings = tmp_path / "edge.toml"
    settings.write_text(
        f'[ros2]\nlisten = "{ros_endpoint}"\ntwist_topic = "/cmd_vel"\nnamespace = "/any"\n'
        'odometry_topic = "/odom"\n'
    )
    flags = ("--policy", str(policy), "--allow-unsigned", "--vehicle", "ros2")
    arguments = (*flags, "--connect", endpoint, "--config", str(settings))
    with Simulator(endpoint) as simulator, EdgeProcess(*arguments) as edge, RosHunter(
        connect=ros_endpoint
    ) as hunter:
        simulator.wait_for_edge()
        wait_until(lambda: len(hunter.twists) > 10, "zeros")
        assert hunter.asked_mps == 0.0
        # Nobody may have been there for the first enabling.
        step = drive_until(simulator, 0, Drives(simulator, hunter, 0.5), "the Hunter to drive")
        wait_until(lambda: simulator.feedback[-1].speed_mps > 0.3, "its feedback")
        feedback = simulator.feedback[-1]
        assert feedback.vehicle == "ros2"
        assert feedback.scenario_speed_mps == pytest.approx(4 * feedback.speed_mps)
        # No more states: the runtime's safe stop.
        wait_until(lambda: hunter.speed_mps < 0.02, "the stop")
        # They come back, and it stands nevertheless.
        end_s = time.monotonic() + 1.0
        step = drive_until(simulator, step, lambda: time.monotonic() > end_s, "a second")
        assert hunter.asked_mps == 0.0
        step = drive_until(simulator, step, Drives(simulator, hunter, 0.3), "it to drive again")
        hunter.silent = True
        step = drive_until(simulator, step, lambda: hunter.asked_mps == 0.0, "the stop")
        drive_until(
            simulator,
            step,
            lambda: "no fresh odometry on /odom" in simulator.feedback[-1].faults,
            "the fault in words",
        )
        assert not simulator.query("rearm")["accepted"]
        assert edge.end() == 0


def test_wrong_settings_of_a_file_are_one_line(tmp_path):
    settings = tmp_path / "edge.toml"
    for table, part in (
        ('connect = "tls/127.0.0.1:7448"', "plain text"),
        ("topic = 1", "ros2: Object contains unknown field `topic`; known are model, listen,"),
    ):
        settings.write_text(f"[ros2]\n{table}")
        with pytest.raises(UserError) as caught:
            load_config(settings, {"policy": "any.onnx", "vehicle": "ros2"})
        assert part in str(caught.value)


def test_a_busy_port_is_one_line(policy, tmp_path):
    busy = free_endpoint()
    settings = tmp_path / "edge.toml"
    settings.write_text(f'[ros2]\nlisten = "{busy}"')
    with RosHunter(listen=busy):
        flags = ("--policy", str(policy), "--allow-unsigned", "--vehicle", "ros2")
        result = run_command("run", *flags, "--config", str(settings))
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert line.endswith("in use; choose another with [ros2] listen")
