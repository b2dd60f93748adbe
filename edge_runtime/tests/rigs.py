"""A driver that fails where it is told to; the core of a streamed vehicle in made-up time, and a
vehicle that obeys it at once, or not.
"""

import math
import threading

from hil_tests.tests.shared.policies import FRAMES, STEERING, T
from hil_tests.tests.shared.policies import PEDAL as PEDAL_ACTION

from edge_runtime.manifest import Car, Manifest
from edge_runtime.vehicles.hunter import HunterCore, protocol
from edge_runtime.vehicles.mapping import SPECS, similarity_to
from edge_runtime.vehicles.mock import MockParameters, MockVehicle
from edge_runtime.vehicles.ros2 import STEERING as ANGLE
from edge_runtime.vehicles.ros2 import Ros2Core, Ros2Settings
from edge_runtime.vehicles.streamed import VehicleState


def scenario_car(*numbers):
    return Car(**dict(zip(Car.__struct_fields__, numbers)))


SPEC = SPECS["2.0"]
CARS = {
    "left_turn": scenario_car(3.0, 4.0, 6.0, math.pi / 4, 5.0),
    "congestion": scenario_car(3.0, 4.0, 6.0, -0.15, 5.0),  # its action +1 turns right
}
LEFT_TURN, CONGESTION = (similarity_to(CARS[name], SPEC) for name in ("left_turn", "congestion"))
OK = protocol.SystemStatus(0, protocol.CAN_CONTROL, 24.0, 0, 0, 0)
STREAM_S = 0.02
PEDAL = {"pedal": 1.0}
CAR = scenario_car(1.0, 2.0, 5.0, 0.3, 1.0)


def a_manifest(car=CARS["left_turn"], **changes):
    fields = {
        "task": "parking", "observation": FRAMES, "action": [PEDAL_ACTION, STEERING],
        "control_period_s": T, "algorithm": "", "training": {}, "created": "",
    }  # fmt: skip
    return Manifest(car=car, **{**fields, **changes})


class BrokenVehicle(MockVehicle):
    """Notes what it is asked, raises what `raises` holds for a call, hangs in what `hangs` names.

    `odd` are fields of its reports that are replaced.
    """

    control_period_s = T

    def __init__(self):
        super().__init__()
        self.asked: list = []
        self.raises: dict = {}
        self.odd: dict = {}
        self.hangs = ""
        self.hanging, self.released = threading.Event(), threading.Event()

    def hang(self, call="feedback"):
        self.hangs = call
        assert self.hanging.wait(10.0)

    def go_on(self):
        self.hangs = ""
        self.released.set()

    def enable(self, now_s):
        self._take("enable", "enable")
        super().enable(now_s)

    def command(self, action, now_s, scenario_speed_mps=None):
        self._take("command", "command")
        self.scenario_speed_mps = scenario_speed_mps
        super().command(action, now_s, scenario_speed_mps)

    def brake(self, now_s, latch=True):
        self._take("brake", "brake" if latch else "stand")
        super().brake(now_s, latch)

    def feedback(self, now_s):
        self._take("feedback")
        return super().feedback(now_s)._replace(**self.odd)

    def close(self):
        self._take("close", "close")
        super().close()

    def _take(self, call, *notes):
        if self.hangs == call:
            self.hanging.set()
            self.released.wait()
        self.asked.extend(notes)
        if self.raises.get(call):
            raise self.raises[call]


class Rig:
    """`obeys`: the vehicle does what it is told; `talks`: it reports, after each tick.

    `jammed_rad`: its inner wheel's angle, whatever is asked.
    """

    def __init__(self, core):
        self.core, self.now_s, self.ticks = core, 100.0, 0
        core.follow_period(T)
        self.obeys = self.talks = True
        self.speed_mps = self.inner_rad = 0.0
        self.jammed_rad = None
        self.sent_in = core.state
        self.sent = []  # each frame or message with its time
        self.asked = []  # each speed with its time

    def step(self, count=1, action=None, scenario_speed_mps=None):
        """Ticks of 20 ms; with an action, a command every 100 ms."""
        for _ in range(count):
            if action is not None and self.ticks % 5 == 0:
                self.core.command(action, self.now_s, scenario_speed_mps)
            due = self.core.tick(self.now_s)
            self.sent_in = self.core.state  # what the vehicle then says may change it
            self.exchange(due)
            self.ticks += 1
            self.now_s = 100.0 + self.ticks * STREAM_S
        return self

    def exchange(self, due):
        raise NotImplementedError

    def enabled(self):
        self.core.enable(self.now_s)
        self.step(6)
        assert self.core.state is VehicleState.ENABLED
        return self

    def driving(self, seconds=1.0):
        self.enabled().step(round(seconds / STREAM_S), PEDAL)
        assert self.core.set_point.speed_mps > 0
        return self

    def speeds(self, since=0):
        return [speed_mps for _, speed_mps in self.asked[since:]]

    @property
    def report(self):
        return self.core.report(self.now_s)

    @property
    def words(self):
        return self.report.faults


class HunterRig(Rig):
    """The chassis speaks in frames written by hand: `status` each 100 ms, the motion each 20 ms."""

    silence, lie, battery_v = "the chassis sends no 0x221", "the chassis reports 3.0 m/s", 24.0

    def __init__(self, scenario="left_turn", scale=None):
        super().__init__(HunterCore(similarity_to(CARS[scenario], SPEC, scale), "v2"))
        self.status = OK
        self.counter = 0  # of 0x211; None: it stands still

    def exchange(self, parts):
        for frame, data in parts:
            self.sent.append((self.now_s, frame.can_id, data))
            message = protocol.decode(frame.can_id, data)
            if isinstance(message, protocol.WheelMotion):
                self.asked.append((self.now_s, message.speed_mps))
                if self.obeys:
                    self.speed_mps, self.inner_rad = message
        if self.jammed_rad is not None:
            self.inner_rad = self.jammed_rad
        if self.talks:
            motion = protocol.WheelMotion(self.speed_mps, self.inner_rad)
            self.tell(protocol.MOTION_STATUS, motion)
            if self.ticks % 5 == 0:
                self.tell(protocol.SYSTEM_STATUS, self.status)

    def disturb(self, number):
        self.status = OK._replace(mode=number % 4, state=number % 3)
        can_ids, data = [*protocol.FRAMES, 0x7FF], number.to_bytes(8, "big", signed=True)
        self.core.hear(can_ids[number % len(can_ids)], data[: number % 50 or 7], self.now_s)

    def tell(self, frame, message):
        if isinstance(message, protocol.SystemStatus) and self.counter is not None:
            self.counter = (self.counter + 1) % 256
            message = message._replace(counter=self.counter)
        self.core.hear(frame.can_id, protocol.encode(frame, message), self.now_s)

    def ids(self, since=0):
        return [can_id for _, can_id, _ in self.sent[since:]]

    def frames(self, since=0):
        return [(can_id, data) for _, can_id, data in self.sent[since:]]


class Ros2Rig(Rig):
    """Odometry after each tick; `angular` is what it says of the wheels, None: what is true."""

    silence, lie, battery_v = "no fresh odometry on odom", "the odometry says 3.0 m/s", None

    def __init__(self, scenario="left_turn", scale=None, **settings):
        self.settings = Ros2Settings(**settings)
        super().__init__(Ros2Core(self.settings, similarity_to(CARS[scenario], SPEC, scale)))
        self.angular = None
        self.centre_rad = 0.0

    def disturb(self, number):
        self.core.hear(number, float(number), -(float(number) ** 8), self.now_s)

    def exchange(self, motion):
        if motion is not None:
            self.sent.append((self.now_s, motion))
            self.asked.append((self.now_s, motion.speed_mps))
            if self.obeys:
                self.speed_mps, self.centre_rad = motion
                self.inner_rad = SPEC.inner_rad(self.centre_rad)
        if self.jammed_rad is not None:
            self.centre_rad = SPEC.centre_rad(self.jammed_rad)
        if self.talks:
            angular = self.centre_rad
            if self.settings.odometry_angular != ANGLE:
                angular = self.speed_mps * math.tan(self.centre_rad) / SPEC.wheelbase_m
            angular = angular if self.angular is None else self.angular
            self.core.hear(round(self.now_s * 1e9), self.speed_mps, angular, self.now_s)


class MockRig(Rig):
    """The mock in place of a core: it needs no ticks, and obeys by itself."""

    def __init__(self, **parameters):
        self.core, self.now_s, self.ticks = MockVehicle(MockParameters(**parameters)), 100.0, 0
        self.core.control_period_s = T

    def step(self, count=1, action=None, scenario_speed_mps=None):
        for _ in range(count):
            if action is not None and self.ticks % 5 == 0:
                self.core.command(action, self.now_s, scenario_speed_mps)
            self.ticks += 1
            self.now_s = 100.0 + self.ticks * STREAM_S
        return self

    def enabled(self):
        self.core.enable(self.now_s)
        return self.step(6)

    def driving(self, seconds=1.0):
        return self.enabled().step(round(seconds / STREAM_S), PEDAL)

    @property
    def report(self):
        return self.core.feedback(self.now_s)
