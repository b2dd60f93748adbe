"""The driver's core with its time, and a vehicle of one line behind it."""

from __future__ import annotations

from edge_runtime.vehicles.hunter.specs import SPECS
from edge_runtime.vehicles.ros2.core import Ros2Core
from edge_runtime.vehicles.ros2.odometry import Measured
from edge_runtime.vehicles.ros2.settings import Ros2Settings
from edge_runtime.vehicles.ros2.states import State
from edge_runtime.vehicles.similarity import CARS, similarity_to

SPEC = SPECS["2.0"]
LEFT_TURN = similarity_to(CARS["left_turn"], SPEC.max_speed_mps)
CONGESTION = similarity_to(CARS["congestion"], SPEC.max_speed_mps)
TICK_S = 0.02


class Drive:
    """A core with its time, and a vehicle that does at once what it is told (or not)."""

    def __init__(self, similarity=LEFT_TURN, **changes):
        self.core = Ros2Core(Ros2Settings(**changes), SPEC, similarity)
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
                self.core.hear(Measured(stamp_ns, self.speed_mps, self.angular), self.now_s)
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
