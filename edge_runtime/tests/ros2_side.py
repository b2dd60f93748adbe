"""The ROS machine in its place: a bridge's session, and behind it what hunter_ros2 does.

Written with a second library (rosbags, definitions of its own) and plain numbers: it knows nothing
of ros2/node.py. Messages are dictionaries with the names of the .msg files.
"""

import math
import threading
import time
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edge_runtime.transport import open_session

# Not part of common_interfaces: the definition as ros-drivers/ackermann_msgs has it.
_ACKERMANN = {
    "AckermannDrive": "float32 steering_angle\nfloat32 steering_angle_velocity\n"
    "float32 speed\nfloat32 acceleration\nfloat32 jerk\n",
    "AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
}
STORE = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in _ACKERMANN.items():
    STORE.register(get_types_from_msg(_text, f"ackermann_msgs/msg/{_name}"))


def serialize(type_name, message, little_endian=True):
    """CDR of a message given as a dictionary."""
    built = _build(type_name, message)
    return bytes(STORE.serialize_cdr(built, type_name, little_endian=little_endian))


def deserialize(type_name: str, payload: bytes) -> Any:
    """The message as a dictionary, arrays as lists."""
    return _plain(STORE.deserialize_cdr(payload, type_name))


def _build(type_name, message):
    _, fields = STORE.fielddefs[type_name]
    values = {}
    for name, (_, kind) in fields:
        value = message[name]
        if isinstance(value, dict):
            value = _build(str(kind), value)
        elif isinstance(value, list):
            value = np.array(value, dtype=np.float64)
        values[name] = value
    return STORE.types[type_name](**values)


def _plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if not name.startswith("__")]
        return {name: _plain(getattr(value, name)) for name in names}
    return value


TWIST, ODOMETRY = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"
DRIVE = "ackermann_msgs/msg/AckermannDriveStamped"
WHEELBASE_M, TRACK_M, MAX_INNER_RAD = 0.650, 0.605, 0.576
PERIOD_S = 0.02
CHASSIS_TIMEOUT_S = 0.5
ZERO = {"x": 0.0, "y": 0.0, "z": 0.0}


class RosHunter:
    """Turns the yaw rate of a Twist into the inner wheel's angle; publishes Odometry at 50 Hz."""

    def __init__(self, listen=None, connect=None, namespace=""):
        self.twists: list = []
        self.drives: list = []
        self.speed_mps = self.inner_rad = 0.0
        self.silent = False
        self._commanded_s = -math.inf
        self._session = session = open_session(listen=listen, connect=connect, mode="router")
        self.tokens: set = set()  # what a bridge watches
        prefix = f"{namespace}/" if namespace else ""
        odometry = session.declare_publisher(f"{prefix}odom")
        self._put = odometry.put
        self._declared: list = [
            session.declare_subscriber(f"{prefix}cmd_vel", self._hear_twist),
            session.declare_subscriber(f"{prefix}ackermann_cmd", self._hear_drive),
            session.liveliness().declare_subscriber(
                "@/*/@ros2_lv/**", self._note_token, history=True
            ),
            odometry,
        ]
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join()
        for declared in self._declared:
            declared.undeclare()
        self._session.close()

    @property
    def asked_mps(self):
        return float(self.twists[-1]["linear"]["x"]) if self.twists else 0.0

    def _hear_twist(self, sample):
        twist = deserialize(TWIST, sample.payload.to_bytes())
        self._commanded_s = time.monotonic()
        self.twists.append(twist)
        speed_mps, yaw_radps = twist["linear"]["x"], twist["angular"]["z"]
        self.inner_rad = 0.0
        if abs(yaw_radps) >= 0.001:
            radius_m = abs(speed_mps / yaw_radps)
            inner_rad = MAX_INNER_RAD
            if radius_m >= WHEELBASE_M:
                inner_rad = math.atan(WHEELBASE_M / (radius_m - TRACK_M / 2))
            self.inner_rad = math.copysign(inner_rad, yaw_radps)

    def _note_token(self, sample):
        change = self.tokens.add if "PUT" in str(sample.kind) else self.tokens.discard
        change(str(sample.key_expr))

    def _hear_drive(self, sample):
        self.drives.append(deserialize(DRIVE, sample.payload.to_bytes()))

    def _run(self):
        while not self._stopping.wait(PERIOD_S):
            is_late = time.monotonic() - self._commanded_s > CHASSIS_TIMEOUT_S
            target_mps = 0.0 if is_late else self.asked_mps
            self.speed_mps += 0.3 * (target_mps - self.speed_mps)
            if not self.silent:
                self._put(serialize(ODOMETRY, self.message()))

    def message(self):
        slope = math.tan(abs(self.inner_rad))
        centre = math.atan(WHEELBASE_M * slope / (WHEELBASE_M + TRACK_M / 2 * slope))
        yaw_radps = self.speed_mps / WHEELBASE_M * math.tan(math.copysign(centre, self.inner_rad))
        sec, nanosec = divmod(time.time_ns(), 10**9)
        twist = {"linear": {**ZERO, "x": self.speed_mps}, "angular": {**ZERO, "z": yaw_radps}}
        pose = {"position": ZERO, "orientation": {**ZERO, "w": 1.0}}
        return {
            "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "odom"},
            "child_frame_id": "base_link",
            "pose": {"pose": pose, "covariance": [0.0] * 36},
            "twist": {"twist": twist, "covariance": [0.0] * 36},
        }
