"""The bench's arithmetic and its table."""

import numpy as np
import pytest

from hil_tests.bench_loop import compare, rows


def test_ratios_by_hand():
    floor = [np.arange(1.0, 101.0)] * 4
    result = compare([block * 1.2 for block in floor], floor)
    assert result["p50"]["floor"] == pytest.approx(50.5)
    for row in result.values():
        assert row["ratio"] == pytest.approx(1.2)
        assert row["interval"] == pytest.approx([1.2, 1.2])


def test_blocks_that_differ_widen_the_interval():
    generator = np.random.default_rng(0)
    floor = [generator.uniform(1, 2, 50) for _ in range(8)]
    ours = [block * factor for block, factor in zip(floor, np.linspace(1, 2, 8), strict=True)]
    low, high = compare(ours, floor)["p50"]["interval"]
    assert 1.0 < low < compare(ours, floor)["p50"]["ratio"] < high < 2.0


def test_blocks_come_in_pairs():
    with pytest.raises(ValueError, match="2 blocks of ours beside 1"):
        compare([np.ones(3)] * 2, [np.ones(3)])
    with pytest.raises(ValueError, match="0 blocks"):
        compare([], [])


def report(ratio=1.1, end_mb=100.0, idle=0.01, start_s=1.0, times=40.0):
    quantile = {"ours": 0.3, "floor": 0.25, "ratio": ratio, "interval": [ratio, ratio]}
    memory = {"start": 99.0, "end": end_mb, "steps": 1000, "grown_after_first_tenth": 0.0}
    return {
        "latency": {"latency_ms": {"p50": quantile}},
        "process": {
            "memory_mb": memory,
            "floor_memory_mb": memory,
            "idle_load": idle,
            "first_command_s": {"median": start_s, "starts": 5},
        },
        "lockstep": {"scenario": "left_turn", "times_real_time": times},
    }


def test_every_bar_is_met_or_missed_by_its_own_figure():
    met = [row[-1] for row in rows(report()) if row[-1]]
    assert len(met) == 6
    assert all(bar.endswith("met") for bar in met)
    for missed in (
        {"ratio": 1.26}, {"end_mb": 110.1}, {"idle": 0.021}, {"start_s": 1.6}, {"times": 29.0},
    ):  # fmt: skip
        bars = [row[-1] for row in rows(report(**missed))]
        assert sum(bar.endswith("MISSED") for bar in bars) == 1
