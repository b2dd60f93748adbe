"""Runs of several seeds, and their curves: one line with a band for each algorithm."""

import json
import math
import os
import signal
import sys
import threading
import time
from contextlib import closing
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from edge_runtime.cli import INTERRUPTED
from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import call, refusal
from trainer import util
from trainer.__main__ import seeds
from trainer.environments import make_environment
from trainer.training import curves
from trainer.training.metrics import EpisodeMetrics, MetricsWriter, read_metrics

TRAIN = ("train", "--scenario", "Pendulum-v1", "--algorithm", "per_td3", "--steps", 200)


def good(observation: Any, info: Any, total_return: float) -> bool | None:
    """Whether the pendulum hung about upright; a test's word, and a warning."""
    print("judged", file=sys.stderr)
    assert observation.shape == (3,)
    return total_return > -1e9


def run_of(
    directory: Path, algorithm: str, episodes: int, returns: float, known: bool, **settings: Any
) -> Path:
    writer = MetricsWriter(directory)
    for episode in range(episodes):
        due = episode % 5 == 4
        writer.add(
            EpisodeMetrics(
                episode, steps=9, total_steps=9 * episode + 9, episode_return=returns,
                validation_success=0.5 if due and known else math.nan,
                validation_reward=returns if due else math.nan,
            )
        )  # fmt: skip
    writer.close()
    (directory / "config.json").write_text(json.dumps({"algorithm": algorithm, **settings}))
    return directory


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were drawn."""
    figures: list[Figure] = []
    monkeypatch.setattr(curves, "write_figure", lambda figure, path: figures.append(figure))
    return figures


@pytest.mark.parametrize("known", [True, False])
def test_each_algorithm_is_a_line_named_with_a_band_up_to_the_shortest_run(tmp_path, drawn, known):
    for number, (episodes, returns) in enumerate([(30, 1.0), (12, 3.0)]):
        run_of(tmp_path / f"several/seed_{number}", "phil_td3", episodes, returns, known)
    one = run_of(tmp_path / "one", "hi_td3", 20, 5.0, known)
    curves.write_learning_curve(tmp_path / "several", one, out="f.png")
    panels = {panel.get_title(): panel for panel in drawn[0].axes}
    assert ("success of the policy alone, in validation" in panels) == known
    panel = panels["return in training (without shaping)"]
    several, alone = panel.get_lines()
    assert (several.get_label(), alone.get_label()) == ("phil_td3, 2 runs", "hi_td3")
    assert several.get_xdata()[-1] == 12 * 9
    assert several.get_ydata() == pytest.approx(np.full(curves.POINTS, 2.0))
    assert len(panel.collections) == 1
    assert set(alone.get_ydata()) == {5.0}


def test_runs_that_share_no_part_of_an_axis_are_drawn_each_for_itself(tmp_path, drawn):
    for number in range(2):
        run_of(tmp_path / f"seed_{number}", "per_td3", 12, 1.0, True)
    curves.write_learning_curve(tmp_path, out="f.png", x="human_s")
    panels = {panel.get_title(): panel for panel in drawn[0].axes}
    lines = panels["return in training (without shaping)"].get_lines()
    assert [line.get_xdata().tolist() for line in lines] == [[0.0] * 12] * 2
    (text,) = drawn[0].axes[-1].get_legend().get_texts()
    assert text.get_text() == "per_td3"


def test_settings_that_differ_part_an_algorithms_runs_and_name_them(tmp_path, drawn):
    """Not the seed, nor another algorithm's settings."""
    runs = [("phil_td3", 1, 40.0), ("phil_td3", 2, 40.0), ("phil_td3", 1, 10.0), ("hi_td3", 1, 5.0)]
    for number, (algorithm, seed, weight) in enumerate(runs):
        settings = {"seed": seed, "learner": {"cloning_weight": weight}, "source_revision": number}
        run_of(tmp_path / str(number), algorithm, 20, 1.0, True, **settings)
    curves.write_learning_curve(tmp_path, out="f.png")
    labels = [line.get_label() for line in drawn[0].axes[0].get_lines()]
    assert labels == [
        "phil_td3, cloning_weight=40.0, 2 runs", "phil_td3, cloning_weight=10.0", "hi_td3",
    ]  # fmt: skip


def kill_the_first_and_interrupt_the_second(place: Path) -> None:
    for seed in (2, 3):
        while not (place / f"seed_{seed}/checkpoint.pt").exists():
            time.sleep(0.05)
        if seed == 2:
            (worker,) = active_children()
            worker.kill()
    os.kill(os.getpid(), signal.SIGINT)


def test_seeds_are_trained_in_processes_of_their_own_and_drawn(tmp_path, capsys, monkeypatch):
    """A process that dies ends itself alone; after ^C no other begins. A warning is said once."""
    assert [*seeds("1-3")] == [1, 2, 3]
    monkeypatch.setattr(util, "cores", lambda: 1)
    often = ("--set", "evaluation_runs=2", "--set", "evaluate_every_steps=100",
             "--set", "checkpoint_every=1", "--success", f"{__name__}:good")  # fmt: skip
    killer = threading.Thread(target=kill_the_first_and_interrupt_the_second, args=(tmp_path,))
    killer.start()
    long = (*TRAIN[:-1], 10**6, "--seeds", "2-4", "--out", tmp_path)
    status, out, err = call(capsys, *long, *often)
    killer.join()
    assert (status, len(out.splitlines()), err.count("judged\n")) == (INTERRUPTED, 1, 1), err
    assert [line[:15] for line in err.splitlines() if "error" in line] == ["error: seed 2: "]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seed_2", "seed_3"]
    for seed in (2, 3):
        row = read_metrics(tmp_path / f"seed_{seed}")[0]
        assert (row["outcome"], row["validation_success"]) == ("goal", "1.0")
    for options in (("--seeds", "1-3"), ("--seeds", "1-3", "--resume")):
        assert "seed_2" in refusal(capsys, *TRAIN, *options, "--out", tmp_path, *often[-2:])
    assert not (tmp_path / "seed_1").exists()
    judged = (tmp_path / "seed_3", "--success", f"{__name__}:good", "--runs", 1)
    assert json.loads(call(capsys, "evaluate", *judged)[1])["success_rate"] == 1.0
    unknown = json.loads(call(capsys, "evaluate", *judged[:1], "--runs", 1)[1])
    assert (unknown["success_rate"], unknown["collision_rate"]) == (None, None)
    for name in ("curves.pdf", "curves"):
        assert ".png" in refusal(capsys, "plot", tmp_path, "--out", tmp_path / name)
    assert "--out F.png" in refusal(capsys, "plot", tmp_path / "seed_2", tmp_path / "seed_3")
    picture = tmp_path / "curves.png"
    assert call(capsys, "plot", tmp_path, "--x", "human_s", "--out", picture)[0] == 0
    with Image.open(picture) as image:
        assert image.size == (1100, 660)


def test_a_scenario_takes_no_other_judge(tmp_path, capsys):
    options = ("train", "--success", f"{__name__}:good", "--out", tmp_path / "run")
    assert "itself says" in refusal(capsys, *options)


def fails(observation: Any, info: Any, total_return: float) -> bool:
    raise RuntimeError("no judge today")


def last_info(task: str) -> Any:
    """The info at the end of an episode at rest, which ``fails`` judges."""
    ended = False
    with closing(make_environment(task, success=f"{__name__}:fails")) as env:
        env.reset(seed=0)
        while not ended:
            _, _, terminated, truncated, info = env.step(env.rest_action)
            ended = terminated or truncated
    return info


@pytest.mark.parametrize("judge", [fails, lambda *_: "no", lambda *_: math.nan, lambda: True, 5])
def test_a_judge_that_does_not_answer_is_one_line(judge, monkeypatch):
    monkeypatch.setitem(globals(), "fails", judge)
    with pytest.raises(UserError, match="--success") as refused:
        last_info("Pendulum-v1")
    assert "\n" not in str(refused.value)


def test_a_judge_is_not_asked_where_the_environment_says_it():
    assert last_info("examples.tasks:examples/Hill-v0")["outcome"] == "failed"
