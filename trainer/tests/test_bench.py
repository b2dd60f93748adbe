import json
import sys

import pytest

from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import call
from trainer import bench
from trainer.learner.config import LearnerConfig
from trainer.scenarios import SCENARIOS
from trainer.tests.learners import on_a_gpu
from trainer.training.config import RunConfig


def test_the_report_holds_the_three_figures_and_their_parts(capsys, tmp_path, monkeypatch):
    for name, small in {"ROUNDS": 2, "UPDATES": 1, "STEPS": 10}.items():
        monkeypatch.setattr(bench, name, small)
    whole = bench.measure
    monkeypatch.setattr(bench, "measure", lambda device: whole(device, batch_size=4))
    out = tmp_path / "b.json"
    status, said, _ = call(capsys, "bench", "--threads", "1", "--out", str(out))
    assert status == 0
    report = json.loads(out.read_text())
    assert {"machine", "torch", "source_revision"} <= set(report)
    assert (report["threads"], report["learner_ms_per_update"] > 0) == (1, True)
    assert set(report["environment_steps_per_s"]) == set(SCENARIOS)
    parts = report["train_s_per_10k_steps"]
    assert set(parts) == {"total", *bench.PARTS}
    assert 0 < parts["environment"] < parts["total"]
    assert json.loads(said) == report


@on_a_gpu
def test_a_gpus_report_has_the_other_library_and_the_floor(monkeypatch):
    for name, small in {"ROUNDS": 2, "UPDATES": 1, "STEPS": 10}.items():
        monkeypatch.setattr(bench, name, small)
    found = bench.measure("cuda", batch_size=16)["on_gpu"]
    assert 0.0 < found["ms_per_replay"] < found["ms_per_update"]
    assert found["ms_per_step_of_sb3"] > 0.0


def test_the_other_library_drives_and_learns():
    config = RunConfig(learner=LearnerConfig(batch_size=4))
    model = bench.stable_baselines3(config)
    model.train(1, 4)
    assert model.num_timesteps == 8


def test_without_the_other_library_nothing_is_measured(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(UserError):
        bench.measure("cuda", batch_size=4)
