"""The Hunter's driver against the mock in made-up time: each fault, and no false alarm."""

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.tests.rigs import CARS, STREAM_S, Rig
from edge_runtime.vehicles.hunter import HunterCore, protocol
from edge_runtime.vehicles.mapping import SPECS, similarity_to
from edge_runtime.vehicles.plausibility import DEVIATES_S, FOLLOWS_S
from edge_runtime.vehicles.streamed import VehicleState
from hil_tests.mock_hunter import BITS, FAULTS, MODELS, MockHunter

WORDS = {
    **dict.fromkeys(("silent", "bus_off", "late"), "sends no 0x2"),
    "frozen": "the counter of 0x211 stands still",
    "lying": "the chassis reports",
    "stuck": "the speed stays at",
    "full_lock": "the steering stays at",
    "remote": "the remote control drives",
    "estop": "the emergency stop is pressed",
    **{name: bit.words for name, bit in BITS.items()},
}
STANDING = ("silent", "frozen", "bus_off", "remote", "estop")
# 2 T and 50 ms after the driver could know: 0x211 tells within 100 ms, silence tells itself.
STOPS_WITHIN_S = {"stuck": FOLLOWS_S + DEVIATES_S + 0.35}
STANDS_WITHIN_S = 1.5  # from 1.5 m/s at the mock's 2 to 3 m/s2, or by the brake after 1 s


class Pair(Rig):
    """The driver's ticks, the mock's frames between them, and a policy's pedal and steering."""

    def __init__(self, car="left_turn", model="2.0", **changes):
        super().__init__(HunterCore(similarity_to(CARS[car], SPECS[model]), "v2"))
        parameters = replace(MODELS[f"hunter-{model}"], **changes)
        self.mock = MockHunter(parameters, self.now_s - STREAM_S / 2)
        self.moved_s = self.moving_set_point_s = self.now_s
        self.pedal = 1.0
        self.delays_s = itertools.repeat(0.0)  # of the frames of each tick, on their way to us
        self.coming = []

    def run(self, seconds):
        return self.step(round(seconds / STREAM_S), {"pedal": self.pedal})

    def exchange(self, due):
        for frame, data in due:
            self.mock.receive(frame.can_id, data, self.now_s)
            if frame is protocol.MOTION_COMMAND:
                self.asked.append(int.from_bytes(data[:2], "big", signed=True) / 1000)
                if self.asked[-1]:
                    self.moving_set_point_s = self.now_s
        delay_s = next(self.delays_s)
        self.coming += [(self.now_s + delay_s, *each) for each in self.mock.due(self.now_s)]
        while self.coming and self.coming[0][0] <= self.now_s:  # a bus keeps their order
            _, frame, data = self.coming.pop(0)
            self.core.hear(frame.can_id, data, self.now_s)
        self.moved_s = self.moved_s if self.mock.stands else self.now_s


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_stops_it_is_named_and_only_enabling_moves_it_again(name):
    pair = Pair().enabled().run(1.5)
    assert pair.mock.speed_mps > 0.9
    pair.mock.switch(name, True, pair.now_s)
    pair.pedal = -1.0 if name == "stuck" else 1.0
    fault_s = pair.now_s
    pair.run(STOPS_WITHIN_S.get(name, 0.35) + STANDS_WITHIN_S)
    assert pair.core.state is VehicleState.STOPPED
    assert pair.moving_set_point_s - fault_s <= STOPS_WITHIN_S.get(name, 0.35)
    assert pair.moved_s < pair.now_s
    assert any(WORDS[name] in words for words in pair.words)
    assert bool(pair.core.standing(pair.now_s)) == (name in STANDING)
    pair.pedal = 1.0
    pair.mock.switch(name, False, pair.now_s)
    over_s = pair.now_s
    pair.run(1.0)
    assert max(pair.moved_s, pair.moving_set_point_s) <= over_s
    assert pair.core.standing(pair.now_s) == []
    assert pair.enabled().run(1.0).mock.speed_mps > 0.3


unit = st.floats(-1, 1)
pairs = st.builds(
    Pair, st.sampled_from(sorted(CARS)), st.sampled_from(sorted(SPECS)),
    dead_time_s=st.floats(0.0, 0.1), steering_rate_radps=st.floats(1.0, 2.0),
)  # fmt: skip
jitter = st.lists(st.floats(0.0, 0.06), min_size=1, max_size=20).map(itertools.cycle)
# Of one second: what the steering swings about, by how much, how often a second, and the pedal.
manoeuvre = st.tuples(unit, unit, st.integers(1, 3).map(float) | st.floats(0, 3), unit)


@settings(max_examples=50)
@given(pairs, jitter, unit, st.lists(manoeuvre, min_size=1, max_size=6))
def test_no_steering_of_a_healthy_chassis_is_accused(pair, delays_s, parked, manoeuvres):
    """Steps, reversals and swings at and above its rate, a bus that is late, any pedal, and wheels
    that stood anywhere when it was switched on."""
    pair.mock.inner_rad = parked * pair.core.similarity.spec.max_inner_steering_rad
    pair.enabled().delays_s = delays_s
    for middle, swing, swings_hz, pedal in manoeuvres:
        for tick in range(50):
            wave = math.sin(2 * math.pi * swings_hz * tick * STREAM_S)
            if swings_hz.is_integer():  # square: steps and reversals
                wave = math.copysign(1.0, wave)
            steering = min(max(middle + swing * wave, -1.0), 1.0)
            pair.step(1, {"pedal": pedal, "steering": steering})
        assert pair.core.state is VehicleState.ENABLED, pair.words
