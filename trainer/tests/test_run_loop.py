"""The loop on a scripted road: what is stored, when it learns, validates and ends."""

import math
import tempfile
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.util import UserError
from trainer.evaluation import BEST_FILE, CHECKPOINT_FILE
from trainer.learner.config import LearnerConfig
from trainer.learner.replay import Transition
from trainer.tests.loops import (
    BATCH,
    CONFIG,
    HUMAN,
    POLICY,
    ScriptedEnv,
    number,
    scripted_run,
    trained,
)
from trainer.training.config import RunConfig
from trainer.training.learning import UnhurriedLearning
from trainer.training.metrics import EpisodeMetrics, MetricsWriter
from trainer.training.run import Trials, Validation
from trainer.util import load_torch


@pytest.mark.parametrize(
    ("algorithm", "reason", "penalty"),
    [
        ("phil_td3", "collision", -7.0),
        ("phil_td3", "stuck", 0.0),
        ("phil_without_shaping", "collision", 0.0),
        ("rlif_td3", "collision", -7.0),
        ("rlif_td3", "stuck", -7.0),
        ("pvp_td3", "collision", 0.0),
        ("phil_gated", "collision", -7.0),
        ("phil_gated", "asked", 0.0),
    ],
)
@pytest.mark.parametrize("penalty_on", ["human", "overruled"])
def test_what_was_done_is_stored_and_only_taking_over_is_penalised(
    tmp_path, algorithm, reason, penalty, penalty_on
):
    config: dict[str, str] = {"penalty_on": penalty_on, "reason": reason}
    run = trained(tmp_path, 5, human_steps=(2, 3), algorithm=algorithm, **config)
    assert [told.episode_return for told in run.told] == [15.0]  # whatever the penalty
    paid = 0.0 if algorithm in ("rlif_td3", "pvp_td3") else 1.0  # these have no reward
    charged = penalty if penalty_on == "human" else 0.0
    for step, stored in enumerate(run.stored, start=1):
        human = step in (2, 3)
        assert (number(stored.observation), number(stored.next_observation)) == (step - 1, step)
        assert stored.action[0] == (HUMAN if human else POLICY)
        assert (stored.overruled[0], stored.human) == (POLICY, human)
        assert stored.penalised == (step == 2 and penalty < 0.0)
        assert stored.reward == step * paid + charged * (step == 2)
        assert stored.terminal == (step == 5)
    assert run.env.actions == [stored.action[0] for stored in run.stored]


@pytest.mark.parametrize(
    ("outcome", "terminal"), [("goal", True), ("collision", True), ("timeout", False)]
)
def test_a_timeout_ends_the_episode_but_is_not_terminal(tmp_path, outcome, terminal):
    run = trained(tmp_path, 2, outcome, episodes=2)
    assert [stored.terminal for stored in run.stored] == [False, terminal] * 2
    assert [stored.truncated for stored in run.stored] == [False, not terminal] * 2


@pytest.mark.parametrize(("warmup_steps", "updates"), [(1, 4), (4, 2)])
def test_learning_waits_for_the_warmup_and_writes_each_updates_priorities_back(
    tmp_path, warmup_steps, updates
):
    run = trained(tmp_path, updates + warmup_steps, warmup_steps=warmup_steps)
    assert len(run.learned) == updates
    assert run.written == run.learned


def test_as_many_updates_follow_a_step_as_are_asked_for(tmp_path):
    run = trained(tmp_path, 4, warmup_steps=1, updates_per_step=3)
    assert len(run.learned) == 3 * 3
    assert run.written == run.learned


def test_a_human_at_the_wheel_does_not_drive_against_the_brake_of_a_silent_network(tmp_path):
    run = trained(tmp_path, 7, human_steps=(4, 5), latency="up.loss=100%")
    assert run.env.braked == [False, False, True, False, False, True, True]


@given(st.floats(0.0, 1.0), st.integers(1, 300))
def test_the_share_of_watched_episodes_is_met_at_any_time(share, episodes):
    config = replace(CONFIG, guided_share=share)
    watched = sum(config.guided(episode) for episode in range(episodes))
    assert watched == math.ceil(episodes * share)


def test_the_human_leaves_after_so_many_episodes(tmp_path):
    run = trained(tmp_path, 2, human_steps=(2,), episodes=4, guided_until_episode=2)
    assert [stored.human for stored in run.stored] == [False, True] * 2 + [False] * 4


def test_a_budget_in_steps_ends_the_run_with_the_episode_under_way(tmp_path):
    run = trained(tmp_path, 2, episodes=100, steps=5)
    assert (run.episode, run.steps) == (3, 6)


@pytest.mark.parametrize(
    ("outcomes", "searched"),
    [
        ("collision collision collision collision", [True, False, True, False]),
        ("goal goal collision collision", [True, False, False, False]),
        ("goal collision goal collision", [True, False, True, False]),
        ("collision ended collision collision", [True, False, True, False]),
        ("ended ended ended ended", [True, False, False, False]),
    ],
)
def test_every_other_episode_searches_until_one_of_the_rest_succeeds(tmp_path, outcomes, searched):
    learner = replace(CONFIG.learner, exploration_searching=4.0)
    run = scripted_run(tmp_path, replace(CONFIG, learner=learner), length=60)
    for outcome, is_searching in zip(outcomes.split(), searched, strict=True):
        run.env.outcome = outcome
        assert run.advance().exploration_std == 4.0 * is_searching
        driven = {*run.env.actions[-60:]}
        assert {-1.0, 1.0} < driven if is_searching else driven == {POLICY}


def bad_update(run):
    run.learning.learner.begin = lambda *_: torch.full((4 + BATCH,), torch.nan)


def bad_action(run):
    run.learning._acting.act = lambda _: np.array([[np.nan]], np.float32)


def bad_weights(run):
    with torch.no_grad():
        next(run.learning.learner.target_critics.parameters()).fill_(torch.inf)


@pytest.mark.parametrize("spoil", [bad_update, bad_action, bad_weights])
def test_divergence_ends_the_run_where_it_shows_and_the_checkpoint_stays(spoil, tmp_path):
    run = scripted_run(tmp_path, replace(CONFIG, episodes=3), length=4)
    with closing(MetricsWriter(tmp_path)) as metrics:
        metrics.add(run.advance())
    run.save()
    before = (tmp_path / CHECKPOINT_FILE).read_bytes()
    spoil(run)
    with pytest.raises(UserError, match="diverged"):
        run.train()
    assert all(np.isfinite(run.env.actions))
    assert (tmp_path / CHECKPOINT_FILE).read_bytes() == before


PICTURE = np.random.default_rng(1).integers(0, 255, (2, 45, 80)).astype(np.uint8)
SOON_S = 30.0


def transition(reward: float = 0.0, action: float = 0.5, **more: Any) -> Transition:
    done = more.pop("terminal", False)
    return Transition(PICTURE, np.full(1, action, np.float32), reward, PICTURE, done, **more)


def test_an_update_runs_beside_the_step_and_knows_what_was_stored_before_it(tmp_path):
    run = scripted_run(tmp_path, CONFIG, length=4)
    begun, moved, known = threading.Event(), threading.Event(), []
    begin, step = run.learning.learner.begin, run.env.step

    def slow_update(batch, beta):
        begun.set()
        assert moved.wait(10.0)  # so it is still at work when the environment is done
        known.append(len(run.stored))
        return begin(batch, beta)

    def step_beside(action):
        assert not run.stored or begun.wait(10.0)
        moved.set()
        return step(action)

    run.learning.learner.begin, run.env.step = slow_update, step_beside
    run.train()
    assert known == [1, 2, 3]


@pytest.fixture
def unhurried(one_thread):
    config = RunConfig(learner=LearnerConfig(batch_size=2, replay_capacity=50, warmup_steps=1))
    unhurried = UnhurriedLearning(config, ScriptedEnv())
    for reward in range(3):
        unhurried.add(transition(float(reward)))
    unhurried.release()
    yield unhurried
    unhurried.close()


@pytest.fixture
def gate(unhurried, monkeypatch):
    """Updates are held up until it is open."""
    learner, gate = unhurried.learner, SimpleNamespace(open=threading.Event(), begun=0)
    begin = learner.begin

    def held_up(batch, beta=0.0):
        gate.begun += 1
        assert gate.open.wait(SOON_S)
        return begin(batch, beta)

    monkeypatch.setattr(learner, "begin", held_up)
    return gate


def test_while_an_update_hangs_everything_goes_on(unhurried, gate):
    before = unhurried.act(PICTURE)
    unhurried.begin(0.0)
    for _ in range(5):
        np.testing.assert_array_equal(unhurried.act(PICTURE), before)
        unhurried.begin(0.0)
        assert unhurried.finish() == 0.0
    assert not unhurried._begun.done()
    assert gate.begun <= 1
    gate.open.set()
    unhurried.settle()
    assert np.any(unhurried.act(PICTURE) != before)


def test_an_episode_is_stored_in_its_order_after_the_update_or_not_at_all(unhurried, gate):
    unhurried.begin(0.0)
    for keep, reward in ((False, 9.0), (True, 3.0)):
        unhurried.add(transition(reward, human=True))
        unhurried.add(transition(reward + 1.0, terminal=True))
        assert unhurried.replay.added == 3
        if not keep:
            threading.Timer(0.05, gate.open.set).start()
        unhurried.end_episode(0.0, keep)
    unhurried.release()
    state = unhurried.state_dict()["replay"]
    assert state["rewards"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert state["human"].tolist() == [False, False, False, True, False]
    assert state["terminals"].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]


def drives(successes: int, failures: int) -> list[Any]:
    outcomes = ["goal"] * successes + ["timeout"] * failures
    return [SimpleNamespace(outcome=each, reward=0.0, distance_m=0.0) for each in outcomes]


def take_drives(validation, results, episode: int) -> EpisodeMetrics:
    actor: Any = SimpleNamespace(state_dict=lambda: {"number": torch.tensor(episode)})
    validation.take(results, actor, metrics := EpisodeMetrics(episode), episode)
    return metrics


def test_an_actor_that_was_lucky_in_validation_does_not_replace_a_better_one(tmp_path):
    config = replace(CONFIG, evaluation_runs=2, confirmation_factor=2)
    validation = Validation(config, tmp_path, cast(Any, None))
    kept = []
    judged = [((1, 1), (3, 1)), ((2, 0), (2, 2)), ((1, 1), (4, 0))]
    for episode, (first, second) in enumerate(judged):
        metrics = take_drives(validation, [*drives(*first), *drives(*second)], episode)
        assert metrics.validation_success == first[0] / 2
        assert metrics.confirmed_success == second[0] / 4
        kept.append(load_torch(tmp_path / BEST_FILE)["episode"])
    assert kept == [0, 0, 2]


def test_only_an_actor_no_worse_than_the_kept_one_drives_the_second_set():
    config = replace(CONFIG, evaluation_runs=2, confirmation_factor=3)
    trials: Any = Trials(config)
    driven: list[int] = []

    def drive(driver, seeds):
        driven.extend(seeds)
        return drives(1, len(seeds) - 1)

    trials._drive = drive
    for best, count in (((0.5, 0.0), 8), ((0.51, 0.0), 2)):
        driven.clear()
        assert len(trials.drive(None, best)) == len({*driven}) == count


@given(st.lists(st.integers(0, 3), min_size=1, max_size=12), st.data())
def test_when_a_run_was_stopped_does_not_decide_which_actor_it_ends_with(scores, data):
    """Each episode: the success that a validation finds."""
    with tempfile.TemporaryDirectory() as folder:
        kept = {}
        for name, stops in (("unbroken", False), ("stopped", True)):
            run_dir = Path(folder, name)
            run_dir.mkdir()
            validation = Validation(CONFIG, run_dir, cast(Any, None))
            for episode, score in enumerate(scores):
                take_drives(validation, drives(score, 3 - score), episode)
                if stops and data.draw(st.booleans()):
                    state, validation = (
                        validation.state_dict(),
                        Validation(CONFIG, run_dir, cast(Any, None)),
                    )
                    validation.load_state_dict(state)
            path = run_dir / BEST_FILE
            kept[name] = load_torch(path)["episode"] if path.exists() else None
    assert kept["stopped"] == kept["unbroken"]
