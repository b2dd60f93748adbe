"""A Hunter's core in made-up time, against frames of the chassis written by hand."""

from __future__ import annotations

from edge_runtime.vehicles.core import State
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.core import HunterCore
from edge_runtime.vehicles.mapping import CARS, SPECS, similarity_to

SPEC = SPECS["2.0"]
OK = protocol.SystemStatus(0, protocol.CAN_CONTROL, 24.0, 0, 0, 0)
STREAM_S, STATUS_EVERY = 0.02, 5


class Bench:
    """A core, a chassis that obeys at once and says what it is told to, and a clock."""

    def __init__(self, scenario="left_turn"):
        self.core = HunterCore(similarity_to(CARS[scenario], SPEC), "v2")
        self.now_s = 100.0
        self.status = OK
        self.obeys = True
        self.hears = True
        self.speed_mps = self.inner_rad = 0.0
        self.sent = []
        self.ticks = 0
        self.counter = 0  # of 0x211; None: it stands still

    def step(self, count=1, action=None, scenario_speed_mps=None):
        """Ticks of 20 ms; with an action, a command every 100 ms."""
        for _ in range(count):
            if action is not None and self.ticks % STATUS_EVERY == 0:
                self.core.command(action, self.now_s, scenario_speed_mps)
            parts = self.core.tick(self.now_s)
            self.sent += [(self.now_s, part) for part in parts]
            self._answer(parts)
            self.ticks += 1
            self.now_s = 100.0 + self.ticks * STREAM_S
        return self

    def _answer(self, parts):
        for frame, data in parts:
            message = protocol.decode(frame.can_id, data)
            if isinstance(message, protocol.MotionCommand) and self.obeys:
                self.speed_mps, self.inner_rad = message
        if not self.hears:
            return
        motion = protocol.MotionStatus(self.speed_mps, self.inner_rad)
        self.tell(protocol.MOTION_STATUS, motion)
        if self.ticks % STATUS_EVERY == 0:
            self.tell(protocol.SYSTEM_STATUS, self.status)

    def tell(self, frame, message):
        if isinstance(message, protocol.SystemStatus) and self.counter is not None:
            self.counter = (self.counter + 1) % 256
            message = message._replace(counter=self.counter)
        self.core.hear(frame.can_id, protocol.encode(frame, message), self.now_s)

    def enabled(self):
        self.core.enable(self.now_s)
        self.step(6)
        assert self.core.state is State.ENABLED
        return self

    def driving(self, seconds=1.0):
        self.enabled().step(round(seconds / STREAM_S), {"pedal": 1.0})
        assert self.core.set_point.speed_mps > 0
        return self

    @property
    def words(self):
        return self.core.report(self.now_s).faults

    def motions(self, since=0):
        return [told for _, told in self.motions_at(since)]

    def motions_at(self, since=0):
        """Each 0x111 with its time."""
        return [
            (time_s, protocol.decode(0x111, part.data))
            for time_s, part in self.sent[since:]
            if part.frame.can_id == 0x111
        ]


def sent_ids(bench):
    return [part.frame.can_id for _, part in bench.sent]
