"""Between the driver's numbers and ROS 2 messages. Pure."""

from __future__ import annotations

import math

from edge_runtime.ros2 import messages as ros
from edge_runtime.vehicles.ros2.core import Motion
from edge_runtime.vehicles.ros2.odometry import Measured
from edge_runtime.vehicles.ros2.settings import STEERING

BASE_FRAME = "base_link"


def twist_of(motion: Motion, angular: str, wheelbase_m: float) -> ros.Twist:
    """`linear.x` in m/s; `angular.z` is the yaw rate (rad/s), or the steering angle (rad).

    A yaw rate of 0 says nothing of the wheels of a vehicle that stands: they go straight.
    """
    z = motion.centre_rad
    if angular != STEERING:
        z = motion.speed_mps * math.tan(motion.centre_rad) / wheelbase_m
    return ros.Twist(linear=ros.Vector3(x=motion.speed_mps), angular=ros.Vector3(z=z))


def drive_of(motion: Motion, time_ns: int) -> ros.AckermannDriveStamped:
    """Speed and centre angle; no acceleration is given, because the speed is a ramp already."""
    return ros.AckermannDriveStamped(
        header=ros.Header(ros.stamp_of(time_ns), BASE_FRAME),
        drive=ros.AckermannDrive(speed=motion.speed_mps, steering_angle=motion.centre_rad),
    )


def measured_of(odometry: ros.Odometry) -> Measured:
    """The velocity along the vehicle, and the rotation, of an odometry."""
    stamp, twist = odometry.header.stamp, odometry.twist.twist
    return Measured(
        stamp_ns=stamp.sec * 10**9 + stamp.nanosec,
        speed_mps=twist.linear.x,
        angular=twist.angular.z,
    )
