"""The operator's bounds: speed and steering of every driver, and the leash, in made-up time."""

import contextlib
import math
from typing import Any

import pytest
from hil_tests.tests.shared.policies import T
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.bounds import NO_BOUNDS, Bounds, Leash, Model, narrowed
from edge_runtime.tests.rigs import (
    CARS,
    SPEC,
    STREAM_S,
    BrokenVehicle,
    HunterRig,
    MockRig,
    Ros2Rig,
    a_manifest,
)
from edge_runtime.util import UserError
from edge_runtime.vehicles import find_vehicle, make_vehicle, vehicle_limits
from edge_runtime.vehicles.mapping import SPECS, similarity_to
from edge_runtime.vehicles.plausibility import Fault, VehicleWatch

MODEL = {"mock": (6.0, abs(CARS["left_turn"].full_steering_rad)), "hunter": SPEC[:2]}
MODEL["ros2"] = MODEL["hunter"]


@pytest.mark.parametrize("name", MODEL)
@pytest.mark.parametrize("place", [0, 1])
def test_a_cap_above_the_models_limit_is_refused(name, place):
    most = MODEL[name][place]
    for cap, is_refused in ((most, False), (1.001 * most, True)):
        bounds = Bounds(**{Bounds._fields[place]: cap})
        if is_refused:
            with pytest.raises(UserError, match=Bounds._fields[place]):
                vehicle_limits(name, {}, a_manifest(), bounds)
        else:
            vehicle_limits(name, {}, a_manifest(), bounds)
    assert find_vehicle(name).limits_of({}, a_manifest())[1][:2] == pytest.approx(MODEL[name])


def test_an_angle_that_a_driver_does_not_know_is_not_capped():
    vehicle = BrokenVehicle()  # as a plug-in that says nothing of itself
    vehicle.take_bounds(Bounds(max_speed_mps=0.5))
    with pytest.raises(UserError, match="max_steering_rad"):
        vehicle.take_bounds(Bounds(max_steering_rad=0.1))


@pytest.mark.parametrize("full_rad", [0.0, -0.4, math.nan])
def test_an_angle_that_is_none_is_not_known(full_rad):
    vehicle, model = BrokenVehicle(), Model(6.0, 0.4, full_rad)
    vehicle.model_limits = model
    with pytest.raises(UserError, match="max_steering_rad"):
        vehicle.take_bounds(Bounds(max_steering_rad=0.1))
    assert narrowed(vehicle.limits, NO_BOUNDS, model) == vehicle.limits


@pytest.mark.parametrize("make", [HunterRig, Ros2Rig, MockRig])
@pytest.mark.parametrize("scale", [0.05, None, 2.0])  # as meant, as default, and a wrong one
@pytest.mark.parametrize("pedal", [1.0, 0.2])  # full throttle, and one that adds up
def test_no_driver_is_faster_than_its_cap_and_each_reaches_it(make, scale, pedal):
    cap_mps = 0.3
    rig = make() if make is MockRig else make(scale=scale)
    take = rig.core.take_bounds if make is MockRig else rig.core.set_point.take_bounds
    take(Bounds(max_speed_mps=cap_mps))
    speeds = []
    for step in range(1000):
        rig.step(1, {"pedal": pedal, "steering": 0.0}) if step else rig.enabled()
        speeds.append(rig.report.speed_mps)
    assert max(speeds) == pytest.approx(cap_mps, rel=0.03)
    # A policy without a pedal follows the scenario's car.
    if make is not MockRig:
        rig.step(100, {"steering": 0.0}, scenario_speed_mps=6.0)
        assert rig.report.speed_mps <= cap_mps + 1e-9


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@given(scenario=st.sampled_from(list(CARS)), share=st.floats(0.01, 1.0), scale=st.floats(0.02, 2.0))
def test_the_loops_range_of_steering_is_never_above_the_cap(spec, scenario, share, scale):
    similarity, cap_rad = similarity_to(CARS[scenario], spec, scale), share * spec[1]
    bounds = Bounds(max_steering_rad=cap_rad)
    limit = narrowed(similarity.limits(), bounds, similarity.model())["steering"]
    for end in (limit.low, limit.high):
        assert abs(spec.inner_rad(similarity.centre_rad(end))) <= cap_rad + 1e-9
    assert narrowed(similarity.limits(), Bounds(), similarity.model()) == similarity.limits()


@pytest.mark.parametrize("make", [HunterRig, Ros2Rig])
@settings(max_examples=40)
@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8))
def test_no_wheel_is_turned_further_than_its_cap(make, wishes):
    rig, cap_rad = make("congestion"), 0.05
    rig.core.set_point.take_bounds(Bounds(max_steering_rad=cap_rad))
    rig.enabled()
    for wish in wishes:
        rig.step(20, {"pedal": 0.3, "steering": wish})
        assert abs(rig.inner_rad) <= cap_rad + 1e-3


def test_a_real_driver_hands_its_bounds_to_what_decides():
    tables = {"hunter": {"bus": "virtual:bounds"}}
    with contextlib.closing(make_vehicle("hunter", tables, a_manifest())) as vehicle:
        vehicle.take_bounds(Bounds(0.3, 0.2))
        core: Any = vehicle
        assert core._core.set_point.spec[:2] == (0.3, 0.2)
        assert core._core.similarity.spec[:2] == SPEC[:2]  # what it can do is the model's


def test_a_mocks_range_of_steering_is_in_proportion():
    full_rad = abs(CARS["congestion"].full_steering_rad)
    bounds = Bounds(max_steering_rad=full_rad / 3)
    limits = vehicle_limits("mock", {}, a_manifest(CARS["congestion"]), bounds)
    assert limits["steering"][:2] == pytest.approx((-1 / 3, 1 / 3))


def test_whoever_does_not_hold_the_cap_is_stopped():
    watch = VehicleWatch(T, BrokenVehicle.limits, max_speed_mps=1.0)
    watch.begin(0.0)
    report = BrokenVehicle().feedback(0.0)._replace(self_braking=False)

    def fault(speed_mps, now_s, drives=True):
        watch.command({"pedal": 0.0}, now_s, drives)
        watch.report(report._replace(speed_mps=speed_mps, action={"pedal": 0.0}), now_s)
        return watch.fault(now_s)

    assert [fault(1.11, 0.1), fault(-1.11, 0.3), fault(1.13, 0.5)] == [None, None, Fault.TOO_FAST]
    assert fault(-1.13, 0.7) is Fault.TOO_FAST
    assert fault(1.2, 0.9, drives=False) is None  # it brakes; a re-arm is no longer in vain


SPEEDS = st.one_of(st.floats(-5, 5), st.sampled_from([math.nan, math.inf, -math.inf, 0.0]))
STEPS = st.lists(st.tuples(SPEEDS, st.floats(0.0, 0.5), st.booleans()), max_size=40)


@given(STEPS, st.floats(0.1, 20.0))
def test_a_leash_counts_no_less_than_was_gone_and_only_a_re_arm_gives_it_back(steps, length_m):
    """Between two reports the true speed is that of one of them; one that is none is skipped."""
    leash, now_s, gone_m, known_s, known_mps = Leash(length_m), 0.0, 0.0, None, 0.0
    for speed_mps, step_s, is_rearmed in steps:
        now_s += step_s
        before_m = leash.left_m
        if is_rearmed:
            leash.begin()
            assert leash.left_m == length_m
            gone_m, before_m = 0.0, length_m
        leash.note(speed_mps, now_s)
        assert leash.left_m <= before_m
        if math.isfinite(speed_mps):
            since_s = now_s if known_s is None else known_s
            gone_m += 0.5 * (abs(speed_mps) + known_mps) * (now_s - since_s)
            known_s, known_mps = now_s, abs(speed_mps)
        assert leash.left_m <= max(length_m - gone_m, 0.0) + 1e-9
        assert leash.is_used(0.0) == (leash.left_m == 0.0)


@pytest.mark.parametrize("speed_mps", [1.0, -1.0])
def test_a_leash_is_used_up_before_it_is_overrun(speed_mps):
    leash = Leash(2.0)
    times_s = [STREAM_S * step for step in range(200)]
    for now_s in times_s:
        leash.note(speed_mps, now_s)
        if leash.is_used(STREAM_S):
            break
    assert 2.0 - 2 * STREAM_S <= now_s <= 2.0
    assert not Leash(math.inf).is_used(1e9)
