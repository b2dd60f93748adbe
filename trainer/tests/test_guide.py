"""The human beside the policy: when it takes over, for how long, and what an intervention is."""

from itertools import repeat

import numpy as np
import pytest

from trainer.drivers import EXPERTS, make_environment
from trainer.evaluate import drive_episodes
from trainer.human.guide import HumanGuide
from trainer.tests.humans import BRAKE, FULL, Brakes, objections

ANYWHERE = repeat(True)


class ScriptedTrigger:
    def __init__(self, reasons, places=ANYWHERE):
        self.reasons, self.places = iter(reasons), iter(places)

    def reset(self):
        pass

    def judge(self, action):
        return next(self.reasons)

    def may_return(self):
        return next(self.places)


@pytest.mark.parametrize(
    ("scenario", "condition", "drives"),
    [("left_turn", "nominal", 60), ("congestion", "nominal", 20), ("congestion", "noise", 20)],
)
def test_the_expert_always_arrives(scenario, condition, drives):
    env = make_environment(scenario)
    results = drive_episodes(env, EXPERTS[scenario](env), range(drives), condition)
    assert {result.outcome for result in results} == {"goal"}


@pytest.mark.parametrize(("scenario", "drives"), [("left_turn", 20), ("congestion", 10)])
def test_the_trigger_lets_the_expert_drive(scenario, drives):
    """Or the policy would be punished for driving like the human: theorem 1's assumption."""
    env = make_environment(scenario)
    counted = objections(env, EXPERTS[scenario](env), drives)
    assert counted == {"drives": drives, "arrived": drives, "objected_of_these": 0}


def watch(reasons: list, hold_steps: int, places=ANYWHERE) -> list:
    guide = HumanGuide(Brakes(), ScriptedTrigger(reasons, places), hold_steps)
    observation = np.zeros((2, 45, 80), np.uint8)
    return [guide.watch(observation, FULL) for _ in reasons]


def test_the_wheel_is_not_given_back_in_the_lane():
    none, in_lane, through = None, False, True
    reasons = ["collision", none, none, none, none, none, none]
    steps = watch(reasons, hold_steps=2, places=[in_lane, in_lane, through])
    assert [step is not None for step in steps] == [True] * 4 + [False] * 3
    assert {step.reason for step in steps if step} == {"collision"}


def test_the_human_holds_on_and_only_the_first_step_is_an_intervention():
    none, crash = None, "collision"
    steps = watch([none, crash, none, none, none, crash, none, none, none], hold_steps=3)
    in_control = [step is not None for step in steps]
    assert in_control == [False, True, True, True, False, True, True, True, False]
    assert [step.first for step in steps if step] == [True, False, False, True, False, False]
    assert all(step.action is BRAKE for step in steps if step)


def test_by_default_the_human_holds_for_a_second_and_a_half():
    guide = HumanGuide(Brakes(), ScriptedTrigger(["collision", *[None] * 20]))
    observation = np.zeros((2, 45, 80), np.uint8)
    in_control = [guide.watch(observation, FULL) is not None for _ in range(21)]
    assert in_control == [True] * 15 + [False] * 6


def test_a_reason_that_lasts_prolongs_the_same_intervention():
    steps = watch(["stuck", "stuck", "collision", None, None], hold_steps=2)
    assert [step is not None for step in steps] == [True, True, True, True, False]
    assert [step.first for step in steps if step] == [True, False, False, False]
    assert {step.reason for step in steps if step} == {"stuck"}
