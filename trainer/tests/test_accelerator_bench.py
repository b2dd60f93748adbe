import math

import pytest
import torch

from edge_runtime.cli import run_cli
from edge_runtime.errors import UserError
from trainer.benches.accelerator import WatchedRun, main, measure_runs, seconds


def test_seconds_are_from_the_start_and_the_pace_from_behind_the_warmup():
    looks = [(5.0, 100), (6.0, 300), (8.0, 5300), (10.0, 10300), (11.0, 12300)]
    figures = seconds(looks, steps=10_000, warmup_steps=256)
    assert figures["whole_s"] == 10.0
    assert figures["s_per_10k_steps"] == pytest.approx(10_000 * (11 - 6) / 12_000)
    assert math.isnan(seconds(looks[:2], 300, 256)["s_per_10k_steps"])


def test_real_runs_are_watched_and_ended():
    measured = measure_runs(runs=2, device="cpu", steps=1)
    assert [figures["whole_s"] > 0 for figures in measured["each"]] == [True, True]
    assert measured["slowest"]["whole_s"] == max(f["whole_s"] for f in measured["each"])


def test_a_run_that_cannot_start_is_one_clear_line(tmp_path):
    run = WatchedRun(0, tmp_path, "no-such-device")
    run.process.wait(60)
    with pytest.raises(UserError, match=r"ended early: .*no-such-device"):
        run.look()
    run.stop()


@pytest.mark.skipif(torch.cuda.is_available(), reason="would measure for minutes")
def test_without_a_gpu_there_is_one_clear_line(capsys, tmp_path):
    assert run_cli(main, ["--runs", "2", "--out", str(tmp_path / "f.json")]) == 2
    assert capsys.readouterr().err == (
        "error: no CUDA device is available: there is nothing to measure here\n"
    )
    assert not (tmp_path / "f.json").exists()
