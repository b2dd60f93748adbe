"""Tasks of any scale: numbers by their spread, grids, rewards of any size, any control period."""

from contextlib import closing
from dataclasses import replace
from itertools import repeat
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict

from trainer.environments import make_environment
from trainer.learner.config import PHIL
from trainer.learner.networks import Actor, Convolutions, Numbers, make_trunk
from trainer.learner.replay import Transition
from trainer.learner.td3 import NETWORKS, TD3Learner
from trainer.tests.learners import SMALL, make_batch
from trainer.training.config import make_config
from trainer.training.learning import LearningThread
from trainer.training.run import NOBODY, TrainingRun

WIDE = Box(np.array([-100, -1, 0, -np.inf], "f4"), np.array([100, 1, 10, np.inf], "f4"))
SEEN = np.array([[40.0, 0.5, 3.0, 7.0], [42.0, 0.501, 3.0, 9.0]], np.float32)


def test_a_number_is_scaled_by_its_spread_and_a_constant_by_its_bounds():
    numbers = Numbers(WIDE)
    before = numbers(torch.from_numpy(SEEN))
    assert before[0].tolist() == pytest.approx([0.4, 0.5, -0.4, 7.0])
    numbers.fit(torch.from_numpy(SEEN))
    # The spread of two numbers is their distance times sqrt(1/2); the least one is 2 % of a half.
    least = 0.02
    assert numbers.middle.tolist() == pytest.approx([41.0, 0.5005, 5.0, 8.0])
    assert numbers.reach.tolist() == pytest.approx([2.0, least, 5.0, 2.0**0.5])
    far = numbers(torch.tensor([[-1e6, 0.5, 3.0, 1e6]]))
    assert far[0].tolist() == pytest.approx([-10.0, -0.025, -0.4, 10.0], abs=1e-4)


@pytest.mark.parametrize("last", [False, True])
def test_the_channels_of_a_grid_have_a_scale_each(last: bool):
    shape = (12, 11, 2) if last else (2, 12, 11)
    trunk = make_trunk(Box(-np.inf, np.inf, shape, np.float32), 2)
    assert isinstance(trunk, Convolutions)
    assert trunk.numbers is not None
    grids = np.random.default_rng(0).normal(3.0, 0.5, (50, 2, 12, 11)).astype(np.float32)
    grids[:, 1] *= 10.0
    trunk.fit(torch.from_numpy(np.moveaxis(grids, 1, -1) if last else grids))
    assert trunk.numbers.middle.tolist() == pytest.approx([3.0, 30.0], rel=0.01)
    assert trunk.numbers.reach.tolist() == pytest.approx([0.5, 5.0], rel=0.02)
    assert trunk(torch.zeros(7, *shape)).shape == (7, trunk.features)


def test_a_table_of_numbers_is_no_grid():
    assert isinstance(make_trunk(Box(-1, 1, (5, 7), np.float32), 2), Numbers)


def test_all_six_networks_see_the_same_scale_and_a_checkpoint_keeps_it():
    space = Dict({"near": Box(-1, 1, (3,), np.float32), "far": Box(-1, 1, (2,), np.float32)})
    seen = np.zeros(9, [("far", "f4", (2,)), ("near", "f4", (3,))])
    random = np.random.default_rng(0)
    seen["far"], seen["near"] = random.normal(0.5, 0.1, (9, 2)), random.normal(size=(9, 3))
    learner, resumed = (TD3Learner(SMALL, PHIL, seed, 2, space=space) for seed in (0, 1))
    learner.fit_numbers(seen)
    resumed.load_state_dict(learner.state_dict())
    scales: list[Any] = []
    for each in (learner, resumed):
        for name in NETWORKS:
            trunks = [part for part in getattr(each, name).modules() if isinstance(part, Numbers)]
            scales += [tuple(part.middle.tolist()) for part in trunks if part.features == 2]
    assert len(scales) == 12
    assert set(scales) == {tuple(seen["far"].astype(float).mean(0).astype("f4").tolist())}


def test_new_units_of_the_reward_change_every_value_alike():
    learner = TD3Learner(SMALL, PHIL, seed=0, space=WIDE)
    seen, actions = torch.from_numpy(SEEN), torch.zeros(2, 1)
    pairs = learner.critics.pair, learner.target_critics.pair
    critics = [critic for pair in pairs for critic in pair]
    before = [critic.value(critic.picture(seen), actions) for critic in critics]
    learner.rescale_values(0.1)
    for critic, value in zip(critics, before, strict=True):
        after = critic.value(critic.picture(seen), actions)
        assert after.tolist() == pytest.approx((0.1 * value).tolist(), rel=1e-5)


def test_a_fresh_actor_is_fitted_to_the_humans_actions_and_keeps_the_scale():
    learner = TD3Learner(SMALL, PHIL, seed=0, space=WIDE)
    learner.fit_numbers(SEEN)
    actions = np.array([[0.7], [-0.4]], np.float32)
    shown = replace(make_batch(size=2, humans=2), frames=SEEN, actions=actions)
    assert shown.human.all()
    learner.updates, before = 300, learner.actor.act(SEEN)
    learner.begin_actor_anew(repeat(shown))
    for actor in (learner.actor, learner.target_actor):
        assert actor.act(SEEN) == pytest.approx(actions, abs=0.05)
        assert actor.picture.trunk.middle.tolist() == pytest.approx([41.0, 0.5005, 5.0, 8.0])
    assert before != pytest.approx(actions, abs=0.05)


@pytest.mark.parametrize("algorithm", ["phil_td3", "hi_td3"])
def test_the_actor_begins_anew_at_even_parts_of_a_run(algorithm, monkeypatch):
    """And a resumed run does not begin it once more. What does not imitate goes on."""
    env = make_environment("Pendulum-v1")
    with closing(env):
        config = make_config("ours", {**SETTINGS, "algorithm": algorithm}, env)
        learning, resumed = LearningThread(config, env), LearningThread(config, env)
        begun: list[Any] = []
        for each in (learning, resumed):
            monkeypatch.setattr(each.learner, "begin_actor_anew", begun.append)
        store(learning, [1.0] * 30)
        seen = learning.replay.observations(1)[0]
        learning.add(Transition(seen, np.zeros(1, np.float32), 0.0, seen, False, human=True))
        for progress, times in ((0.2, 0), (0.3, 1), (0.4, 1), (0.8, 2), (1.0, 2)):
            learning.end_episode(progress)
            assert len(begun) == (times if algorithm == "phil_td3" else 0)
        resumed.load_state_dict(learning.state_dict())
        resumed.end_episode(1.0)
        assert len(begun) == (2 if algorithm == "phil_td3" else 0)
        learning.close()
        resumed.close()


@pytest.mark.parametrize("algorithm", ["cloning_only", "ppl_td3", "phil_td3", "hi_td3"])
def test_a_row_that_only_imitates_ends_with_a_fresh_actor(algorithm, tmp_path, monkeypatch):
    """Even where none began within the run."""
    env = make_environment("Pendulum-v1")
    with closing(env):
        unlearned = {"warmup_steps": 1000, "fresh_actors": 0, "evaluate_every_steps": 0}
        config = make_config(
            "ours", {**SETTINGS, **unlearned, "episodes": 1, "algorithm": algorithm}, env
        )
        run = TrainingRun(config, tmp_path, env=env, guide=NOBODY)
        begun: list[int] = []
        learner = run.learning.learner
        monkeypatch.setattr(learner, "begin_actor_anew", lambda _: begun.append(run.episode))
        seen = np.zeros((1, 3), np.float32)
        run.learning.add(Transition(seen, np.zeros(1, np.float32), 0.0, seen, False, human=True))
        run.learning.release()
        run.train()
        assert begun == ([1] if algorithm == "cloning_only" else [])


def test_a_fitted_actor_acts_on_what_it_has_seen():
    actor = Actor(1, space=WIDE)
    quiet = np.tile(SEEN[:1], (3, 1))
    assert np.isfinite(actor.act(quiet * 1e6)).all()


SETTINGS: dict[str, Any] = {
    "scenario": "Pendulum-v1", "algorithm": "per_td3", "warmup_steps": 20, "batch_size": 4,
    "return_steps": 1,
}  # fmt: skip


@pytest.fixture
def learning():
    """A learner of three numbers, whose warm-up is 20 steps."""
    env = make_environment("Pendulum-v1")
    with closing(env):
        learning = LearningThread(make_config("ours", SETTINGS), env)
        yield learning
        learning.close()


def store(learning: LearningThread, rewards: list[float]) -> None:
    """Store an episode of random observations with these rewards, and learn from it."""
    random = np.random.default_rng(len(rewards))
    for step, reward in enumerate(rewards):
        seen, after = random.normal(5.0, 0.5, (2, 3)).astype(np.float32)
        terminal = step == len(rewards) - 1
        learning.add(Transition(seen, np.zeros(1, np.float32), reward, after, terminal))
        if learning.replay.added >= 20:
            learning.begin(0.0)
            learning.finish()
    learning.end_episode(0.0)


@pytest.mark.parametrize(
    ("rewards", "largest"), [(1.0, 10.0), (8.0, 8.0), (1e-3, 10.0), (1e3, 10.0)]
)
def test_returns_are_brought_to_the_range_of_the_losses(learning, rewards, largest):
    """Returns of about ten stay as they are."""
    store(learning, [0.0] * 10 + [rewards] + [0.0] * 19)
    replay = learning.replay
    assert replay.reward_scale * replay.largest_return == pytest.approx(largest)
    batch = replay.sample(3000, np.random.default_rng(0))
    assert np.abs(batch.rewards).max() == pytest.approx(largest)


def test_a_first_success_that_is_large_makes_the_unit_smaller_and_none_makes_it_larger(learning):
    for reward, scale in ((10.0, 1.0), (500.0, 0.02), (0.001, 0.02)):
        store(learning, [0.0] * 29 + [reward])
        assert learning.replay.reward_scale == pytest.approx(scale)


def test_the_scales_survive_a_checkpoint(learning):
    store(learning, [0.0] * 29 + [500.0])
    env = make_environment("Pendulum-v1")
    resumed = LearningThread(make_config("ours", SETTINGS), env)
    resumed.load_state_dict(learning.state_dict())
    assert resumed.replay.reward_scale == learning.replay.reward_scale
    found = [each.learner.actor.picture.trunk.middle.tolist() for each in (learning, resumed)]
    assert found[0] == found[1] == pytest.approx([5.0] * 3, abs=0.4)
    resumed.close()


@pytest.mark.parametrize(
    ("scenario", "algorithm", "gamma", "noise"),
    [
        ("left_turn", "per_td3", 0.95, 0.1),
        ("Pendulum-v1", "per_td3", 0.95**0.5, 0.6),
        ("Pendulum-v1", "phil_td3", 0.95**0.5, 0.1),
        ("racetrack-v0", "phil_td3", 0.95, 0.1),  # T is 0.2 s.
    ],
)
def test_horizon_and_noise_follow_the_task_unless_they_are_typed(scenario, algorithm, gamma, noise):
    with closing(make_environment(scenario)) as env:
        values = {"scenario": scenario, "algorithm": algorithm}
        learner = make_config("ours", values, env).learner
        typed = make_config("ours", {**values, "gamma": 0.9}, env).learner
        printed = make_config("printed", values, env).learner
    assert (learner.gamma, learner.exploration_initial) == pytest.approx((gamma, noise))
    assert (typed.gamma, printed.gamma) == (0.9, 0.95)


def test_the_examples_racetrack_sees_what_highway_env_does():
    ours, theirs = (make_environment(f"examples.tasks:{name}") for name in (
        "examples/Racetrack-v0", "racetrack-v0"))  # fmt: skip
    with closing(ours), closing(theirs):
        pairs = [(ours.reset(seed=3)[0], theirs.reset(seed=3)[0])]
        for steering in (-0.1, 0.1, 0.3, -0.2, 0.0, 0.1):
            pairs.append(tuple(env.step(np.array([steering]))[0] for env in (ours, theirs)))
    assert all((one == other).all() for one, other in pairs)
