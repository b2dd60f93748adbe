import json
import math
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from edge_runtime.cli import INTERRUPTED, run_cli
from edge_runtime.util import UserError
from hil_tests.processes import wait_until
from trainer.__main__ import main
from trainer.environments import make_environment
from trainer.evaluation import BEST_FILE, CHECKPOINT_FILE, load_actor
from trainer.human.guide import ASKED, Asking
from trainer.learner.config import LearnerConfig
from trainer.tests.learners import same_weights
from trainer.tests.loops import rows_of
from trainer.training.command import check_directory
from trainer.training.config import RunConfig
from trainer.training.metrics import NAMES, read_metrics
from trainer.training.run import TrainingRun
from trainer.util import load_torch, save_torch

# Learning, the slowest part, begins late, and still before what a test looks at.
SMALL = LearnerConfig(batch_size=4, replay_capacity=2000, warmup_steps=170, exploration_initial=1.0)
TINY = RunConfig(seed=3, episodes=4, evaluation_runs=1, checkpoint_every=1, learner=SMALL)
TINY = replace(TINY, evaluate_every_steps=190)  # after two and four episodes


def train(config: RunConfig, directory: Path, resume: bool = False) -> TrainingRun:
    directory.mkdir(exist_ok=True)
    run = TrainingRun(config, directory, resume)
    run.train()
    return run


def train_in_parts(config: RunConfig, directory: Path) -> TrainingRun:
    """As a run that is asked to end in its second episode, and goes on."""
    directory.mkdir()
    first = TrainingRun(config, directory)
    first.train(lambda _: setattr(first, "quitting", True))
    assert first.episode == 2
    return train(config, directory, resume=True)


def same_actors(one, other):
    return all(torch.equal(weights, other[name]) for name, weights in one.items())


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> TrainingRun:
    return train(TINY, tmp_path_factory.mktemp("run"))


def test_a_run_leaves_config_metrics_checkpoint_and_best_actor(trained):
    directory = trained.run_dir
    config = json.loads((directory / "config.json").read_text())
    assert config.pop("source_revision")
    assert config == json.loads(json.dumps(asdict(TINY)))
    rows = read_metrics(directory)
    assert list(rows[0]) == NAMES
    found = [(row["episode"], row["validation_success"] != "nan") for row in rows]
    assert found == [("0", False), ("1", True), ("2", False), ("3", True)]
    steps, human_steps = (sum(int(row[name]) for row in rows) for name in ("steps", "human_steps"))
    assert int(rows[-1]["total_steps"]) == steps
    assert human_steps == trained.learning.replay.human_count > 0
    assert EventAccumulator(str(directory / "tensorboard")).Reload().Tags()["scalars"]
    assert load_actor(directory, make_environment("left_turn"))[1]["seed"] == 3


def test_the_same_seed_in_two_parts_gives_the_same_weights_and_metrics(trained, tmp_path):
    rest = train_in_parts(TINY, tmp_path / "parts")
    assert same_weights(trained.learning.learner, rest.learning.learner)
    assert rows_of(rest) == rows_of(trained)


@pytest.mark.parametrize(("row", "warmup_steps"), [("phil_gated", 170), ("ppl_td3", 300)])
def test_a_robot_that_asks_or_foresees_goes_on_as_it_would_have(
    tmp_path, monkeypatch, row, warmup_steps
):
    monkeypatch.setattr(Asking, "MEMORY", 60)
    human: dict[str, Any] = {"late_to_s": 0.8, "missed_share": 0.3}
    learner = replace(SMALL, warmup_steps=warmup_steps)
    config = replace(TINY, algorithm=row, learner=learner, **human)
    whole, reasons, foreseen = TrainingRun(config, tmp_path / "whole"), set[Any](), set()

    def record(transition, intervention, info):
        reasons.add(intervention and intervention.reason)
        foreseen.add(len(transition.foreseen))

    whole.recorders.append(record)
    whole.train()
    assert (foreseen != {0}) == (row == "ppl_td3")
    assert (ASKED in reasons) == (row == "phil_gated")
    rest = train_in_parts(config, tmp_path / "parts")
    assert same_weights(whole.learning.learner, rest.learning.learner)
    assert rows_of(whole) == rows_of(rest)


def command(directory: Path, *extra: str) -> list[str]:
    settings = ("batch_size=4", "replay_capacity=2000", "warmup_steps=300", "checkpoint_every=1",
                "evaluate_every_steps=0")  # fmt: skip
    chosen = [part for setting in settings for part in ("--set", setting)]
    return [
        sys.executable, "-m", "trainer", "train", "--seed", "3", "--episodes", "5", "--threads",
        "1", "--out", str(directory), *chosen, *extra,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "whole"
    assert run_cli(main, command(directory)[3:]) == 0
    return directory


def resume_and_compare(directory: Path, whole: Path, *extra: str) -> None:
    assert run_cli(main, command(directory, "--resume", *extra)[3:]) == 0
    a, b = (load_torch(d / CHECKPOINT_FILE) for d in (directory, whole))
    assert a["episode"] == b["episode"] == len(read_metrics(directory)) == 5
    assert same_actors(*(each["learning"]["learner"]["actor"] for each in (a, b)))


def test_a_checkpoint_of_other_observations_or_with_crafted_fields_is_said_to_fit_no_more(tmp_path):
    config = replace(TINY, episodes=1, evaluate_every_steps=0)
    train(config, tmp_path)
    state = load_torch(tmp_path / CHECKPOINT_FILE)
    replay, learner = state["learning"]["replay"], state["learning"]["learner"]
    wide, moments = torch.cat([replay["pictures"]] * 2, dim=-1), {"state": {0: {"exp_avg": 1}}}
    for place, name, crafted in (
        (replay, "pictures", wide),
        (replay, "priorities", torch.full_like(replay["priorities"], math.nan)),
        (learner, "actor_optimiser", {**learner["actor_optimiser"], **moments}),
        (learner, "updates", None),
        (state, "steps", torch.zeros(2)),
        (state, "best_validation", "no"),
    ):
        kept, place[name] = place[name], crafted
        save_torch(tmp_path / CHECKPOINT_FILE, state)
        with pytest.raises(UserError, match="does not fit this run"):
            TrainingRun(config, tmp_path, resume=True)
        place[name] = kept


def test_a_killed_run_resumes_and_ends_like_one_never_killed(tmp_path, whole):
    process = subprocess.Popen(command(tmp_path), stderr=subprocess.DEVNULL)
    wait_until(lambda: len(read_metrics(tmp_path)) >= 3, "three episodes", 120.0)
    process.kill()
    process.wait()
    assert 3 <= len(read_metrics(tmp_path)) < 5, "killed too late to mean anything"
    resume_and_compare(tmp_path, whole)


def test_a_run_that_was_killed_before_its_first_checkpoint_begins_anew(tmp_path):
    config = replace(TINY, episodes=2, evaluate_every_steps=0)
    with pytest.raises(UserError, match="holds no checkpoint to resume from"):
        check_directory(tmp_path, config, resume=True)
    (tmp_path / "config.json").write_text(json.dumps(asdict(config)))
    assert run_cli(main, ["train", "--out", str(tmp_path), "--resume"]) == 0
    assert len(read_metrics(tmp_path)) == 2
    # A run that has had its checkpoint is not written over.
    (tmp_path / CHECKPOINT_FILE).unlink()
    with pytest.raises(UserError, match="holds no checkpoint to resume from"):
        check_directory(tmp_path, config, resume=True)


def test_a_run_that_is_asked_to_end_keeps_all_its_episodes(tmp_path, whole):
    """Far from its next checkpoint."""
    seldom = ("--set", "checkpoint_every=100")

    def interrupt():
        wait_until(lambda: len(read_metrics(tmp_path)) >= 2, "two episodes", 120.0)
        os.kill(os.getpid(), signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(interrupt)
        assert run_cli(main, command(tmp_path, *seldom)[3:]) == INTERRUPTED
    driven = len(read_metrics(tmp_path))
    assert 2 <= driven < 5
    assert load_torch(tmp_path / CHECKPOINT_FILE)["episode"] == driven
    resume_and_compare(tmp_path, whole, *seldom)


def test_a_deadline_ends_a_run_with_a_checkpoint_and_no_validation_of_its_own(tmp_path):
    run = TrainingRun(replace(TINY, checkpoint_every=100), tmp_path)
    run.train(deadline_s=time.monotonic() - 1.0)
    assert load_torch(tmp_path / CHECKPOINT_FILE)["episode"] == 1
    assert not (tmp_path / BEST_FILE).exists()


def test_what_is_kept_is_the_averaged_network_that_was_validated(tmp_path):
    config = replace(TINY, episodes=1, evaluate_every_steps=1, averaged_actor=True)
    run: Any = TrainingRun(config, tmp_path)
    with torch.no_grad():
        run.learning.learner.actor.head.output.bias.add_(0.5)  # now the two differ
    judged: list[Any] = []
    drive, pictures = run.validation.drive, np.zeros((1, 2, 45, 80), np.uint8)

    def spy(driver, best):
        judged.append(driver.act_together(pictures))
        return drive(driver, best)

    run.validation.drive = spy
    run.train()
    network = run.learning.learner.target_actor
    assert judged == [network.act(pictures)]
    wanted = network.state_dict()
    assert same_actors(wanted, load_actor(tmp_path, make_environment("left_turn"))[0].state_dict())
    (tmp_path / BEST_FILE).unlink()  # then the checkpoint's
    assert same_actors(wanted, load_actor(tmp_path, make_environment("left_turn"))[0].state_dict())
