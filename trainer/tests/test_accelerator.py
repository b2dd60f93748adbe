"""The learner on an accelerator, here on the processor: all but the graphs."""

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from trainer.files import load_torch
from trainer.learner.algorithms import PHIL
from trainer.learner.config import LearnerConfig
from trainer.learner.td3 import TD3Learner
from trainer.tests.accelerating import SMALL, fill, observation, small, weights
from trainer.training import placement
from trainer.training import run as run_module
from trainer.training.accelerator import AcceleratorLearning
from trainer.training.config import RunConfig
from trainer.training.learning import ProcessorLearning
from trainer.training.metrics import read_metrics
from trainer.training.placement import make_learning
from trainer.training.run import TrainingRun

pytestmark = pytest.mark.usefixtures("one_thread")


def test_an_update_is_that_of_the_learner_on_the_same_batch():
    learning, plain = small(), TD3Learner(SMALL, PHIL, seed=1)
    same = torch.Generator()
    same.set_state(learning._drawing.get_state())
    indices, batch = learning.replay.draw(SMALL.batch_size, same)
    outcome = plain.step(batch, torch.tensor(0.0))
    learning.begin(0.0)
    learning.finish()
    assert torch.equal(weights(learning.learner), weights(plain))
    learning.replay.set_priorities(indices, torch.full((8,), -1.0))
    changed = learning.replay.state_dict()["priorities"] < 0
    learning.replay.set_priorities(indices, outcome.priorities)
    assert 1 < changed.sum() <= 8
    episode = learning.end_episode()
    found = (episode.critic_loss, episode.policy_loss, episode.cloning_loss, episode.value)
    assert found == pytest.approx(outcome.losses.tolist())


def test_new_priorities_are_those_of_the_update():
    learning, plain = small(), TD3Learner(SMALL, PHIL, seed=1)
    wanted = copy.deepcopy(learning.replay.state_dict()["priorities"])
    same = torch.Generator()
    same.set_state(learning._drawing.get_state())
    indices, batch = learning.replay.draw(SMALL.batch_size, same)
    wanted[indices.numpy()] = plain.step(batch, torch.tensor(0.0)).priorities.double().numpy()
    assert not (wanted == 1.0).all()
    learning.begin(0.0)
    np.testing.assert_array_equal(learning.replay.state_dict()["priorities"], wanted)


def test_an_action_is_the_actors():
    learning = small()
    np.testing.assert_array_equal(
        learning.act(observation(3)), learning.learner.act(observation(3))
    )
    # What was given away stays as it was.
    first = learning.act(observation(3))
    kept = first.copy()
    learning.act(observation(4))
    np.testing.assert_array_equal(first, kept)


def test_an_episode_reports_mean_losses_and_decays_the_rates():
    learning = small(learning_rate_decay=0.5)
    per_update = []
    for _ in range(3):
        before = learning._loss_sums.clone()
        learning.begin(0.0)
        per_update.append((learning._loss_sums - before).tolist())
    episode = learning.end_episode()
    assert episode.critic_loss == pytest.approx(np.mean(per_update, axis=0)[0])
    assert episode.value == pytest.approx(np.mean(per_update, axis=0)[3])
    assert episode.learning_s > 0
    assert episode.policy_priority != episode.human_priority
    assert learning.learner.actor_optimiser.param_groups[0]["lr"] == pytest.approx(1e-4)
    after = learning.end_episode()
    assert np.isnan(after.critic_loss)
    assert after.learning_s == after.waiting_s == 0.0


def test_validation_between_two_episodes_is_not_waited_for_in_the_next():
    learning = small()
    learning.act(observation(0))
    fill(learning, 2)
    assert learning.end_episode().waiting_s == 0.0


def test_losses_that_are_no_numbers_end_the_run():
    learning = small()
    with torch.no_grad():
        next(learning.learner.critics.parameters()).fill_(torch.nan)
    learning.begin(0.0)
    with pytest.raises(FloatingPointError, match="no longer finite"):
        learning.end_episode()


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_the_policy_learns_every_so_many_updates(delay):
    learning = small(policy_delay=delay)
    moved = []
    for _ in range(6):
        before = weights(learning.learner)[:1000].clone()
        learning.begin(0.0)
        moved.append(not torch.equal(before, weights(learning.learner)[:1000]))
    assert moved == [update % delay == 0 for update in range(1, 7)]


def test_beta_reaches_the_loss():
    learnings = [small(importance_sampling=True) for _ in range(2)]
    for learning in learnings:
        learning.begin(0.0)  # so that priorities differ
    for learning, beta in zip(learnings, (0.0, 1.0), strict=True):
        learning.begin(beta)
    a, b = (learning.end_episode().critic_loss for learning in learnings)
    assert a != b


def test_a_restored_one_goes_on_like_one_unbroken():
    whole, broken = small(), small()
    for learning in (whole, broken):
        for _ in range(4):
            learning.begin(0.0)
        learning.end_episode()
    resumed = AcceleratorLearning(SMALL, PHIL, seed=99, action_size=1, device="cpu")
    resumed.load_state_dict(copy.deepcopy(broken.state_dict()))
    for learning in (whole, resumed):
        fill(learning, 5)
        for _ in range(4):
            learning.begin(0.0)
        learning.end_episode()
    assert torch.equal(weights(whole.learner), weights(resumed.learner))
    ours, theirs = whole.replay.state_dict(), resumed.replay.state_dict()
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name])


TINY = RunConfig(
    seed=3,
    episodes=2,
    evaluate_every=2,
    evaluation_runs=1,
    checkpoint_every=1,
    learner=LearnerConfig(batch_size=2, replay_capacity=2000, warmup_steps=60),
)


def train(config: RunConfig, directory, monkeypatch, resume: bool = False) -> Any:
    def on_the_processor(config, algorithm, action_size):
        return AcceleratorLearning(config.learner, algorithm, config.seed, action_size, "cpu")

    monkeypatch.setattr(run_module, "make_learning", on_the_processor)
    directory.mkdir(exist_ok=True)
    run = TrainingRun(config, directory, resume)
    run.train()
    return run


def test_a_run_trains_and_in_two_parts_ends_the_same(tmp_path, monkeypatch):
    whole = train(TINY, tmp_path / "whole", monkeypatch)
    rows = read_metrics(whole.run_dir)
    assert float(rows[-1]["critic_loss"]) > 0
    assert sum(int(row["human_steps"]) for row in rows) > 0
    assert rows[-1]["validation_success"] != "nan"
    parts = tmp_path / "parts"
    train(replace(TINY, episodes=1), parts, monkeypatch)
    resumed = train(TINY, parts, monkeypatch, resume=True)
    assert resumed.learning.learner.updates > 0
    assert torch.equal(weights(whole.learning.learner), weights(resumed.learning.learner))
    a, b = (load_torch(run.run_dir / "checkpoint.pt")["learning"] for run in (whole, resumed))
    for name, value in a["replay"].items():
        assert torch.equal(torch.as_tensor(value), torch.as_tensor(b["replay"][name])), name
    assert torch.equal(a["drawing"], b["drawing"])


def test_learning_is_where_the_config_says(monkeypatch):
    asked = []
    monkeypatch.setattr(placement, "AcceleratorLearning", lambda *given: asked.append(given))
    config = RunConfig(device="cuda", learner=SMALL, seed=7)
    make_learning(config, PHIL, 1)
    assert asked == [(SMALL, PHIL, 7, 1, "cuda")]
    on_processor = make_learning(replace(config, device="cpu"), PHIL, 1)
    assert isinstance(on_processor, ProcessorLearning)
    on_processor.close()
