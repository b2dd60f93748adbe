"""Our messages as ROS 2 messages. Pure.

Commands are in the scenario's metres, as the policy means them; feedback is in the vehicle's own.
ROS has x ahead, y and positive angles to the left (REP 103).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from bridge.to_ros2.dead_reckoning import DeadReckoning
from edge_runtime.vehicles.mapping import ScenarioCar, Similarity
from edge_runtime.vehicles.ros2 import node as ros
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE, Command, Feedback, State

CAMERA_FRAME, ODOMETRY_FRAME, BASE_FRAME = "camera", "odom", "base_link"
_, HEIGHT, WIDTH = FRAMES_SHAPE
UNKNOWN = 1e6
"""A variance for what a car on a plane does not know: height, roll and pitch."""


class Policy(NamedTuple):
    """What a command's numbers mean: the policy's action names, and the car it was trained on."""

    action_names: Sequence[str]
    car: ScenarioCar

    def action(self, values: Sequence[float], name: str) -> float | None:
        """Return one action; None where the policy has none of that name."""
        named = dict(zip(self.action_names, values, strict=False))
        return named.get(name)


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
    acceleration = _acceleration(policy.action(command.action, "pedal") or 0.0, policy.car)
    target_mps = speed_mps + acceleration * CONTROL_PERIOD_S
    curvature = _curvature(policy, command.action, 1.0)
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


def feedback_curvature(feedback: Feedback, policy: Policy, scale: float) -> float | None:
    """Return the path's curvature (1/m) that the steering has reached; None if none is reported."""
    if policy.action(feedback.action, "steering") is None:
        return None
    return _curvature(policy, feedback.action, scale)


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


def _acceleration(pedal: float, car: ScenarioCar) -> float:
    return pedal * (car.throttle_mps2 if pedal > 0.0 else car.brake_mps2)


def _curvature(policy: Policy, values: Sequence[float], scale: float) -> float:
    steering = policy.action(values, "steering") or 0.0
    return Similarity(policy.car, scale).vehicle_curvature(steering)


def _diagonal(x: float, y: float, yaw: float) -> list[float]:
    """A 6x6 covariance, row by row: x, y, z, roll, pitch, yaw."""
    covariance = [0.0] * 36
    for index, variance in enumerate((x, y, UNKNOWN, UNKNOWN, UNKNOWN, yaw)):
        covariance[7 * index] = variance
    return covariance
