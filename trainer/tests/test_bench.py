import json

from hil_tests.tests.shared.commands import call
from trainer import bench
from trainer.scenarios import SCENARIOS


def test_the_report_holds_the_three_figures_and_their_parts(capsys, tmp_path, monkeypatch):
    for name, small in {"ROUNDS": 2, "UPDATES": 1, "STEPS": 10}.items():
        monkeypatch.setattr(bench, name, small)
    whole = bench.measure
    monkeypatch.setattr(bench, "measure", lambda: whole(batch_size=4))
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
