"""The ROS machine in its place: a bridge's session, and behind it what hunter_ros2 does.

Written with rosbags and plain numbers only. It takes geometry_msgs/Twist with a yaw rate, turns it
into the inner wheel's angle as that driver does, and publishes nav_msgs/Odometry at 50 Hz, whether
commands come or not.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any, Dict, List, Optional, Tuple

from edge_runtime.config import Ros2Settings
from edge_runtime.transport import open_session
from edge_runtime.vehicles.core import State
from edge_runtime.vehicles.mapping import CARS, SPECS, similarity_to
from edge_runtime.vehicles.ros2 import Ros2Core
from edge_runtime.vehicles.ros2.tests import second

WHEELBASE_M, TRACK_M, MAX_INNER_RAD = 0.650, 0.605, 0.576
PERIOD_S = 0.02
CHASSIS_TIMEOUT_S = 0.5
ZERO = {"x": 0.0, "y": 0.0, "z": 0.0}


class RosHunter:
    """Close it (a context manager): it has a thread and a session."""

    def __init__(
        self, listen: Optional[str] = None, connect: Optional[str] = None, namespace: str = ""
    ) -> None:
        self.twists: List[Tuple[float, Dict[str, Any]]] = []
        self.drives: List[Dict[str, Any]] = []
        self.tokens: set[str] = set()
        self.speed_mps = self.inner_rad = 0.0
        self.silent = False
        self._commanded_s = -math.inf
        self._session = open_session(listen=listen, connect=connect, mode="router")
        prefix = f"{namespace}/" if namespace else ""
        self._odometry = self._session.declare_publisher(f"{prefix}odom")
        self._declared: List[Any] = [
            self._session.declare_subscriber(f"{prefix}cmd_vel", self._hear_twist),
            self._session.declare_subscriber(f"{prefix}ackermann_cmd", self._hear_drive),
            self._session.liveliness().declare_subscriber(
                "@/*/@ros2_lv/**", self._hear_token, history=True
            ),
            self._odometry,
        ]
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> RosHunter:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()
        for declared in self._declared:
            declared.undeclare()
        self._session.close()

    @property
    def asked_mps(self) -> float:
        """The newest speed that it was told."""
        return float(self.twists[-1][1]["linear"]["x"]) if self.twists else 0.0

    def put(self, payload: bytes) -> None:
        """Something else on the odometry's topic."""
        self._odometry.put(payload)

    def _hear_twist(self, sample: Any) -> None:
        twist = second.deserialize("geometry_msgs/msg/Twist", sample.payload.to_bytes())
        self._commanded_s = time.monotonic()
        self.twists.append((self._commanded_s, twist))
        self.inner_rad = self._inner_of(twist["linear"]["x"], twist["angular"]["z"])

    def _hear_drive(self, sample: Any) -> None:
        name = "ackermann_msgs/msg/AckermannDriveStamped"
        self.drives.append(second.deserialize(name, sample.payload.to_bytes()))

    def _hear_token(self, sample: Any) -> None:
        change = self.tokens.add if "PUT" in str(sample.kind) else self.tokens.discard
        change(str(sample.key_expr))

    def _inner_of(self, speed_mps: float, yaw_radps: float) -> float:
        if abs(yaw_radps) < 0.001:
            return 0.0
        radius_m = abs(speed_mps / yaw_radps)
        if radius_m < WHEELBASE_M:
            return math.copysign(MAX_INNER_RAD, yaw_radps)
        return math.copysign(math.atan(WHEELBASE_M / (radius_m - TRACK_M / 2)), yaw_radps)

    def _run(self) -> None:
        while not self._stopping.wait(PERIOD_S):
            is_late = time.monotonic() - self._commanded_s > CHASSIS_TIMEOUT_S
            target_mps = 0.0 if is_late else self.asked_mps
            self.speed_mps += 0.3 * (target_mps - self.speed_mps)
            if not self.silent:
                self._odometry.put(second.serialize("nav_msgs/msg/Odometry", self._message()))

    def _message(self) -> Dict[str, Any]:
        slope = math.tan(abs(self.inner_rad))
        centre = math.atan(WHEELBASE_M * slope / (WHEELBASE_M + TRACK_M / 2 * slope))
        yaw_radps = self.speed_mps / WHEELBASE_M * math.tan(math.copysign(centre, self.inner_rad))
        now_ns = time.time_ns()
        stamp = {"sec": now_ns // 10**9, "nanosec": now_ns % 10**9}
        twist = {"linear": {**ZERO, "x": self.speed_mps}, "angular": {**ZERO, "z": yaw_radps}}
        pose = {"position": ZERO, "orientation": {**ZERO, "w": 1.0}}
        return {
            "header": {"stamp": stamp, "frame_id": "odom"},
            "child_frame_id": "base_link",
            "pose": {"pose": pose, "covariance": [0.0] * 36},
            "twist": {"twist": twist, "covariance": [0.0] * 36},
        }


SPEC = SPECS["2.0"]
LEFT_TURN = similarity_to(CARS["left_turn"], SPEC)
CONGESTION = similarity_to(CARS["congestion"], SPEC)
TICK_S = 0.02


class Drive:
    """A core with its time, and a vehicle that does at once what it is told (or not)."""

    def __init__(self, similarity=LEFT_TURN, **changes):
        self.core = Ros2Core(Ros2Settings(**changes), similarity)
        self.now_s = 100.0
        self.speed_mps = self.angular = 0.0
        self.sends_odometry = self.obeys = True
        self.motion = None

    def run(self, duration_s, action=None, scenario_speed_mps=None):
        """Ticks at 50 Hz with odometry at each, and the action (if any) at 10 Hz."""
        for tick in range(round(duration_s / TICK_S)):
            self.now_s += TICK_S
            if self.sends_odometry:
                stamp_ns = round(self.now_s * 1e9)
                self.core.hear(stamp_ns, self.speed_mps, self.angular, self.now_s)
            if action is not None and tick % 5 == 0:
                self.core.command(action, self.now_s, scenario_speed_mps)
            self.motion = self.core.tick(self.now_s)
            if self.obeys and self.motion is not None:
                self.speed_mps = self.motion.speed_mps
        return self.motion

    def start(self):
        self.core.enable(self.now_s)
        self.run(0.1)
        assert self.core.state is State.ENABLED
        return self

    @property
    def report(self):
        return self.core.report(self.now_s)
