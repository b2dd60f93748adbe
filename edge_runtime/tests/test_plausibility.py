"""The watches over a vehicle in made-up time: what they accuse, when, and what they never do."""

import math

import pytest
from hil_tests.tests.shared.policies import T
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.controller import ActionLimit
from edge_runtime.tests.rigs import SPEC
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.mock import MockVehicle
from edge_runtime.vehicles.plausibility import (
    DEVIATES_S,
    FOLLOWS_S,
    LAG_S,
    DriveWatch,
    Fault,
    FollowWatch,
    VehicleWatch,
)

TICK_S = 0.05


def report(pedal=0.0, speed_mps=1.0, self_braking=False, lamp=0.0, **more):
    return VehicleReport({"pedal": pedal, "lamp": lamp}, speed_mps, self_braking, [], **more)


def watched(asked=0.0, ticks=20, **reported):
    """A watch that has seen a steady drive; and the time."""
    watch = VehicleWatch(T, MockVehicle.limits)
    watch.begin(100.0)
    for tick in range(ticks):
        now_s = 100.0 + tick * TICK_S
        watch.command({"pedal": asked}, now_s)
        watch.report(report(**reported), now_s)
    return watch, now_s


@pytest.mark.parametrize(
    ("asked", "reported", "newest", "fault"),
    [
        (0.3, {"pedal": 0.3}, {}, None),
        (0.6, {"pedal": -1.0, "self_braking": True}, {}, Fault.SELF_BRAKING),
        (0.6, {"pedal": 0.3}, {}, Fault.STUCK),
        (0.6, {"pedal": 0.3}, {"commanded_speed_mps": 1.0}, None),  # the driver judges
        (0.0, {}, {"speed_mps": 9.0}, Fault.LYING),
        (0.0, {}, {"speed_mps": math.nan}, Fault.LYING),
        (0.0, {}, {"speed_mps": 2.24}, None),  # 0.5 m/s, and 15 m/s2 for 0.05 s, from 1 m/s on
        (0.0, {}, {"speed_mps": 2.26}, Fault.LYING),
        (0.0, {}, {"pedal": 1.1}, Fault.LYING),
        (0.0, {}, {"lamp": 1.0}, None),  # beyond its limits, an action is between -1 and 1
        (0.0, {"lamp": -1.0}, {}, None),
        (0.0, {}, {"lamp": -1.1}, Fault.LYING),
        (0.0, {}, {"lamp": 1.1}, Fault.LYING),
    ],
)
def test_what_a_vehicle_may_report(asked, reported, newest, fault):
    watch, now_s = watched(asked=asked, **reported)
    watch.report(report(**{**reported, **newest}), now_s + TICK_S)
    assert watch.fault(now_s + TICK_S) is fault


@pytest.mark.parametrize("lowest", [-1.0, 0.0])
def test_after_a_stop_a_pedal_that_the_policy_does_not_have_is_nobodys(lowest):
    watch = VehicleWatch(T, {"pedal": ActionLimit(lowest, 1.0)})
    watch.begin(100.0)
    for tick in range(40):
        now_s, stops = 100.0 + tick * TICK_S, tick < 20
        watch.command({"lamp": 0.0}, now_s, not stops)
        watch.report(report(pedal=lowest if stops else 0.5, speed_mps=0.0), now_s)
        assert watch.fault(now_s) is None


@given(
    policy=st.dictionaries(st.sampled_from(["pedal", "lamp"]), st.floats(-1, 0)),
    history=st.lists(st.booleans(), max_size=30),
    beyond=st.floats(0.26, 1.0),
)
def test_a_pedal_that_stays_is_found_in_every_stop_and_one_that_obeys_in_none(
    policy, history, beyond
):
    """Whether or not the policy has a pedal; what it asks for beside a stop may be any up to 0."""
    watch, stays = VehicleWatch(T, MockVehicle.limits), policy.get("pedal", -1.0) + beyond
    obeys = {"pedal": stays, "lamp": 0.0, **policy}
    watch.begin(0.0)
    stop = [True] * round((LAG_S + DEVIATES_S) / TICK_S + 3)
    for tick, stops in enumerate([*history, *stop]):
        now_s, stuck = tick * TICK_S, tick >= len(history)
        pedal = stays if stuck else -1.0 if stops else obeys["pedal"]
        watch.command(policy, now_s, not stops)
        watch.report(report(pedal, lamp=obeys["lamp"]), now_s)
        assert stuck or watch.fault(now_s) is None
    assert watch.fault(now_s) is Fault.STUCK


@pytest.mark.parametrize("wheel", ["steering", "front"])
@pytest.mark.parametrize(("asked", "commanded_mps"), [({"pedal": 0.6}, 1.0), ({}, None)])
def test_a_stuck_wheel_is_found_beside_a_pedal_that_is_the_drivers_or_nobodys(
    wheel, asked, commanded_mps
):
    watch = VehicleWatch(T, MockVehicle.limits)
    watch.begin(100.0)
    for tick in range(20):
        now_s = 100.0 + tick * TICK_S
        watch.command({**asked, wheel: 0.5}, now_s)
        found = VehicleReport({"pedal": 0.3, wheel: 0.0}, 1.0, False, [])
        watch.report(found._replace(commanded_speed_mps=commanded_mps), now_s)
    assert watch.fault(now_s) is Fault.STUCK


@pytest.mark.parametrize(
    ("brakes", "drives", "found_s"),
    [
        (lambda now_s: True, True, 1.75),  # from its 1 s to be enabled on
        (lambda now_s: not 0.6 < now_s < 0.8, True, 1.05),  # it had been, from 0.8 s on
        (lambda now_s: True, False, None),  # it is to brake
        (lambda now_s: True, None, None),  # nobody has asked for anything yet
        (lambda now_s: now_s % 0.2 < 0.1, True, None),
    ],
)
def test_one_that_brakes_by_itself_while_it_is_to_drive_is_at_fault_once_it_could_be_enabled(
    brakes, drives, found_s
):
    watch, said = VehicleWatch(T, MockVehicle.limits), []
    for now_s in [round(tick * TICK_S, 3) for tick in range(60)]:
        if now_s == 0.5:
            watch.enable(now_s)
        if drives is not None:
            watch.command({"pedal": 0.0}, now_s, drives and now_s >= 0.5)
        watch.report(report(self_braking=brakes(now_s)), now_s)
        if watch.fault(now_s):
            said.append((now_s, watch.fault(now_s)))
    assert said[:1] == ([(found_s, Fault.SELF_BRAKING)] if found_s else [])


def test_silence_after_two_periods_also_before_the_first_report():
    watch = VehicleWatch(T, MockVehicle.limits)
    assert watch.fault(1e9) is None  # what was not begun owes nothing
    watch.begin(10.0)
    assert watch.fault(10.0 + 2 * T) is None
    assert watch.fault(10.001 + 2 * T) is Fault.SILENT
    watch.report(report(), 10.3)
    assert watch.fault(10.3) is None
    assert watch.silent_at_s == pytest.approx(10.3 + 2 * T)


FOLLOWING = [  # time, asked from then on, reported pedal, whether it brakes by itself, fault
    (0.0, 1.0, -1.0, False, None),  # it has had no time to follow
    (0.25, 1.0, -1.0, False, None),
    (1.0, 0.0, 1.0, False, None),
    (1.296875, 0.0, 1.0, False, None),  # 1.0 was still in force 0.3 s ago
    (1.3125, 0.0, 1.0, False, None),  # no more
    (1.421875, 0.0, 1.0, False, Fault.STUCK),
    (1.4375, 0.0, 1.0, True, None),  # it obeys no command: that is another fault, later
    (1.453125, 0.0, 1.0, False, None),
]


def test_an_actuator_has_its_time_to_follow_and_none_while_it_brakes_by_itself():
    watch = VehicleWatch(T, MockVehicle.limits)
    for now_s, asked, pedal, brakes, fault in FOLLOWING:
        watch.command({"pedal": asked}, now_s)
        watch.report(report(pedal=pedal, self_braking=brakes), now_s)
        assert watch.fault(now_s) is fault, now_s


@pytest.mark.parametrize(
    ("reached", "fault"),
    [(60.0, None), (45.1, None), (44.9, Fault.STUCK), (80.05, None), (80.07, Fault.LYING)],
)
def test_what_is_far_from_what_was_asked_depends_on_the_actions_range(reached, fault):
    """An eighth of -40 to 80 is 15; a hundred revolutions are no lie of a wheel that makes them."""
    watch = VehicleWatch(T, {"left": ActionLimit(-40.0, 80.0)})
    watch.begin(0.0)
    for tick in range(20):
        watch.command({"left": 70.0 if reached > 80.0 else 60.0}, tick * TICK_S)
        watch.report(VehicleReport({"left": reached}, 1.0, False, []), tick * TICK_S)
    assert watch.fault(19 * TICK_S) is fault


def test_a_leap_is_a_lie_until_that_speed_could_be_real():
    watch, now_s = watched(speed_mps=1.0)
    # 0.5 m/s and 15 m/s2 from the last speed that was believed: up to 4.5, 7.5, then 9.75
    for after_s, fault in ((0.2, Fault.LYING), (0.4, Fault.LYING), (0.55, None)):
        watch.report(report(speed_mps=9.0), now_s + after_s)
        assert watch.fault(now_s + after_s) is fault


SPEED = [
    (-3.0, 9.0, 0.0, False),  # it has had no time to follow
    (-2.0, 9.0, 0.0, False),
    (-1.9375, 9.0, 0.0, False),
    (-1.875, 9.0, 0.0, True),
    (-1.5, 2.0, 9.0, False),
    (-0.5, 2.0, 10.0, False),  # as was asked for a second ago
    (-0.375, 2.0, 9.0, False),  # no more
    (-0.25, 2.0, 9.0, True),
    (-0.125, 2.0, 3.0, False),  # the highest that counts as 2 m/s
    (-0.0625, 2.0, 9.0, False),
    (-0.03125, 2.0, 1.0, False),  # the lowest
    (0.0, 2.0, 0.5, False),
    (DEVIATES_S, 2.0, 9.0, False),
    (DEVIATES_S + 0.001, 2.0, 0.5, True),
]
WHEEL = [  # 0.1 rad to each side, 0.5 s to follow, 1 rad/s
    (0.0, 0.0, 1.0, False),
    (0.4375, 0.0, 1.0, False),
    (0.5, 0.0, 1.0, False),  # it may begin to turn now
    (0.5, 0.0, 1.0, False),  # twice in one moment
    (1.0, 0.0, 0.53, False),
    (1.25, 0.0, 0.29, False),  # too slow, but only just now
    (1.3125, 0.0, 0.29, False),
    (1.375, 0.0, 0.29, True),
    (1.5, 0.0, 0.09, False),
    (1.625, 1.0, -0.09, False),
    (2.0, 1.0, -0.09, False),
    (2.125, 1.0, 0.0, False),  # 0.0 was asked for 0.625 s ago, and still 0.5 s ago
    (2.1875, 1.0, 0.0, False),  # no more: now it turns by 1 rad/s
    (2.25, 1.0, 0.0, False),
    (2.375, 1.0, 0.0, True),
    (2.625, 1.0, None, False),  # nothing is asked of it, or known
    (2.75, 0.0, 1.0, False),  # anew
    (3.25, 0.0, 1.2, False),
    (3.375, 0.0, 1.0, True),
]
STORIES: dict = {"speed": ((1.0, FOLLOWS_S), SPEED), "wheel": ((0.1, 0.5, 1.0), WHEEL)}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("story", STORIES)
def test_what_is_outside_of_all_that_a_healthy_actuator_can_do_is_stuck_after_a_while(story, sign):
    limits, rows = STORIES[story]
    watch = FollowWatch(*limits)
    for now_s, asked, measured, stuck in rows:
        measured = None if measured is None else sign * measured
        assert watch.is_stuck(sign * asked, measured, now_s) is stuck, now_s


def test_a_wheel_may_stay_for_its_lag_and_for_the_age_of_what_is_heard():
    """0.4 s, 46 ms in which 1 rad/s would bring it within tolerance, and 0.1 s of deviation."""
    watch = DriveWatch(SPEC, silence_s=0.2)
    for tick in range(160):
        now_s = tick * 0.01
        found = watch.stuck((1.0, 0.3 if now_s > 1.0 else 0.0), (1.0, 0.0), now_s)
        assert bool(found) is (now_s > 1.555), now_s
