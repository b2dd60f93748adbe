"""Intervals, tests and efficiency against numbers worked out by hand."""

import math

import numpy as np
import pytest

from trainer.experiments.statistics import (
    Estimate,
    above,
    all_of,
    efficiency,
    episodes_to_reach,
    final_average,
    mean_estimate,
    paired_t,
    smoothed,
    stars,
    success_estimate,
)


def test_the_mean_has_students_interval():
    # s = 1, so s / sqrt(3) = 0.57735; t(0.975, 2) = 4.30265.
    found = mean_estimate([1.0, 2.0, 3.0])
    assert found.value == 2.0
    assert found.high - 2.0 == pytest.approx(4.30265 * 0.57735, abs=1e-4)
    assert found.low == pytest.approx(4.0 - found.high)
    assert found.size == 3


@pytest.mark.parametrize("values", [[], [5.0]])
def test_too_few_values_have_no_interval(values):
    found = mean_estimate(values)
    assert (found.low, found.high) == (-math.inf, math.inf)
    assert above(found, -1e9) == "undecided"
    assert "[" not in found.text()


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    # (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n) with z = 1.95996
    [(50, 50, 0.92865, 1.0), (0, 50, 0.0, 0.07135), (5, 10, 0.23659, 0.76341)],
)
def test_success_has_wilsons_interval(successes, count, low, high):
    found = success_estimate(successes, count)
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-5)
    assert found.value == successes / count


def test_the_paired_t_test():
    # Differences 1, 2, 3: t = 2 / 0.57735 = 3.4641, two-sided p with 2 degrees of freedom 0.07418.
    first, second = np.array([2.0, 4.0, 6.0]), np.array([1.0, 2.0, 3.0])
    assert paired_t(first, second) == pytest.approx(0.07418, abs=1e-5)
    assert paired_t(first, first) == 1.0
    assert paired_t(first, first - 1.0) == 0.0
    assert paired_t(first[:1], second[:1]) == 1.0


@pytest.mark.parametrize(
    ("p_value", "mark"), [(0.0005, "***"), (0.005, "**"), (0.02, "*"), (0.05, "n.s."), (1, "n.s.")]
)
def test_stars(p_value, mark):
    assert stars(p_value) == mark


def test_what_an_interval_decides():
    assert above(Estimate(2.0, 1.0, 3.0, 3), 0.9) == "yes"
    assert above(Estimate(2.0, 1.0, 3.0, 3), 1.5) == "undecided"
    assert above(Estimate(2.0, 1.0, 3.0, 3), 3.1) == "no"
    assert all_of(["yes", "yes"]) == "yes"
    assert all_of(["yes", "undecided"]) == "undecided"
    assert all_of(["undecided", "no"]) == "no"
    assert all_of([]) == "undecided"


def test_reaching_counts_from_the_first_whole_average_on():
    curve = np.concatenate([np.full(10, 9.0), np.arange(40.0)])
    assert episodes_to_reach(curve, 9.0) == 20  # 9.0 at first, by luck; at episode 20 again
    assert episodes_to_reach(curve, 30.0) == 41
    assert episodes_to_reach(curve, 99.0) == math.inf


def test_final_average_and_smoothing_are_over_twenty_episodes():
    curve = np.arange(100.0)
    assert final_average(curve) == 89.5
    both = smoothed([curve, np.concatenate([curve, [0.0]])])
    assert both.shape == (2, 100)
    assert both[0, -1] == 89.5
    assert both[0, 0] == 0.0


def ramp(length: int, seeds: int = 3) -> np.ndarray:
    """Rises from 0 to 1 in ``length`` of 200 episodes, in every seed alike."""
    return np.tile(np.minimum(np.arange(1, 201) / length, 1.0), (seeds, 1))


def test_efficiency_is_a_ratio_of_episodes():
    found = efficiency(ramp(25), ramp(175))
    assert (found.episodes, found.baseline_episodes) == (25.0, 175.0)
    assert found.ratio.value == 7.0
    assert (found.ratio.low, found.ratio.high) == (7.0, 7.0)  # seeds that are all alike


def test_efficiency_of_one_that_never_gets_there_is_nothing():
    found = efficiency(0.5 * ramp(25), ramp(100))
    assert found.ratio.value == 0.0
    assert efficiency(0.5 * ramp(25), ramp(100), common=True).ratio.value == 2.0


def test_efficiency_of_one_seed_has_no_interval():
    ratio = efficiency(ramp(25, 1), ramp(100)).ratio
    assert ratio.value == 4.0
    assert above(ratio) == "undecided"


def test_the_bootstrap_shows_the_spread_of_the_seeds():
    mixed = np.concatenate([ramp(25, 1), ramp(50, 1), ramp(100, 1)])
    ratio = efficiency(mixed, ramp(100)).ratio
    assert ratio.low == 1.0
    assert ratio.high == 4.0
