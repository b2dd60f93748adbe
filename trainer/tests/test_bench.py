import json
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
    assert len(ticks) == 7
    report = json.loads(out.read_text())
    assert {"machine", "threads", "torch", "source_revision"} <= set(report)
    assert report["learner_ms_per_update"] == report["learner"]["ms_per_update"] > 0
    assert set(report["environment_steps_per_s"]) == set(SCENARIOS)
    assert set(report["train_s_per_10k_steps"]) == {"total", *bench.PARTS}
    assert all(f"{name} with observation, steps/s" in table for name in SCENARIOS)
    assert "Stable-Baselines3 TD3 is not installed" in table
    bars = {line[4].split("  ")[0] for line in bench.rows(report) if len(line) > 4}
    assert bars == {""}


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
