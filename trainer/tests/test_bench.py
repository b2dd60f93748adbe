"""The bench measures what it says, and its arithmetic is right. No test asks how fast."""

import json
import sys
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from trainer.benches import learner, replay, training
from trainer.benches.effort import QUICK
from trainer.benches.environment import HIGHWAY, OURS
from trainer.benches.environment import summary as environment_summary
from trainer.benches.experience import fill, gather
from trainer.benches.memory import resident_bytes
from trainer.benches.table import Row, rows
from trainer.benches.training import Episode
from trainer.benches.turns import compare, median, take_turns
from trainer.benches.updates import Updates
from trainer.commands import bench
from trainer.learner.replay import ReplayBuffer
from trainer.learner.td3 import Losses
from trainer.scenarios import SCENARIOS
from trainer.tests.test_commands import call
from trainer.training.learning import LearningThread

TINY = replace(
    QUICK,
    batch_size=4,
    learner_rounds=1,
    updates_per_round=1,
    environment_rounds=2,
    steps_per_round=10,
    training_episodes=1,
    own_updates=1,
    replay_transitions=300,
    replay_draws=3,
    memory_episodes=1,
)

# Turns and ratios


def test_contenders_take_turns_and_none_is_always_first():
    calls: list[str] = []

    def work(name: str) -> list[float]:
        calls.append(name)
        return [1.0]

    contenders = {name: partial(work, name) for name in "abc"}
    ticks: list[str] = []
    times = take_turns(contenders, 4, ticks.append)
    assert "".join(calls) == "abc" + "abc" + "bca" + "cab" + "abc"
    assert times == {name: [[1.0]] * 4 for name in "abc"}
    assert len(ticks) == 4


def test_ratios_are_of_medians_and_of_rounds():
    ours, peers = [[1.0, 2.0, 3.0], [10.0, 10.0, 10.0]], [[4.0, 4.0, 4.0], [30.0, 30.0, 30.0]]
    assert median(ours) == 6.5
    assert compare(ours, peers) == (17.0 / 6.5, 2.5)


def test_a_slow_round_cancels_out_of_the_rounds_ratio():
    ours, peers = [[1.0], [9.0], [1.0]], [[3.0], [27.0], [3.0]]
    assert compare(ours, peers).median_of_rounds == 3.0


def test_learner_summary():
    times_ms = {learner.OURS: [[20.0], [30.0]], learner.SB3: [[100.0], [90.0]]}
    figures = learner.summary(times_ms, {learner.SB3: {"threads": 1}})
    assert figures["ms_per_update"] == 25.0
    assert figures["updates_per_s"] == 40.0
    assert figures["peers"] == {
        learner.SB3: {
            "ms_per_update": 95.0,
            "ratio": {"of_medians": 3.8, "median_of_rounds": 4.0},
            "about": {"threads": 1},
        }
    }


def test_environment_summary():
    figures = environment_summary({OURS: [[0.0005]], HIGHWAY: [[0.004]]})
    assert figures["steps_per_s"] == 2000.0
    assert figures["peers"][HIGHWAY]["steps_per_s"] == 250.0
    assert figures["peers"][HIGHWAY]["ratio"]["of_medians"] == 8.0


def test_training_summary_scales_and_weighs_by_steps():
    parts = {"environment": 0.1, "acting": 0.2, "storing": 0.3, "learning": 3.0, "waiting": 0.0}
    episodes = [Episode(100, 4.0, parts, 30.0), Episode(300, 12.0, parts, 40.0)]
    figures = training.summary(episodes)
    assert figures["steps"] == 400
    assert figures["s_per_10k_steps"] == pytest.approx(
        {
            "total": 400.0,
            "environment": 5.0,
            "acting": 10.0,
            "storing": 15.0,
            "learning": 150.0,
            "waiting": 0.0,
        }
    )
    # Alone: 100 updates of 30 ms and 300 of 40 ms.
    assert figures["learner_alone_s_per_10k_updates"] == pytest.approx(375.0)
    ratio = figures["ratio_to_learner_alone"]
    assert ratio["of_sums"] == pytest.approx(16.0 / 15.0)
    assert ratio["median_of_episodes"] == pytest.approx((4.0 / 3.0 + 1.0) / 2)


# Our own side


def test_an_update_draws_learns_and_sets_the_new_priorities():
    class Recorder:
        def __init__(self):
            self.seen = []

        def update(self, batch, beta):
            self.seen.append(batch)
            return Losses(0.0, 0.0, 0.0, 0.0, np.full(len(batch.indices), 7.0))

    recorder, buffer, experience = Recorder(), ReplayBuffer(50), gather(50)
    fill(buffer, experience)
    times_ms = Updates(recorder, buffer, batch_size=8).run(3)
    assert len(times_ms) == 3
    assert [len(batch.indices) for batch in recorder.seen] == [8, 8, 8]
    drawn = np.concatenate([batch.indices for batch in recorder.seen])
    assert (buffer._priorities[drawn] == 7.0).all()
    assert 0 < experience.human.sum() < 50


def test_an_effective_precision_of_float32_is_measured_once(monkeypatch):
    monkeypatch.setattr(learner, "TRANSITIONS", 20)
    for has_bfloat16, precision in ((True, "bfloat16"), (False, "float32")):
        monkeypatch.setattr(learner, "multiplies_bfloat16", lambda kind, has=has_bfloat16: has)
        figures = learner.measure_learner(TINY, None, lambda done: None)
        assert figures["precision"] == precision
        assert (learner.FLOAT32 in figures["peers"]) == has_bfloat16
        assert learner.REFERENCE in figures["peers"]


def test_the_learner_alone_works_in_the_thread_of_the_updates(monkeypatch):
    threads: list[set[str]] = [set(), set()]

    def spy(owner: type, name: str, seen: set[str]) -> None:
        true = getattr(owner, name)

        def spied(*arguments):
            seen.add(threading.current_thread().name)
            return true(*arguments)

        monkeypatch.setattr(owner, name, spied)

    spy(LearningThread, "_update", threads[0])
    spy(Updates, "run", threads[1])
    training.measure_training(TINY, lambda done: None)
    assert len(threads[0]) == 1
    assert threads[0] == threads[1] != {threading.main_thread().name}


def test_the_whole_report(monkeypatch):
    # A fresh process takes seconds to start; the training's memory needs one.
    monkeypatch.setattr(replay, "apart", lambda work, *arguments: work(*arguments))
    ticks: list[str] = []
    ballast = np.ones(50_000_000)
    report = bench.measure(list(bench.ROUNDS), TINY, None, ticks.append)
    json.dumps(report, allow_nan=False)
    assert len(ticks) == sum(rounds(TINY) for rounds in bench.ROUNDS.values())
    assert {"machine", "threads", "torch", "source_revision"} <= set(report)
    assert report["learner_ms_per_update"] == report["learner"]["ms_per_update"] > 0
    assert set(report["environment_steps_per_s"]) == set(SCENARIOS)
    assert set(report["train_s_per_10k_steps"]) == {"total", *training.PARTS}
    assert report["replay"]["transitions"] == 300
    # 3,600 bytes a picture, at least one for each transition.
    assert report["replay"]["allocated_mb"] > 300 * 3600e-6
    assert report["memory"]["training_peak_mb"] > 50
    if sys.platform == "linux":
        # The training's own memory, and none of ours.
        assert report["memory"]["training_peak_mb"] < 1e-6 * resident_bytes("VmHWM") - 200
    assert ballast.nbytes == 400_000_000
    lines = rows(report)
    assert any("left out" in line.peer for line in lines)
    assert {line.bar.split("  ")[0] for line in lines} == {"", "≥ 8", "≥ 10", "≤ 1.15", "< 400"}


def test_the_table_says_which_bars_are_missed():
    figures = environment_summary({OURS: [[0.001]], HIGHWAY: [[0.009]]})
    assert rows({"environment": {"left_turn": figures}}) == [
        Row(
            "left_turn with observation, steps/s",
            "1000",
            "111  highway-env grayscale",
            "9.00",
            "≥ 10  MISSED",
        )
    ]


def test_only_some_parts_are_measured_and_written(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "FULL", TINY)
    out = tmp_path / "b.json"
    status, table, _ = call(capsys, "bench", "--only", "environment", "--out", str(out))
    assert status == 0
    assert "highway-env grayscale" in table
    report = json.loads(out.read_text())
    assert set(report["environment_steps_per_s"]) == set(SCENARIOS)
    assert "learner_ms_per_update" not in report
    assert "train_s_per_10k_steps" not in report


@pytest.mark.parametrize(
    "arguments", [("--only", "learner,speed"), ("--only", ""), ("--peers", "{tmp}/python")]
)
def test_bad_options_get_one_line_and_status_2(arguments, capsys, tmp_path):
    arguments = tuple(a.format(tmp=tmp_path) for a in arguments)
    status, out, err = call(capsys, "bench", *arguments)
    assert (status, out, len(err.strip().splitlines())) == (2, "", 1)
