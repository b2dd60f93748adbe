"""What every vehicle of this package does, in made-up time; and the mock by hand."""

import math
from typing import Any

import pytest
from hil_tests.tests.shared.policies import T
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.tests.rigs import CAR, PEDAL, HunterRig, MockRig, Ros2Rig, a_manifest
from edge_runtime.vehicles import make_vehicle

WILD = st.floats(allow_nan=False, allow_infinity=False)
BAD = [{name: value} for name in ("pedal", "steering") for value in (math.nan, math.inf, -math.inf)]


class VehicleConformance:
    """The rules of `Vehicle`, for the rig of a subclass."""

    make: Any = MockRig
    holds_s = 2 * T  # a command
    latches_silence = True  # only `enable` moves it after commands ceased

    @pytest.fixture
    def rig(self):
        return self.make()

    def moves(self, rig):
        return rig.report.speed_mps > 0.01

    def test_nothing_moves_it_before_it_is_enabled_nor_then_before_a_command(self, rig):
        assert not self.moves(rig.step(100, PEDAL))
        assert not self.moves(rig.enabled().step(100))

    def test_commands_move_it_and_without_them_it_brakes_by_itself(self, rig):
        report = rig.driving().report
        assert report.speed_mps > 0.3
        assert (report.self_braking, report.faults, list(report.standing)) == (False, [], [])
        rig.core.command(PEDAL, rig.now_s)
        rig.step(round(self.holds_s / 0.02))
        assert not rig.report.self_braking
        assert rig.step(2).report.self_braking
        assert not self.moves(rig.step(200))
        assert self.moves(rig.step(50, PEDAL)) != self.latches_silence

    @pytest.mark.parametrize("latch", [True, False])
    def test_a_stop_brakes_and_lasts_until_enable_or_the_next_command(self, rig, latch):
        rig.driving().step(50, {**PEDAL, "steering": 0.5}).core.brake(rig.now_s, latch)
        assert not self.moves(rig.step(200))
        assert rig.report.action == pytest.approx({"pedal": -1.0, "steering": 0.5}, abs=0.01)
        rig.step(50, PEDAL)
        assert self.moves(rig) != latch
        rig.core.brake(rig.now_s, latch)
        assert self.moves(rig.enabled().step(50, PEDAL))

    @pytest.mark.parametrize("action", [*BAD, {}, {"": 0.5}])
    def test_a_command_that_is_not_finite_or_lacks_an_action_is_refused(self, rig, action):
        with pytest.raises(ValueError, match="a command that"):
            rig.enabled().core.command(action, rig.now_s)
        assert not self.moves(rig.step(10))

    def test_it_stays_within_its_limits_whatever_is_asked(self):
        @settings(max_examples=50)
        @given(st.lists(st.tuples(WILD, WILD), max_size=10))
        def drive(actions):
            rig = self.make().enabled()
            for pedal, steering in actions:
                rig.step(5, {"pedal": pedal, "steering": steering})
                assert all(-1.0 <= value <= 1.0 for value in rig.report.action.values())
                assert 0.0 <= rig.report.speed_mps <= 6.0

        drive()


class TestHunter(VehicleConformance):
    make = HunterRig
    holds_s = 2.4 * T


class TestRos2(VehicleConformance):
    make = Ros2Rig
    holds_s = 2.4 * T


class TestMock(VehicleConformance):
    latches_silence = False

    def test_it_is_no_quicker_than_the_policys_car_or_that_of_the_settings(self):
        fast = {"max_speed_mps": 8.0, "throttle_mps2": 2.0}
        for car, ours, most in ((CAR, {}, 5.0), (None, {}, 6.0), (CAR, fast, 8.0)):
            vehicle = make_vehicle("mock", {"mock": ours}, a_manifest(car))
            vehicle.control_period_s = T
            vehicle.enable(0.0)
            for tick in range(100):
                vehicle.command(PEDAL, tick * 0.1)
            assert vehicle.feedback(10.0).speed_mps == most

    @pytest.mark.parametrize("brakes", [False, True])
    def test_the_dead_time_passes_before_anything_moves_and_a_brake_overtakes_it(self, brakes):
        vehicle = MockRig(dead_time_s=0.1).enabled().core
        vehicle.command(PEDAL, 200.0)
        if brakes:
            vehicle.brake(200.05)
        assert vehicle.feedback(200.09).action["pedal"] == -1.0
        assert (vehicle.feedback(200.19).action["pedal"] > -1.0) != brakes
        assert vehicle.feedback(1e6).speed_mps == 0.0  # a long gap is no long computation


del VehicleConformance  # not to be collected for itself
