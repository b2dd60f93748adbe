import json
import math
import signal
import time
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from edge_runtime.cli import INTERRUPTED, run_cli
from edge_runtime.util import UserError
from trainer.__main__ import main
from trainer.environments import make_environment
from trainer.evaluation import BEST_FILE, CHECKPOINT_FILE, load_actor
from trainer.human.guide import ASKED, Asking
from trainer.learner.config import LearnerConfig
from trainer.scenarios.left_turn import SCENES
from trainer.tests.learners import on_a_gpu, same_weights
from trainer.tests.loops import rows_of
from trainer.training.command import check_directory
from trainer.training.config import RunConfig
from trainer.training.metrics import NAMES, MetricsWriter, read_metrics
from trainer.training.run import TrainingRun
from trainer.util import load_torch, save_torch

# Learning, the slowest part, begins late, and still before what a test looks at.
SMALL = LearnerConfig(batch_size=4, replay_capacity=2000, warmup_steps=50, exploration_initial=1.0)
TINY = RunConfig(seed=3, episodes=4, evaluation_runs=1, checkpoint_every=1, learner=SMALL)
TINY = replace(TINY, evaluate_every_steps=60)  # after two and four episodes
SHORT = replace(SCENES["nominal"], max_steps=30)


@pytest.fixture(scope="module", autouse=True)
def _short_episodes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCENES, "nominal", SHORT)
        yield


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


@on_a_gpu
def test_on_a_gpu_the_same_seed_in_two_parts_gives_the_same_weights(tmp_path):
    config = replace(TINY, device="cuda")
    whole, rest = train(config, tmp_path / "whole"), train_in_parts(config, tmp_path / "parts")
    assert same_weights(whole.learning.learner, rest.learning.learner)
    assert rows_of(rest) == rows_of(whole)


@pytest.mark.parametrize(("row", "warmup_steps"), [("phil_gated", 50), ("ppl_td3", 80)])
def test_a_robot_that_asks_or_foresees_goes_on_as_it_would_have(
    tmp_path, monkeypatch, row, warmup_steps
):
    monkeypatch.setattr(Asking, "MEMORY", 20)
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


def resume_and_compare(directory: Path, whole: TrainingRun) -> None:
    assert run_cli(main, ["train", "--out", str(directory), "--resume"]) == 0
    a, b = (load_torch(d / CHECKPOINT_FILE) for d in (directory, whole.run_dir))
    assert a["episode"] == b["episode"] == len(read_metrics(directory)) == TINY.episodes
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


def train_and_die(directory: Path) -> None:
    """In the midst of the third episode, which its process does not survive."""
    SCENES["nominal"] = SHORT
    run = TrainingRun(TINY, directory)

    def die(*_: Any) -> None:
        if run.learning.replay.added == 75:
            signal.raise_signal(signal.SIGKILL)

    run.recorders.append(die)
    run.train()


def test_a_killed_run_resumes_and_ends_like_one_never_killed(tmp_path, trained):
    process = get_context("spawn").Process(target=train_and_die, args=(tmp_path,))
    process.start()
    process.join()
    assert (process.exitcode, len(read_metrics(tmp_path))) == (-signal.SIGKILL, 2)
    resume_and_compare(tmp_path, trained)


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


def test_a_run_that_is_asked_to_end_keeps_all_its_episodes(tmp_path, trained, monkeypatch):
    """Far from its next checkpoint."""
    seldom, add = replace(TINY, checkpoint_every=100), MetricsWriter.add
    (tmp_path / "config.json").write_text(json.dumps(asdict(seldom)))

    def interrupted(writer, metrics):
        add(writer, metrics)
        if metrics.episode == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(MetricsWriter, "add", interrupted)
    assert run_cli(main, ["train", "--out", str(tmp_path), "--resume"]) == INTERRUPTED
    assert load_torch(tmp_path / CHECKPOINT_FILE)["episode"] == len(read_metrics(tmp_path)) == 2
    resume_and_compare(tmp_path, trained)


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
