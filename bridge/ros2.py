"""``python -m bridge ros2``: a listener of its own that shows the wire to ROS 2.

It has two sessions: one listens to our wire, as `view` does, the other one speaks to a
zenoh-bridge-ros2dds. So ROS 2 hears what we show it, and can say nothing on our wire.

Commands are in the scenario's metres, as the policy means them; feedback is in the vehicle's own.
ROS has x ahead, y and positive angles to the left (REP 103).
"""

from __future__ import annotations

import contextlib
import functools
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from bridge.messages import DECODERS, Heard, Pace
from bridge.ports import add_options, open_listener
from edge_runtime.cli import ArgumentParser, examples, number, sigterm_as_interrupt
from edge_runtime.commands import ask
from edge_runtime.files import write_json_out
from edge_runtime.tls import tls_for
from edge_runtime.util import UserError
from edge_runtime.vehicles.mapping import CARS, ScenarioCar
from edge_runtime.vehicles.ros2 import (
    DEFAULT_ROS2_ENDPOINT,
    check_ros2_endpoint,
    check_ros_name,
    namespace_of,
    open_ros2_session,
)
from edge_runtime.vehicles.ros2 import node as ros
from edge_runtime.vehicles.ros2.node import Ros2Node
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE, Command, Feedback, Rejection, State

MAX_RATE_HZ = 20.0
RETRY_S = 2.0
LONGEST_GAP_S = 0.5
"""After a longer silence its speed meanwhile is unknown: only so much is made up."""
ERROR_PER_METRE = 0.1
"""Guessed, not measured: a standard deviation of 10 % of the way, and 0.1 rad a metre."""
UNKNOWN = 1e6  # A variance for what a car on a plane does not know: height, roll and pitch

CAMERA_FRAME, ODOMETRY_FRAME, BASE_FRAME = "camera", "odom", "base_link"
_, HEIGHT, WIDTH = FRAMES_SHAPE
Ask = Callable[[], dict[str, Any]]

_TOPICS = """

topics below the namespace: image_raw (sensor_msgs/Image), odom (nav_msgs/Odometry, dead reckoning),
command/ackermann (ackermann_msgs/AckermannDriveStamped), command/twist (geometry_msgs/Twist);
the last two show what is commanded: no driver listens there.
"""
EXAMPLE = (
    examples(
        "python -m bridge ros2 --vehicle-id hunter01\n"
        "    then on the same machine: zenoh-bridge-ros2dds -l tcp/127.0.0.1:7449"
        f" -e {DEFAULT_ROS2_ENDPOINT}\n"
        "    and in a ROS 2 shell:     ros2 topic echo /hunter01/odom",
        "python -m bridge ros2 --connect tls/10.0.0.2:7447 --tls certs/viewer --namespace /car",
        "python -m bridge ros2 --ros2-connect tcp/127.0.0.1:7449 --duration-s 60 --out ros2.json",
    )
    + _TOPICS
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_options(parser, "--connect", "--tls", "--wait-s", "--duration-s")
    add_options(parser, "--vehicle-id", help="the vehicle to show")
    side = parser.add_mutually_exclusive_group()
    where = "where a zenoh-bridge-ros2dds"
    for name, text in (
        ("--ros2-listen", f"{where} connects to (default: {DEFAULT_ROS2_ENDPOINT})"),
        ("--ros2-connect", f"{where} listens; it may come later"),
    ):
        side.add_argument(name, metavar="PROTOCOL/HOST:PORT", help=text)
    namespace = "ROS namespace of the topics (default: /VEHICLE_ID)"
    parser.add_argument("--namespace", metavar="NS", help=namespace)
    rate = number("a rate above 0 and up to 1000 Hz", lambda rate_hz: 0.0 < rate_hz <= 1000.0)
    most = "most messages a second on each topic; more are left out"
    parser.add_argument("--max-rate-hz", metavar="HZ", type=rate, default=MAX_RATE_HZ, help=most)
    add_options(parser, "--out", help="write the counts to this file at the end")


def run(arguments: Any) -> int:
    """Run the command until the simulator goes, the time is over, or somebody interrupts."""
    connect, vehicle_id = arguments.connect, arguments.vehicle_id
    tls = tls_for(arguments.tls, connect)
    for endpoint in (arguments.ros2_listen, arguments.ros2_connect):
        check_ros2_endpoint(endpoint)
    namespace = arguments.namespace or namespace_of(vehicle_id)
    check_ros_name(namespace, "namespace")
    with (
        sigterm_as_interrupt(),
        contextlib.closing(
            open_ros2_session(arguments.ros2_listen, arguments.ros2_connect)
        ) as session,
        open_listener(connect, vehicle_id, arguments.wait_s, tls) as listener,
        contextlib.closing(Ros2Node(session, namespace)) as node,
    ):
        status = functools.partial(ask, connect, vehicle_id, "status", tls)
        outlet = Outlet(node, Policies(status), arguments.max_rate_hz)
        print(f"ready vehicle_id={vehicle_id} namespace={namespace}", flush=True)
        # Being interrupted is the ordinary way to end.
        with contextlib.suppress(KeyboardInterrupt):
            for heard in listener.until_gone(arguments.duration_s):
                outlet.take(heard)
        counts = {"sent": node.sent, "rejected": outlet.rejected, "skipped": outlet.skipped}
    write_json_out(arguments.out, {**counts, "dropped": listener.dropped})
    parts = (
        f"{what}: " + ", ".join(f"{name} {count}" for name, count in found.items())
        for what, found in counts.items()
        if found or what == "sent"
    )
    print("; ".join(parts))
    return 0


class Outlet:
    """Publishes what it is given; ``rejected`` counts what it could not, by topic and reason."""

    def __init__(self, node: Ros2Node, policies: Policies, max_rate_hz: float) -> None:
        self.rejected: Counter[str] = Counter()
        self._policies = policies
        self._show: dict[str, Callable[[Any, bool], None]] = {
            "state": self._show_state,
            "command": self._show_command,
            "feedback": self._show_feedback,
        }
        self._paces = {topic: Pace(1.0 / max_rate_hz) for topic in self._show}
        self._image = node.publisher("image_raw", ros.Image)
        self._odometry = node.publisher("odom", ros.Odometry)
        # Not cmd_vel and not ackermann_cmd: this shows what is commanded, and must move nothing.
        self._drive = node.publisher("command/ackermann", ros.AckermannDriveStamped)
        self._twist = node.publisher("command/twist", ros.Twist)
        self._pose = DeadReckoning()
        self._speed_mps, self._scale = 0.0, 1.0

    @property
    def skipped(self) -> dict[str, int]:
        """Return how many messages of each topic came faster than the bound."""
        return {topic: pace.skipped for topic, pace in self._paces.items() if pace.skipped}

    def take(self, heard: Heard) -> None:
        """Show one message; topics that ROS 2 has no standard message for are left out."""
        if heard.topic not in self._show:
            return
        message = DECODERS[heard.topic](heard.payload)
        if isinstance(message, Rejection):
            self.rejected[f"{heard.topic}_{message.reason.value}"] += 1
        else:
            may_publish = self._paces[heard.topic].due(heard.arrived_ns * 1e-9)
            self._show[heard.topic](message, may_publish)

    def _show_state(self, state: State, may_publish: bool) -> None:
        """Publish the newest frame; the speed is kept, whatever the rate."""
        self._speed_mps = state.speed_mps
        if may_publish:
            self._image(image_of(state))

    def _show_command(self, command: Command, may_publish: bool) -> None:
        """Publish the command in both forms, once its policy is known."""
        if not may_publish:
            return
        policy = self._policies.find(command.policy_id)
        if policy is None:
            self.rejected["command_unknown_policy"] += 1
            return
        drive = drive_of(command, self._speed_mps, policy)
        self._drive(drive)
        self._twist(twist_of(drive.drive, policy.car))

    def _show_feedback(self, feedback: Feedback, may_publish: bool) -> None:
        """Go on with the dead reckoning at every message, and publish it at the bounded rate."""
        # The vehicle's metres for one of the scenario, where it moves and reports both speeds.
        if feedback.scenario_speed_mps and feedback.speed_mps:
            self._scale = abs(feedback.speed_mps / feedback.scenario_speed_mps)
        policy = self._policies.newest
        curvature = policy and policy.curvature(feedback.action, self._scale)
        self._pose.advance(feedback.speed_mps, curvature or 0.0, feedback.sent_ns)
        if may_publish:
            self._odometry(odometry_of(feedback, self._pose, curvature))


class Policies:
    """Which policy gives the commands: asked of the edge runtime, for the wire has numbers only.

    ``ask`` returns the edge's status, UserError if none answers. ``newest`` is what the last call
    of ``find`` returned.
    """

    def __init__(self, ask: Ask, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._ask, self._clock_s = ask, clock_s
        self._known: dict[str, Policy | None] = {}
        self._ask_again_s = -1.0
        self.newest: Policy | None = None

    def find(self, policy_id: str) -> Policy | None:
        """Return the policy of that id; None until the edge says, and for an unknown scenario."""
        if policy_id not in self._known and self._clock_s() >= self._ask_again_s:
            self._ask_again_s = self._clock_s() + RETRY_S
            with contextlib.suppress(UserError):  # the edge has just gone: asked again later
                self._learn(self._ask())
        self.newest = self._known.get(policy_id)
        return self.newest

    def _learn(self, status: dict[str, Any]) -> None:
        scenario = status["manifest"]["scenario"]
        names = [action["name"] for action in status["manifest"]["action"]]
        known = Policy(names, CARS[scenario]) if scenario in CARS else None
        self._known[status["policy_id"]] = known
        if known is None:
            print(
                f"commands are not shown: the car of scenario {scenario!r} is not known; it is for"
                f" {', '.join(sorted(CARS))}",
                file=sys.stderr,
            )


class Policy(NamedTuple):
    """What a command's numbers mean: the policy's action names, and the car it was trained on."""

    action_names: Sequence[str]
    car: ScenarioCar

    def action(self, values: Sequence[float], name: str) -> float | None:
        """Return one action; None where the policy has none of that name."""
        return dict(zip(self.action_names, values, strict=False)).get(name)

    def curvature(self, values: Sequence[float], scale: float = 1.0) -> float | None:
        """Return the path's curvature (1/m); ``scale``: vehicle metres for one of the scenario."""
        steering = self.action(values, "steering")
        return None if steering is None else self.car.curvature(steering) / scale


def image_of(state: State) -> ros.Image:
    """Return the newer of the two frames, as ``mono8``."""
    return ros.Image(
        header=ros.Header(ros.stamp_of(state.sent_ns), CAMERA_FRAME),
        height=HEIGHT,
        width=WIDTH,
        encoding="mono8",
        is_bigendian=0,
        step=WIDTH,
        data=state.frames_array()[1].tobytes(),
    )


def drive_of(command: Command, speed_mps: float, policy: Policy) -> ros.AckermannDriveStamped:
    """Return the command as speed, acceleration and steering angle of the scenario's car.

    ``speed_mps`` is the car's now. ``speed`` is what the pedal makes of it by the end of the
    control period, ``acceleration`` its magnitude; a policy without a pedal asks for no change.
    ``steering_angle`` is that of the wheel whose path has the asked curvature at this wheelbase.
    """
    pedal = policy.action(command.action, "pedal") or 0.0
    acceleration = pedal * (policy.car.throttle_mps2 if pedal > 0.0 else policy.car.brake_mps2)
    target_mps = speed_mps + acceleration * CONTROL_PERIOD_S
    curvature = policy.curvature(command.action) or 0.0
    return ros.AckermannDriveStamped(
        header=ros.Header(ros.stamp_of(command.sent_ns), BASE_FRAME),
        drive=ros.AckermannDrive(
            speed=min(max(target_mps, 0.0), policy.car.max_speed_mps),
            acceleration=abs(acceleration),
            steering_angle=math.atan(curvature * policy.car.wheelbase_m),
        ),
    )


def twist_of(drive: ros.AckermannDrive, car: ScenarioCar) -> ros.Twist:
    """Return the same as speed and yaw rate."""
    yaw_radps = drive.speed * math.tan(drive.steering_angle) / car.wheelbase_m
    return ros.Twist(linear=ros.Vector3(x=drive.speed), angular=ros.Vector3(z=yaw_radps))


def odometry_of(feedback: Feedback, pose: DeadReckoning, curvature: float | None) -> ros.Odometry:
    """Return the vehicle's speed, and where that has brought it by dead reckoning.

    Without a steering report the pose is a way straight ahead, and its y and yaw are unknown.
    """
    lateral = UNKNOWN if curvature is None else pose.variance
    yaw_radps = feedback.speed_mps * (curvature or 0.0)
    half = 0.5 * pose.yaw_rad
    return ros.Odometry(
        header=ros.Header(ros.stamp_of(feedback.sent_ns), ODOMETRY_FRAME),
        child_frame_id=BASE_FRAME,
        pose=ros.PoseWithCovariance(
            ros.Pose(
                ros.Vector3(pose.x_m, pose.y_m, 0.0),
                ros.Quaternion(z=math.sin(half), w=math.cos(half)),
            ),
            _diagonal(pose.variance, lateral, lateral),
        ),
        twist=ros.TwistWithCovariance(
            ros.Twist(ros.Vector3(x=feedback.speed_mps), ros.Vector3(z=yaw_radps)),
            _diagonal(0.0, 0.0, 0.0 if curvature is not None else UNKNOWN),
        ),
    )


def _diagonal(x: float, y: float, yaw: float) -> list[float]:
    """A 6x6 covariance, row by row: x, y, z, roll, pitch, yaw."""
    covariance = [0.0] * 36
    covariance[::7] = x, y, UNKNOWN, UNKNOWN, UNKNOWN, yaw
    return covariance


class DeadReckoning:
    """A pose in the frame in which the vehicle was first heard of: x ahead, y to its left.

    It is made from the vehicle's own word on speed and steering, and nothing corrects it: wheel
    slip and scale errors add up, as the variance says.
    """

    def __init__(self) -> None:
        self.x_m, self.y_m, self.yaw_rad, self.way_m = 0.0, 0.0, 0.0, 0.0
        self._time_ns: int | None = None
        self._speed_mps, self._curvature = 0.0, 0.0

    @property
    def variance(self) -> float:
        """Return the variance of x, y (m2) and yaw (rad2)."""
        return (ERROR_PER_METRE * self.way_m) ** 2

    def advance(self, speed_mps: float, curvature: float, time_ns: int) -> None:
        """Go on to ``time_ns`` along arcs of the mean of the last two reports.

        ``curvature`` in 1/m, positive to the left. A clock that goes back moves nothing.
        """
        if self._time_ns is not None and time_ns > self._time_ns:
            step_s = min((time_ns - self._time_ns) * 1e-9, LONGEST_GAP_S)
            self._move(
                0.5 * (speed_mps + self._speed_mps) * step_s, 0.5 * (curvature + self._curvature)
            )
        self._time_ns = time_ns
        self._speed_mps, self._curvature = speed_mps, curvature

    def _move(self, way_m: float, curvature: float) -> None:
        turn_rad = way_m * curvature
        heading_rad = self.yaw_rad + 0.5 * turn_rad
        # The chord of the arc: sin(x) / x is 1 where it goes straight.
        half = 0.5 * turn_rad
        chord_m = way_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        self.x_m += chord_m * math.cos(heading_rad)
        self.y_m += chord_m * math.sin(heading_rad)
        self.yaw_rad = math.remainder(self.yaw_rad + turn_rad, math.tau)
        self.way_m += abs(way_m)
