from dataclasses import replace

import numpy as np
import pytest
import torch

from trainer.benches.objections import objections
from trainer.evaluation import drive_episodes
from trainer.human.crossing import Crossing, PedalPlan
from trainer.human.dagger import HumanTraining
from trainer.human.expert import LeftTurnExpert
from trainer.human.guide import HumanGuide
from trainer.human.model import HumanModel, HumanModelConfig, load_human_model
from trainer.human.trigger import LeftTurnTrigger
from trainer.learner.networks import Actor
from trainer.scenarios.left_turn import LeftTurnConfig, LeftTurnEnv

FULL, NOTHING, BRAKE = (np.array([pedal], np.float32) for pedal in (1.0, 0.0, -1.0))
ONE_CAR = LeftTurnConfig(traffic_cars=1, traffic_speed_mps=(5.0, 5.0), ego_speed_mps=(4.0, 4.0))


def environment(**changes) -> LeftTurnEnv:
    env = LeftTurnEnv(replace(ONE_CAR, **changes))
    env.reset(seed=0)
    return env


def test_the_expert_always_arrives():
    env = LeftTurnEnv()
    results = drive_episodes(env, LeftTurnExpert(env), range(60))
    assert {result.outcome for result in results} == {"goal"}


def test_foresight_agrees_with_what_then_happens():
    env = LeftTurnEnv()
    crossing = Crossing(env, side_clearance_m=0.0)
    agreed = 0
    for seed in range(80):
        env.reset(seed=seed)
        plan = PedalPlan(pedal=1.0, hold_s=10.0)
        foreseen = crossing.clear(5.0, margin_m=0.0, plan=plan)
        info: dict = {}
        while "outcome" not in info:
            *_, info = env.step(FULL)
        agreed += foreseen == (info["outcome"] == "goal")
    # Traffic is foreseen at constant speed; IDM speeds differ a little.
    assert agreed >= 74


@pytest.mark.parametrize(("first_car_m", "clear"), [(9.0, False), (60.0, True)])
def test_a_near_car_blocks_and_a_far_one_does_not(first_car_m, clear):
    env = environment(first_car_m=(first_car_m, first_car_m))
    assert LeftTurnExpert(env).crossing.clear(6.0, 1.5, LeftTurnExpert.GO) is clear


def test_foresight_takes_each_car_at_its_own_length():
    env = environment(first_car_m=(60.0, 60.0))
    crossing = LeftTurnExpert(env).crossing
    assert crossing.clear(6.0, 1.5, LeftTurnExpert.GO)
    env.traffic[0].LENGTH = 90.0
    assert not crossing.clear(6.0, 1.5, LeftTurnExpert.GO)


def test_the_trigger_lets_the_expert_drive():
    """Or the policy would be punished for driving like the human: theorem 1's assumption."""
    env = LeftTurnEnv()
    counted = objections(env, LeftTurnExpert(env), drives=20)
    assert counted == {"drives": 20, "arrived": 20, "objected_of_these": 0}


def test_the_trigger_lets_a_brisk_approach_pass_until_only_the_brake_helps():
    env = environment(first_car_m=(9.0, 9.0))
    trigger = LeftTurnTrigger(LeftTurnExpert(env))
    reasons: list[str | None] = []
    for _ in range(60):
        reasons.append(trigger.judge(NOTHING))
        if reasons[-1]:
            break
        env.step(NOTHING)
    assert len(reasons) > 2
    assert reasons[-1] == "collision"
    assert trigger.judge(BRAKE) is None
    for _ in range(20):
        env.step(BRAKE)
    assert env.ego.speed == 0.0
    assert env.distance_m < LeftTurnTrigger.STOP_BY_M


def test_a_car_that_stands_short_of_the_lane_may_stay_but_not_creep_on():
    env = environment(first_car_m=(9.0, 9.0))
    trigger = LeftTurnTrigger(LeftTurnExpert(env))
    env.traffic[0].position[0] = -2.0
    env.ego.speed = 0.0
    for place_m, stays in ((7.8, None), (8.1, "collision")):
        env.distance_m = place_m
        assert trigger.judge(BRAKE) == stays
        assert trigger.judge(np.array([0.1], np.float32)) == "collision"


def test_a_plan_may_end_in_a_stop():
    env = environment(first_car_m=(60.0, 60.0))
    crossing = LeftTurnExpert(env).crossing
    # 0.5 s at 4 m/s, then 2 m/s2: 2 m and 4 m, and a little for whole control periods.
    plan = PedalPlan(pedal=0.0, hold_s=0.5, then_brake=0.5)
    assert crossing.reached_m(6.0, plan) == pytest.approx(6.0 + 0.5 * 4.0 * 0.1, abs=0.01)
    assert crossing.reached_m(9.0, plan) == crossing.reached_m(6.0, plan)


@pytest.mark.parametrize("pedal", [0.3, 1.0])
def test_a_pedal_that_never_looks_arrives_with_a_human_beside_it(pedal):
    env = LeftTurnEnv()
    for seed in range(15):
        env.reset(seed=seed)
        expert = LeftTurnExpert(env)
        guide = HumanGuide(expert, LeftTurnTrigger(expert))
        info: dict = {}
        while "outcome" not in info:
            action = np.array([pedal], np.float32)
            intervention = guide.watch(env.frames, action)
            *_, info = env.step(action if intervention is None else intervention.action)
        assert info["outcome"] == "goal"


def test_trigger_takes_over_from_a_car_that_waits_for_nothing():
    env = environment(traffic_cars=0)
    trigger = LeftTurnTrigger(LeftTurnExpert(env))
    reasons = []
    for _ in range(40):
        reasons.append(trigger.judge(BRAKE))
        env.step(BRAKE)
    assert reasons[0] is None
    first = reasons.index("stuck")
    assert first > LeftTurnTrigger.STANDING_STEPS + LeftTurnTrigger.OPEN_STEPS
    assert set(reasons[first:]) == {"stuck"}
    assert trigger.judge(FULL) is None  # it starts by itself


def test_waiting_for_traffic_is_not_stuck():
    env = environment(first_car_m=(12.0, 12.0), ego_speed_mps=(3.0, 3.0))
    env.traffic[0].target_speed = 0.01
    env.traffic[0].speed = 0.0
    trigger = LeftTurnTrigger(LeftTurnExpert(env))
    env.traffic[0].position[0] = 0.0
    reasons = set()
    for _ in range(40):
        reasons.add(trigger.judge(BRAKE))
        env.step(BRAKE)
    assert reasons == {None}


class ScriptedTrigger:
    def __init__(self, reasons):
        self.reasons = iter(reasons)

    def reset(self):
        pass

    def judge(self, action):
        return next(self.reasons)


class Brakes:
    resets = 0

    def reset(self):
        self.resets += 1

    def act(self, observation):
        return BRAKE


def watch(reasons: list, hold_steps: int) -> list:
    guide = HumanGuide(Brakes(), ScriptedTrigger(reasons), hold_steps)
    observation = np.zeros((2, 45, 80), np.uint8)
    return [guide.watch(observation, FULL) for _ in reasons]


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


def test_the_model_starts_as_an_untrained_actor_and_learns_what_it_is_shown():
    config = HumanModelConfig(batch_size=16, learning_rate=1e-3)
    model = HumanModel(config, seed=3)
    assert np.isnan(model.learn(5))
    with torch.random.fork_rng():
        torch.manual_seed(3)
        untrained = Actor(frames=1)
    for ours, fresh in zip(model.actor.parameters(), untrained.parameters(), strict=True):
        assert torch.equal(ours, fresh)
    random = np.random.default_rng(0)
    bright = random.integers(200, 255, (2, 45, 80)).astype(np.uint8)
    dark = random.integers(0, 50, (2, 45, 80)).astype(np.uint8)
    for _ in range(20):
        model.add(bright, FULL)
        model.add(dark, BRAKE)
    assert model.learn(60) < 0.05
    assert model.act(bright)[0] > 0.7
    assert model.act(dark)[0] < -0.7


def test_one_frame_is_the_newest_one():
    model = HumanModel(HumanModelConfig(frames=1), seed=0)
    frames = np.random.default_rng(0).integers(0, 255, (2, 45, 80)).astype(np.uint8)
    other_past = frames.copy()
    other_past[0] = 0
    assert model.act(frames) == model.act(other_past)
    other_now = frames.copy()
    other_now[1] = 0
    assert model.act(frames) != model.act(other_now)


def test_refining_takes_its_updates_under_a_falling_learning_rate():
    config = HumanModelConfig(batch_size=16, learning_rate=1e-3, refining_updates=45)
    model, random = HumanModel(config, seed=3), np.random.default_rng(0)
    for number in range(60):
        shade = random.integers(0, 255)
        model.add(np.full((2, 45, 80), shade, np.uint8), FULL if number % 2 else BRAKE)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    rates, losses = [], []
    for loss in model.refine():
        losses.append(loss)
        rates.append(model.optimiser.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3 * (1 - part / 20) for part in range(20)])
    # 45 updates in 20 parts: Adam counts them.
    steps = {int(state["step"]) for state in model.optimiser.state.values()}
    assert steps == {45}
    moved = [not torch.equal(a, b) for a, b in zip(before, model.actor.parameters(), strict=True)]
    assert any(moved)
    assert np.isfinite(losses).all()


def test_training_is_reproducible_and_survives_saving(tmp_path):
    config = HumanModelConfig(episodes=2, updates_per_episode=2, batch_size=8)
    models = []
    for _ in range(2):
        training = HumanTraining(LeftTurnEnv(), config, seed=5)
        episodes = list(training.episodes())
        models.append(training.model)
    assert episodes[-1].demonstrations == models[0].demonstrations > 0
    frames = np.full((2, 45, 80), 70, np.uint8)
    assert models[0].act(frames) == models[1].act(frames)
    models[0].save(tmp_path, {"scenario": "left_turn"})
    actor, about = load_human_model(tmp_path)
    assert about["demonstrations"] == models[0].demonstrations
    with torch.no_grad():
        assert actor(torch.from_numpy(frames)[None])[0].numpy() == models[0].act(frames)
