"""The ROS 2 driver: first in made-up time, then on real Zenoh sessions, against rosbags."""

from __future__ import annotations

import math
import threading
import time

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

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
from edge_runtime.tests.rigs import CONGESTION, LEFT_TURN, PEDAL, SPEC, STREAM_S, Ros2Rig
from edge_runtime.tests.ros2_side import ODOMETRY, RosHunter, serialize
from edge_runtime.transport import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.vehicles import vehicle_limits
from edge_runtime.vehicles.core import Event, State
from edge_runtime.vehicles.ros2 import STEERING, YAW_RATE, Motion, Ros2Core, Ros2Vehicle
from edge_runtime.vehicles.ros2.node import drive_of, twist_of
from edge_runtime.wire import CONTROL_PERIOD_S


def test_only_odometry_confirms_it_and_without_any_it_stops_and_says_so():
    rig = Ros2Rig()
    rig.talks = False
    rig.core.enable(rig.now_s)
    rig.step(25, PEDAL)
    assert rig.sent[-1][1] == Motion(0.0, 0.0)
    rig.step(30)
    assert rig.core.state is State.STOPPED
    assert rig.words == ["no odometry on odom within 1 s", "no fresh odometry on odom"]
    assert rig.report.standing == ["no fresh odometry on odom"]
    rig.talks = True
    rig.enabled().step(55, PEDAL)
    assert rig.speed_mps > 0.5


def test_odometry_that_repeats_itself_is_silence():
    rig = Ros2Rig().driving()
    rig.talks = False
    for _ in range(15):
        rig.core.hear(round(100 * 1e9), 0.5, 0.0, rig.now_s)
        rig.step(1, PEDAL)
    assert rig.core.cause is Event.SILENT
    assert rig.words[0] == "no fresh odometry on odom"


def test_a_clock_set_back_counts_after_the_next_enable():
    rig = Ros2Rig().enabled()
    rig.core.hear(5, 0.0, 0.0, rig.now_s)
    assert rig.core.stale == 1
    rig.core.enable(rig.now_s)
    rig.core.hear(6, 0.0, 0.0, rig.now_s)
    assert rig.core.state is State.ENABLED


def test_odometry_without_stamps_is_believed_by_its_arrival():
    core = Ros2Core(Ros2Settings(), LEFT_TURN)
    core.enable(0.0)
    for tick in range(20):
        core.hear(0, 0.1, 0.0, tick * STREAM_S)
        core.tick(tick * STREAM_S)
    assert core.state is State.ENABLED


@pytest.mark.parametrize("angular", [YAW_RATE, STEERING])
def test_the_steering_comes_back_from_the_odometry(angular):
    rig = Ros2Rig("congestion", odometry_angular=angular).enabled()
    rig.step(150, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert rig.report.action["steering"] == pytest.approx(0.5, abs=1e-6)
    rig.angular = 0.0  # it goes straight, whatever was asked
    rig.step(5, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert rig.report.action["steering"] == pytest.approx(0.0, abs=1e-6)


def test_at_a_stand_a_yaw_rate_tells_nothing_and_the_asked_steering_is_reported():
    rig = Ros2Rig("congestion").enabled()
    rig.obeys = False
    rig.step(25, {"steering": 0.5}, scenario_speed_mps=4.0)
    assert rig.report.action["steering"] == pytest.approx(0.5, abs=1e-6)


def test_a_twist_by_hand():
    """1 m/s on a circle of 2 m: 0.5 rad/s, and an angle of atan(0.65 / 2) as hunter_ros2 has it."""
    motion = Motion(1.0, math.atan(0.65 / 2.0))
    twist = twist_of(motion, YAW_RATE, 0.65)
    assert (twist.linear.x, twist.angular.z) == pytest.approx((1.0, 0.5))
    assert twist_of(motion, STEERING, 0.65).angular.z == motion.centre_rad
    drive = drive_of(motion, 3 * 10**9 + 4)
    assert (drive.drive.speed, drive.drive.steering_angle) == (1.0, motion.centre_rad)
    assert (drive.header.stamp.sec, drive.header.stamp.nanosec) == (3, 4)


WILD = st.floats(allow_nan=False, allow_infinity=False)
STEPS = st.one_of(
    st.tuples(st.just("enable")),
    st.tuples(st.just("brake"), st.booleans()),
    st.tuples(st.just("command"), WILD, WILD, st.one_of(st.none(), WILD)),
    st.tuples(st.just("hear"), st.integers(-10, 10**12), WILD, WILD),
    st.tuples(st.just("wait"), st.floats(0, 1)),
)


@example([("enable",), ("hear", 0, 0.0, 0.0), ("command", 6e307, 0.0, None)])  # inf * 0 s
@given(st.lists(STEPS, max_size=40))
def test_whatever_comes_it_stays_in_its_limits_and_stopped_means_stopped(steps):
    core, now_s, may_drive = Ros2Core(Ros2Settings(), CONGESTION), 0.0, False
    for name, *values in steps:
        if name == "enable":
            core.enable(now_s)
        elif name == "brake":
            core.brake(now_s, *values)
        elif name == "command":
            core.command({"pedal": values[0], "steering": values[1]}, now_s, values[2])
        elif name == "hear":
            core.hear(values[0], values[1], values[2], now_s)
        else:
            now_s += values[0]
        may_drive = core.state is State.ENABLED
        motion = core.tick(now_s)
        if motion is not None:
            assert 0.0 <= motion.speed_mps <= SPEC.max_speed_mps
            assert abs(motion.centre_rad) <= SPEC.max_inner_steering_rad
            assert may_drive or motion.speed_mps == 0.0
        report = core.report(now_s)
        assert all(-1.0 <= value <= 1.0 for value in report.action.values())


# On real sessions.


@pytest.fixture
def make():
    """Makes vehicles, closed with the test: an open session would hang the process."""
    made = []

    def make(similarity=LEFT_TURN, **changes):
        made.append(Ros2Vehicle(Ros2Settings(**changes), similarity))
        return made[-1]

    yield make
    for vehicle in made:
        vehicle.close()


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


def rearm_until(vehicle, condition, what):
    """As an operator would: a vehicle that stopped while this machine paused is enabled again."""

    def holds():
        if vehicle.state is State.STOPPED:
            vehicle.enable(time.monotonic())
        return condition()

    wait_until(holds, what)


def enable(vehicle):
    rearm_until(vehicle, lambda: vehicle.state is State.ENABLED, "odometry to confirm")


def drive(vehicle, hunter, over_mps):
    rearm_until(vehicle, lambda: hunter.speed_mps > over_mps, "the Hunter to drive")


@pytest.fixture
def linked(make):
    """A vehicle that was told to enable, and the Hunter; one of them listens."""
    hunters = []

    def link(similarity=LEFT_TURN, bridge_listens=False, namespace="", enables=True, **changes):
        endpoint = free_endpoint()
        if bridge_listens:
            hunters.append(RosHunter(listen=endpoint, namespace=namespace))
        ours = {"connect" if bridge_listens else "listen": endpoint, "namespace": f"/{namespace}"}
        vehicle = make(similarity, **ours, **changes)
        if enables:
            vehicle.enable(time.monotonic())
        if not bridge_listens:
            hunters.append(RosHunter(connect=endpoint, namespace=namespace))
        return vehicle, hunters[-1]

    yield link
    for hunter in hunters:
        hunter.__exit__()


@pytest.fixture
def enabled(linked):
    vehicle, hunter = linked()
    enable(vehicle)
    return vehicle, hunter


@pytest.mark.parametrize("bridge_listens", [False, True])
def test_a_pedal_drives_the_hunter_and_a_brake_stands_until_enabled_again(linked, bridge_listens):
    vehicle, hunter = linked(bridge_listens=bridge_listens)
    assert vehicle.limits == vehicle_limits("ros2", Config(), "left_turn")
    enable(vehicle)
    with Commands(vehicle, PEDAL):
        drive(vehicle, hunter, 0.5)
        wait_until(lambda: report(vehicle).speed_mps > 0.3, "its odometry")
        vehicle.brake(time.monotonic())
        wait_until(lambda: hunter.asked_mps == 0.0, "speed 0")
        wait_until(lambda: hunter.speed_mps < 0.02, "the Hunter to stand")
        time.sleep(0.3)  # the commands go on, to nobody
        assert hunter.asked_mps == 0.0
        drive(vehicle, hunter, 0.3)
        assert report(vehicle).faults == []


def test_nothing_is_published_before_enable(linked):
    vehicle, hunter = linked(bridge_listens=True, enables=False)
    vehicle.command(PEDAL, time.monotonic())
    time.sleep(0.3)
    wait_until(lambda: len(hunter.tokens) == 3, "the tokens: a bridge may get ready")
    assert not hunter.twists


def test_both_kinds_of_command_below_a_namespace_and_their_tokens(linked):
    vehicle, hunter = linked(CONGESTION, namespace="robot", ackermann_topic="ackermann_cmd")
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


def test_at_the_end_zeros_go_out_until_it_stands(enabled):
    vehicle, hunter = enabled
    with Commands(vehicle, PEDAL):
        drive(vehicle, hunter, 0.5)
    vehicle.close()
    assert hunter.speed_mps < 0.1
    assert [twist["linear"]["x"] for twist in hunter.twists[-5:]] == [0.0] * 5


def test_what_is_no_odometry_is_counted_and_confirms_nothing(linked):
    vehicle, hunter = linked(bridge_listens=True, enables=False)
    hunter.silent = True
    time.sleep(0.1)  # the last one is on its way
    vehicle.enable(time.monotonic())
    wrong = hunter.message()
    wrong["twist"]["covariance"] = [float("nan")] * 36
    bad = [b"", b"\0\1\0\0", serialize(ODOMETRY, wrong)]

    def all_are_counted():
        for payload in bad:
            hunter.put(payload)
        return {"malformed", "not_finite"} <= set(vehicle.rejected)

    wait_until(all_are_counted, "the rejections")
    assert vehicle.state is not State.ENABLED


@pytest.mark.parametrize("enables", [False, True])
def test_it_closes_twice_and_without_having_been_enabled(make, enables):
    vehicle = make(listen=free_endpoint())
    if enables:
        vehicle.enable(time.monotonic())
    vehicle.close()
    vehicle.close()
    vehicle.enable(time.monotonic())
    assert vehicle.state is State.DISABLED


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
def test_settings_that_cannot_be_are_one_line(make, changes, part):
    with pytest.raises(UserError) as caught:
        make(**changes)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


# `run` itself.


@pytest.fixture
def run_flags(tmp_path):
    """The flags of a run with this [ros2] table."""

    def flags(table):
        policy, settings = tmp_path / "full.onnx", tmp_path / "edge.toml"
        write_policy(policy, "constant", 1.0)
        settings.write_text(f"[ros2]\n{table}")
        flags = f"--policy {policy} --allow-unsigned --vehicle ros2 --config {settings}"
        return flags.split()

    return flags


def test_it_drives_stops_with_the_link_and_drives_again_only_after_a_rearm(run_flags):
    endpoint, ros_endpoint = free_endpoint(), free_endpoint()
    flags = run_flags(
        f'listen = "{ros_endpoint}"\ntwist_topic = "/cmd_vel"\nnamespace = "/any"\n'
        'odometry_topic = "/odom"\n'
    )
    with Simulator(endpoint) as simulator, EdgeProcess(
        *flags, "--connect", endpoint
    ) as edge, RosHunter(connect=ros_endpoint) as hunter:
        steps = iter(range(10**6))

        def drive_until(condition, what):
            """Send states at 10 Hz, each answered, until the condition holds."""
            end_s = time.monotonic() + PATIENCE_S
            while not condition():
                assert time.monotonic() < end_s, what
                simulator.ask(make_state(next(steps)))
                time.sleep(CONTROL_PERIOD_S)

        def rearmed_over(over_mps):
            """Whether the Hunter is as quick; an operator beside it re-arms where that is asked."""

            def is_quick():
                if simulator.health[-1].needs_rearm:
                    simulator.query("rearm")
                return hunter.speed_mps > over_mps

            return is_quick

        simulator.wait_for_edge()
        wait_until(lambda: len(hunter.twists) > 10, "zeros")
        assert hunter.asked_mps == 0.0
        # Nobody may have been there for the first enabling.
        drive_until(rearmed_over(0.5), "the Hunter to drive")
        wait_until(lambda: simulator.feedback[-1].speed_mps > 0.3, "its feedback")
        feedback = simulator.feedback[-1]
        assert feedback.vehicle == "ros2"
        assert feedback.scenario_speed_mps == pytest.approx(4 * feedback.speed_mps)
        # No more states: the runtime's safe stop.
        wait_until(lambda: hunter.speed_mps < 0.02, "the stop")
        # They come back, and it stands nevertheless.
        end_s = time.monotonic() + 1.0
        drive_until(lambda: time.monotonic() > end_s, "a second")
        assert hunter.asked_mps == 0.0
        drive_until(rearmed_over(0.3), "it to drive again")
        hunter.silent = True
        drive_until(lambda: hunter.asked_mps == 0.0, "the stop")
        silence = "no fresh odometry on /odom"
        drive_until(lambda: silence in simulator.feedback[-1].faults, "the fault in words")
        assert not simulator.query("rearm")["accepted"]
        assert edge.end() == 0


@pytest.mark.parametrize(
    ("table", "part"),
    [
        ('connect = "tls/127.0.0.1:7448"', "plain text"),
        ("topic = 1", "ros2: Object contains unknown field `topic`; known are model, listen,"),
    ],
)
def test_wrong_settings_of_a_file_are_one_line(run_flags, table, part):
    with pytest.raises(UserError) as caught:
        load_config(run_flags(table)[-1], {"policy": "any.onnx", "vehicle": "ros2"})
    assert part in str(caught.value)


def test_a_busy_port_is_one_line_with_the_settings_name(run_flags):
    busy = free_endpoint()
    with RosHunter(listen=busy):
        result = run_command("run", *run_flags(f'listen = "{busy}"'))
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert line.endswith("in use; choose another with [ros2] listen")
