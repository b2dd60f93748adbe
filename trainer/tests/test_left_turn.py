from dataclasses import replace

import numpy as np
import pytest

import trainer.scenarios  # noqa: F401 (registers the environments)
from trainer.evaluation import constant_driver
from trainer.human.guide import HumanGuide, steps_held
from trainer.human.left_turn import LeftTurnHuman
from trainer.person.tests.people import BRAKE, FULL, NOTHING, drive, episode
from trainer.scenarios.left_turn import LeftTurnConfig, LeftTurnEnv

EMPTY_ROAD = LeftTurnConfig(traffic_cars=0)


def test_the_brake_stops_the_car_and_does_not_reverse_it():
    env = LeftTurnEnv(EMPTY_ROAD)
    _, rewards, infos = zip(*episode(env, BRAKE, 0), strict=True)
    info = infos[-1]
    assert (info["outcome"], info["speed_mps"]) == ("timeout", 0.0)
    assert info["distance_m"] < 3.5
    # Eq. 31 with its scale: standing costs 0.02 x |0 - 5| a step.
    assert rewards[-1] == pytest.approx(-0.1)
    assert len(rewards) == env.config.max_steps
    accelerations_mps2 = [each["longitudinal_acceleration_mps2"] for each in infos[1:]]
    motion = np.diff([each["speed_mps"] for each in infos]) / 0.1
    assert accelerations_mps2 == pytest.approx(motion)


ONE_CAR = LeftTurnConfig(traffic_cars=1, traffic_speed_mps=(5.0, 5.0), ego_speed_mps=(4.0, 4.0))


def environment(**changes) -> LeftTurnEnv:
    env = LeftTurnEnv(replace(ONE_CAR, **changes))
    env.reset(seed=0)
    return env


def triggered(**changes):
    env = environment(**changes)
    return env, LeftTurnHuman(env)


@pytest.mark.parametrize(
    ("place_m", "speed_mps", "pedal", "reason"),
    [
        (9.0, 2.0, -1.0, "lane"),
        (9.0, 0.0, 0.1, "lane"),
        (9.0, 0.0, 0.2, None),  # it drives on
        (9.0, 4.0, -1.0, "lane"),  # it hesitates
        (9.0, 4.0, -0.5, None),  # still fast after a second
        (6.0, 1.0, -1.0, None),  # short of the lane
        (19.0, 1.0, -1.0, None),  # through it
    ],
)
def test_nobody_stops_in_the_lane_even_where_nothing_comes(place_m, speed_mps, pedal, reason):
    env, trigger = triggered(traffic_cars=0)
    env.distance_m, env.ego.speed = place_m, speed_mps
    assert trigger.wants_control(np.array([pedal], np.float32)) == reason


def guided(guide: HumanGuide, action: np.ndarray):
    def act(observation):
        intervention = guide.watch(observation, action)
        return action if intervention is None else intervention.action

    return act


@pytest.mark.parametrize("pedal", [0.3, 1.0])
def test_a_pedal_that_never_looks_arrives_with_a_human_beside_it(pedal):
    env = LeftTurnEnv()
    guide = HumanGuide(LeftTurnHuman(env), LeftTurnHuman(env), steps_held(0.1))
    for seed in range(15):
        guide.reset()
        _, info = drive(env, guided(guide, np.array([pedal], np.float32)), seed)
        assert info["outcome"] == "goal"


def braking(env):
    """The trigger, and what it says of 40 steps under the brake."""
    trigger, reasons = LeftTurnHuman(env), []
    for _ in range(40):
        reasons.append(trigger.wants_control(BRAKE))
        env.step(BRAKE)
    return trigger, reasons


def test_trigger_takes_over_from_a_car_that_waits_for_nothing():
    trigger, reasons = braking(environment(traffic_cars=0))
    first = reasons.index("stuck")
    assert first > LeftTurnHuman.STANDING_STEPS + LeftTurnHuman.OPEN_STEPS
    assert reasons == [None] * first + ["stuck"] * (40 - first)
    assert trigger.wants_control(FULL) is None  # it starts by itself


def test_a_human_who_stops_in_the_lane_gives_up_and_the_policy_drives_on():
    """For the left turn is given back short of the lane or behind it."""
    env, trigger = triggered(traffic_cars=0)
    guide = HumanGuide(constant_driver(-1.0), trigger, hold_steps=5)
    while env.distance_m < 8.5:
        env.step(NOTHING)
    assert (first := guide.watch(env.frames, BRAKE)) is not None
    assert first.reason == "lane"
    *_, (_, _, info) = episode(env, guided(guide, FULL))
    assert info["outcome"] == "goal"
    env.ego.speed, places = 3.0, []
    for env.distance_m in (6.0, 9.0, 14.0, 19.0):
        places.append(trigger.may_return())
    assert places == [True, False, False, True]
