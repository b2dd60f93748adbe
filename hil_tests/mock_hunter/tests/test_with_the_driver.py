"""The edge runtime's driver and the mock's chassis in made-up time: every fault at many phases.

The campaign does the same with real processes on a real bus; here a try takes some milliseconds.
"""

from __future__ import annotations

import pytest

from edge_runtime.vehicles.core import DEVIATES_S, FOLLOWS_S, State
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.core import HunterCore
from edge_runtime.vehicles.mapping import CARS, SPECS, similarity_to
from hil_tests.mock_hunter.faults import BITS, FAULTS
from hil_tests.mock_hunter.hunter import MockHunter
from hil_tests.mock_hunter.parameters import make_parameters

SPEC = SPECS["2.0"]
TICK_S = 0.02
WORDS = {
    "silent": "sends no 0x2",
    "frozen": "the counter of 0x211 stands still",
    "bus_off": "sends no 0x2",
    "late": "sends no 0x2",
    "lying": "the chassis reports",
    "stuck": "the speed stays at",
    "remote": "the remote control drives",
    "estop": "the emergency stop is pressed",
    **{name: bit.words for name, bit in BITS.items()},
}
STANDING = ("silent", "frozen", "bus_off", "remote", "estop")
# 2 T and 50 ms after the driver could know: 0x211 tells within 100 ms, silence tells itself.
STOPS_WITHIN_S = {"stuck": FOLLOWS_S + DEVIATES_S + 0.35}
STANDS_WITHIN_S = 1.5  # from 1.5 m/s at the mock's 2 to 3 m/s2, or by the brake after 1 s


class Pair:
    """The driver's ticks, the chassis's frames and a policy's commands on one clock."""

    def __init__(self):
        similarity = similarity_to(CARS["left_turn"], SPEC.max_speed_mps)
        self.core = HunterCore(SPEC, "v2", similarity)
        self.now_s = 50.0
        self.mock = MockHunter(make_parameters("hunter-2.0"), self.now_s)
        self.pedal = 1.0
        self.asked_mps = 0.0
        self.moved_s = self.moving_set_point_s = self.now_s
        self._tick_s = self._command_s = self.now_s

    def run(self, seconds):
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s = min(end_s, self._command_s, self._tick_s, self.mock.next_s)
            if self.now_s >= self._command_s:
                self._command_s += 0.1
                self.core.command({"pedal": self.pedal}, self.now_s)
            if self.now_s >= self._tick_s:
                self._tick_s += TICK_S
                self._send()
            if self.now_s >= self.mock.next_s:
                for can_id, data in self.mock.due(self.now_s):
                    self.core.hear(can_id, data, self.now_s)
            self.mock.advance(self.now_s)
            if not self.mock.body.stands:
                self.moved_s = self.now_s
        return self

    def _send(self):
        for frame, data in self.core.tick(self.now_s):
            self.mock.receive(frame.can_id, data, self.now_s)
            if frame is protocol.MOTION_COMMAND:
                self.asked_mps = int.from_bytes(data[:2], "big", signed=True) / 1000
                if self.asked_mps:
                    self.moving_set_point_s = self.now_s

    def enabled(self):
        self.core.enable(self.now_s)
        self.run(0.3)
        assert self.core.state is State.ENABLED, self.core.words
        return self

    def switch(self, name, on):
        self.mock.switch(name, on, self.now_s)


@pytest.mark.parametrize("phase", range(6))
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_stops_it_is_named_and_only_enabling_moves_it_again(name, phase):
    pair = Pair().enabled().run(1.5 + phase * 0.0171)
    assert pair.mock.body.speed_mps > 0.9
    pair.switch(name, True)
    pair.pedal = -1.0 if name == "stuck" else 1.0
    fault_s = pair.now_s
    pair.run(STOPS_WITHIN_S.get(name, 0.35) + STANDS_WITHIN_S)
    assert pair.core.state is State.STOPPED
    assert pair.moving_set_point_s - fault_s <= STOPS_WITHIN_S.get(name, 0.35)
    assert pair.moved_s < pair.now_s
    assert any(WORDS[name] in words for words in pair.core.report(pair.now_s).faults)
    assert bool(pair.core.standing(pair.now_s)) == (name in STANDING)
    pair.pedal = 1.0
    pair.switch(name, False)
    over_s = pair.now_s
    pair.run(1.0)
    assert max(pair.moved_s, pair.moving_set_point_s) <= over_s
    assert pair.core.standing(pair.now_s) == []
    pair.enabled().run(1.0)
    assert pair.core.report(pair.now_s).faults == []
    assert pair.mock.body.speed_mps > 0.3


def test_a_whole_drive_without_a_fault_is_never_stopped():
    pair = Pair().enabled()
    for number in range(40):
        pair.pedal = (-1.0, 1.0, 0.3, -0.4, 1.0)[number % 5]
        pair.run(0.2 + 0.03 * (number % 7))
        assert pair.core.state is State.ENABLED, pair.core.words


def test_a_pause_of_the_edge_longer_than_the_chassiss_time_out_does_not_move_it_on():
    pair = Pair().enabled().run(1.0)
    pair.now_s += 0.8  # nothing ran here: the process was stopped
    pair._tick_s = pair._command_s = pair.now_s
    pair.mock.advance(pair.now_s)
    assert pair.mock.body.speed_mps < 0.5  # the chassis's own time-out
    pair.run(2.0)
    assert pair.core.state is State.STOPPED
    assert pair.asked_mps == 0.0
    assert pair.mock.body.stands
