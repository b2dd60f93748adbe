import json
from functools import partial
from itertools import count
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from hil_tests.testing.commands import call
from trainer import bench
from trainer.learner.td3 import Losses, TD3Learner
from trainer.scenarios import SCENARIOS

TINY = bench.Effort(
    batch_size=4, rounds=2, updates_per_round=1, steps_per_round=10, training_episodes=1
)


def test_contenders_take_turns_and_none_is_always_first(monkeypatch):
    calls, ticks, clock = list[str](), list[str](), count()
    monkeypatch.setattr(bench.time, "perf_counter", lambda: float(next(clock)))
    contenders = {name: partial(calls.append, name) for name in "abc"}
    times = bench.take_turns(contenders, 4, 2, ticks.append)
    assert "".join(calls[::2]) == "abc" + "abc" + "bca" + "cab" + "abc"
    assert times == {name: [0.5] * 4 for name in "abc"}
    assert len(ticks) == 4


def test_training_figures_scale_to_10000_steps():
    names = [f"{name}_s" for name in bench.PARTS]
    parts_s = dict(zip(names, (0.1, 0.2, 0.3, 6.0, 0.0), strict=True))
    episodes: list[Any] = [SimpleNamespace(steps=steps, **parts_s) for steps in (100, 300)]
    found = bench.training_figures(episodes, 16.0)
    wanted = zip(("total", *bench.PARTS), (400.0, 5.0, 10.0, 15.0, 300.0, 0.0), strict=True)
    assert found["steps"] == 400
    assert found["s_per_10k_steps"] == pytest.approx(dict(wanted))


def test_an_update_draws_learns_and_sets_the_new_priorities():
    seen: list[Any] = []

    def learn(batch, beta):
        seen.append(batch.indices)
        return Losses(0.0, 0.0, 0.0, 0.0, np.full(len(batch.indices), 7.0))

    buffer, learner = bench.filled(bench.gather(50)), SimpleNamespace(update=learn)
    update = bench.whole_update(learner, buffer, batch_size=8)  # type: ignore[arg-type]
    for _ in range(3):
        update()
    assert [len(indices) for indices in seen] == [8, 8, 8]
    assert (buffer._priorities[np.concatenate(seen)] == 7.0).all()
    assert 0 < buffer.human_count < 50


@pytest.mark.parametrize(("has", "precision"), [(True, "bfloat16"), (False, "float32")])
def test_an_effective_precision_of_float32_is_measured_once(has, precision, monkeypatch):
    monkeypatch.setattr(bench, "TRANSITIONS", 20)
    monkeypatch.setattr(bench, "bfloat16_is_faster", lambda kind: has)
    found = bench.measure_learner(TINY, lambda done: None)
    assert found["precision"] == precision
    assert found["updates_per_s"] == 1e3 / found["ms_per_update"]
    assert (bench.FLOAT32 in found["peers"]) == has


def test_the_whole_report_of_a_machine_without_the_peer(capsys, tmp_path, monkeypatch):
    ticks: list[dict[str, str]] = []
    monkeypatch.setattr(bench, "TRANSITIONS", 20)
    monkeypatch.setattr(bench, "make_sb3_model", Mock(side_effect=ImportError))
    monkeypatch.setattr(bench, "FULL", TINY)

    def nothing(self, batch, *_):
        return Losses(0.0, 0.0, 0.0, 0.0, np.ones(len(batch.indices)))

    monkeypatch.setattr(TD3Learner, "update", nothing)
    monkeypatch.setattr(bench.ProgressBar, "advance", lambda _, last: ticks.append(last))
    out = tmp_path / "b.json"
    status, table, _ = call(capsys, "bench", "--out", str(out))
    assert status == 0
    assert len(ticks) == TINY.ticks
    report = json.loads(out.read_text())
    assert {"machine", "threads", "torch", "source_revision"} <= set(report)
    assert report["learner_ms_per_update"] == report["learner"]["ms_per_update"] > 0
    assert set(report["environment_steps_per_s"]) == set(SCENARIOS)
    assert set(report["train_s_per_10k_steps"]) == {"total", *bench.PARTS}
    assert all(f"{name} with observation, steps/s" in table for name in SCENARIOS)
    assert "Stable-Baselines3 TD3 is not installed" in table
    bars = {line[4].split("  ")[0] for line in bench.rows(report) if len(line) > 4}
    assert bars == {""}


def test_figures_are_of_medians_and_the_table_says_which_bars_are_missed():
    times = {bench.OURS: [1.0, 20.0, 90.0], bench.SB3: [40.0, 110.0, 115.0]}
    learner = bench.figures(times, "ms_per_update", float)
    peers = {bench.SB3: {"ms_per_update": 110.0, "ratio": 5.5}}
    assert learner == {"ms_per_update": 20.0, "peers": peers}
    steps_per_s = bench.figures({bench.OURS: [0.001]}, "steps_per_s", lambda it: 1.0 / it)
    report = {
        "learner": {"batch_size": 128, **learner},
        "environment": {"left_turn": steps_per_s},
        "training": {"s_per_10k_steps": dict.fromkeys(("total", *bench.PARTS), 1.0)},
    }
    update, steps, *_ = bench.rows(report)
    assert update[1:] == ("20.0", "110.0  Stable-Baselines3 TD3", "5.50", "≥ 5  met")
    assert steps == ("left_turn with observation, steps/s", "1000.0")
    learner["peers"][bench.SB3]["ratio"] = 4.9
    assert next(bench.rows(report))[-1] == "≥ 5  MISSED"


def test_stable_baselines3_learns_from_our_experience_with_the_papers_networks():
    pytest.importorskip("stable_baselines3")
    model = bench.make_sb3_model(bench.gather(20))
    # Tables A2 and A3: 1,792 features through 256, 128 and 64; the critics also see the action.
    trunk = 6 * 2 * 36 + 6 + 16 * 6 * 36 + 16
    head = 1792 * 256 + 256 + 256 * 128 + 128 + 128 * 64 + 64 + 64 + 1
    assert sum(p.numel() for p in model.actor.parameters()) == trunk + head
    assert sum(p.numel() for p in model.critic.parameters()) == trunk + 2 * (head + 256)
    model.train(gradient_steps=2, batch_size=4)
    assert all(bool(p.isfinite().all()) for p in model.actor.parameters())
