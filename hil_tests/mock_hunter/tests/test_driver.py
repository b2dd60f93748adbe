"""The Hunter's driver against the mock in made-up time: each fault, and no false alarm."""

import itertools
import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from edge_runtime.vehicles.core import VehicleState
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.core import HunterCore
from edge_runtime.vehicles.mapping import SPECS, similarity_to
from edge_runtime.vehicles.plausibility import DEVIATES_S, FOLLOWS_S, Fault
from hil_tests.mock_hunter.chassis import BITS, FAULTS
from hil_tests.mock_hunter.hunter import MockHunter, make_parameters
from hil_tests.testing.vehicles import CARS, STREAM_S, Rig

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
        parameters = make_parameters(f"hunter-{model}", changes)
        self.mock = MockHunter(parameters, self.now_s - STREAM_S / 2)
        self.moved_s = self.moving_set_point_s = self.now_s
        self.pedal, self.steering = 1.0, None
        self.delays_s = itertools.repeat(0.0)  # of the frames of each tick, on their way to us
        self.coming = []

    def run(self, seconds):
        steering = {} if self.steering is None else {"steering": self.steering}
        return self.step(round(seconds / STREAM_S), {"pedal": self.pedal, **steering})

    def exchange(self, due):
        for frame, data in due:
            self.mock.receive(frame.can_id, data, self.now_s)
            if frame is protocol.MOTION_COMMAND:
                self.asked.append(int.from_bytes(data[:2], "big", signed=True) / 1000)
                if self.asked[-1]:
                    self.moving_set_point_s = self.now_s
        if self.jammed_rad is not None:
            self.mock.body = self.mock.body._replace(inner_rad=self.jammed_rad)
        delay_s = next(self.delays_s)
        self.coming += [(self.now_s + delay_s, *each) for each in self.mock.due(self.now_s)]
        while self.coming and self.coming[0][0] <= self.now_s:  # a bus keeps their order
            _, frame, data = self.coming.pop(0)
            self.core.hear(frame.can_id, data, self.now_s)
        if not self.mock.body.stands:
            self.moved_s = self.now_s

    def switch(self, name, on):
        self.mock.switch(name, on, self.now_s)


@pytest.mark.parametrize("phase_s", [0.0, 0.04, 0.08])
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_stops_it_is_named_and_only_enabling_moves_it_again(name, phase_s):
    pair = Pair().enabled().run(1.5 + phase_s)
    assert pair.mock.body.speed_mps > 0.9
    pair.switch(name, True)
    pair.pedal = -1.0 if name == "stuck" else 1.0
    fault_s = pair.now_s
    pair.run(STOPS_WITHIN_S.get(name, 0.35) + STANDS_WITHIN_S)
    assert pair.core.state is VehicleState.STOPPED
    assert pair.moving_set_point_s - fault_s <= STOPS_WITHIN_S.get(name, 0.35)
    assert pair.moved_s < pair.now_s
    assert any(WORDS[name] in words for words in pair.words)
    assert bool(pair.core.standing(pair.now_s)) == (name in STANDING)
    pair.pedal = 1.0
    pair.switch(name, False)
    over_s = pair.now_s
    pair.run(1.0)
    assert max(pair.moved_s, pair.moving_set_point_s) <= over_s
    assert pair.core.standing(pair.now_s) == []
    pair.enabled().run(1.0)
    assert pair.words == []
    assert pair.mock.body.speed_mps > 0.3


def test_a_whole_drive_without_a_fault_is_never_stopped():
    pair = Pair().enabled()
    for number in range(40):
        pair.pedal = (-1.0, 1.0, 0.3, -0.4, 1.0)[number % 5]
        pair.run(0.2 + 0.03 * (number % 7))
        assert pair.core.state is VehicleState.ENABLED, pair.words


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
    parked_rad = parked * pair.core.similarity.spec.max_inner_steering_rad
    pair.mock.body = pair.mock.body._replace(inner_rad=parked_rad)
    pair.enabled().delays_s = delays_s
    for middle, swing, swings_hz, pedal in manoeuvres:
        for tick in range(50):
            wave = math.sin(2 * math.pi * swings_hz * tick * STREAM_S)
            if swings_hz.is_integer():  # square: steps and reversals
                wave = math.copysign(1.0, wave)
            steering = min(max(middle + swing * wave, -1.0), 1.0)
            pair.step(1, {"pedal": pedal, "steering": steering})
        assert pair.core.state is VehicleState.ENABLED, pair.words


FOUND_WITHIN_S = 0.8  # as by the core's own tests, and what a late bus adds


@settings(max_examples=50)
@given(pairs, jitter, unit, unit, st.booleans(), st.floats(0.2, 1.0))
def test_a_wheel_that_stays_anywhere_else_is_found(
    pair, delays_s, jammed, steering, at_once, pedal
):
    """From the first moment on, or in the middle of a drive."""
    pair.pedal, pair.steering, similarity = pedal, steering, pair.core.similarity
    spec, asked_rad = similarity.spec, similarity.centre_rad(steering)
    full_rad = spec.centre_rad(spec.max_inner_steering_rad)
    jammed_rad = jammed * spec.max_inner_steering_rad
    pair.jammed_rad = jammed_rad if at_once else None
    asked_rad = min(max(asked_rad, -full_rad), full_rad)
    wrong_rad = abs(asked_rad - spec.centre_rad(jammed_rad)) - 0.1 * full_rad
    assume(wrong_rad > 0.001)
    pair.enabled().delays_s = delays_s
    pair.run(0.5 if at_once else 3.0)  # it moves
    assert pair.core.state is VehicleState.ENABLED
    pair.jammed_rad = jammed_rad
    turns_s = abs(pair.core.set_point.inner_rad - spec.inner_rad(asked_rad))  # at 1 rad/s
    pair.run(turns_s + FOUND_WITHIN_S)
    assert pair.core.cause is Fault.STEERING_STUCK


def test_a_pause_of_the_edge_longer_than_the_chassiss_time_out_does_not_move_it_on():
    pair = Pair().enabled().run(1.0)
    pair.ticks += 40  # nothing ran here: the process was stopped
    pair.now_s += 0.8
    pair.mock.advance(pair.now_s)
    assert pair.mock.body.speed_mps < 0.5  # the chassis's own time-out
    pair.run(2.0)
    assert pair.core.state is VehicleState.STOPPED
    assert pair.asked[-1] == 0.0
    assert pair.mock.body.stands
