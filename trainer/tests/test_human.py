import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from hil_tests.tests.shared.commands import call
from trainer.environments import expert_of, make_environment
from trainer.evaluation import constant_driver
from trainer.human import MODEL_FILE, HumanModelConfig
from trainer.human import model as model_module
from trainer.human.guide import ASKED, Asking, HumanGuide, PoorHands, steps_held
from trainer.human.model import HumanModel, imitate, load_human_model
from trainer.person.tests.people import BRAKE, FULL, drive
from trainer.scenarios.congestion import CongestionEnv
from trainer.scenarios.left_turn import LeftTurnEnv
from trainer.util import load_torch


@pytest.mark.parametrize("kind", [LeftTurnEnv, CongestionEnv])
def test_training_is_reproducible_and_survives_saving(tmp_path, kind):
    config = HumanModelConfig(episodes=2, updates_per_episode=2, batch_size=8)
    models = [HumanModel(config, seed=5) for _ in range(2)]
    for model in models:
        shown = [model.demonstrations for _ in imitate(model, kind(), seed=5)]
    assert models[0].demonstrations == shown[1] > shown[0] > 0
    frames = np.full((2, 45, 80), 70, np.uint8)
    assert models[0].act(frames) == models[1].act(frames)
    models[0].save(tmp_path, {"scenario": "left_turn"})
    actor = load_human_model(tmp_path, make_environment("left_turn"))
    assert load_torch(tmp_path / MODEL_FILE)["demonstrations"] == models[0].demonstrations
    with torch.no_grad():
        assert actor(torch.from_numpy(frames)[None])[0].numpy() == models[0].act(frames)


@pytest.mark.parametrize("driven", [0, 1])
def test_an_interrupted_training_leaves_the_model_of_its_episodes(
    driven, monkeypatch, capsys, tmp_path
):
    def interrupted(model, env, seed):
        yield from itertools.islice(imitate(model, env, seed), driven)
        raise KeyboardInterrupt

    monkeypatch.setattr(model_module, "imitate", interrupted)
    words = ("human", "--episodes", "9", "--updates-per-episode", "2", "--out", tmp_path / "human")
    assert call(capsys, *words)[0] == 130
    assert (tmp_path / "human").exists() == bool(driven)
    if driven:
        assert load_human_model(tmp_path / "human", make_environment("left_turn"))
        assert load_torch(tmp_path / "human" / MODEL_FILE)["episodes"] == driven


@pytest.mark.parametrize(
    ("scenario", "human", "drives"),
    [("left_turn", "expert", 10), ("congestion", "expert", 5),
     ("left_turn", "trainer.human.left_turn:SlowHuman", 10)],
)  # fmt: skip
def test_the_trigger_lets_the_expert_drive(scenario, human, drives):
    """Or the policy would be punished for driving like the human: theorem 1's assumption."""
    env = make_environment(scenario)
    expert, trigger = expert_of(env, human), expert_of(env, human)

    def judged(observation):
        action = expert.act(observation)
        assert trigger.wants_control(action) is None
        return action

    for seed in range(drives):
        expert.reset()
        trigger.reset()
        assert drive(env, judged, seed)[1]["outcome"] == "goal"


def watch(reasons, places=(), hold_steps=15, **how):
    """What a human does of whom the trigger says so: its steps at the wheel, and those held."""
    judged, returned = iter(reasons), iter(places)
    trigger: Any = SimpleNamespace(reset=lambda: None)
    trigger.wants_control, trigger.may_return = lambda _: next(judged), lambda: next(returned, True)
    guide = HumanGuide(constant_driver(-1.0), trigger, hold_steps, **how)
    steps = [guide.watch(np.zeros((2, 45, 80), np.uint8), FULL) for _ in reasons]
    taken = [step for step in steps if step]
    assert all(step.action == BRAKE for step in taken)
    return [step is not None for step in steps], taken


NONE, CRASH = None, "collision"
NO, YES = False, True


@pytest.mark.parametrize(
    ("reasons", "how", "held", "first"),
    [
        # Not given back in the lane.
        ([CRASH] + [NONE] * 6, {"hold_steps": 2, "places": [NO, NO, YES]},
         [YES] * 4 + [NO] * 3, [YES, NO, NO, NO]),
        # Held on to; only the first step is an intervention.
        ([NONE, CRASH, NONE, NONE, NONE, CRASH, NONE, NONE, NONE], {"hold_steps": 3},
         [NO, YES, YES, YES, NO, YES, YES, YES, NO], [YES, NO, NO, YES, NO, NO]),
        # For a second and a half, which at the scenarios' pace are 15 periods.
        ([CRASH] + [NONE] * 20, {"hold_steps": steps_held(0.1)},
         [YES] * 15 + [NO] * 6, [YES] + [NO] * 14),
        # Where the robot only asks, for a third of that.
        ([ASKED] + [NONE] * 9, {}, [YES] * 5 + [NO] * 5, [YES] + [NO] * 4),
        ([ASKED] + [NONE] * 3, {"hold_steps": 2}, [YES] + [NO] * 3, [YES]),
        # A reason that lasts prolongs the same intervention.
        (["stuck", "stuck", CRASH, NONE, NONE], {"hold_steps": 2},
         [YES] * 4 + [NO], [YES, NO, NO, NO]),
    ],
)  # fmt: skip
def test_the_human_holds_on_and_gives_back(reasons, how, held, first):
    in_control, steps = watch(reasons, **how)
    assert in_control == held
    assert [step.first for step in steps] == first
    assert {step.reason for step in steps} == {next(filter(None, reasons))}


def test_the_robot_asks_where_its_doubt_is_high_once_it_knows_what_that_is():
    gate = Asking(0.05)
    asked = [gate.ask(float(n % 100), CRASH if n == 3 else None) for n in range(gate.MEMORY + 100)]
    before, after = asked[: gate.MEMORY - 1], asked[gate.MEMORY - 1 :]
    assert [n for n, reason in enumerate(before) if reason] == [3]  # the human still watches
    assert {reason for reason in after if reason} == {ASKED}
    assert after.count(ASKED) == pytest.approx(0.05 * len(after), abs=1)


@pytest.mark.parametrize("biased", [None, 1.0])
def test_poor_hands_replace_their_share_of_the_actions(biased):
    """By random actions, or by the same wrong one."""
    hands = PoorHands(1 / 3, biased, np.random.default_rng(0))
    done = np.array([hands.spoil(BRAKE, first=False)[0] for _ in range(600)])
    poor = done[done != BRAKE]
    assert len(poor) == pytest.approx(200, abs=40)
    if biased is None:
        assert np.abs(poor).max() <= 1.0
        assert np.std(poor) == pytest.approx(3**-0.5, abs=0.08)  # uniform over the whole range
    else:
        assert set(poor) == {biased}


def test_a_wrong_take_over_is_wrong_from_its_beginning_to_its_end():
    hands = PoorHands(1 / 3, 1.0, np.random.default_rng(0), whole=True)
    takeovers = np.array(
        [[hands.spoil(BRAKE, step == 0)[0] for step in range(5)] for _ in range(300)]
    )
    assert (takeovers == takeovers[:, :1]).all()
    assert (takeovers[:, 0] == 1.0).sum() == pytest.approx(100, abs=30)
