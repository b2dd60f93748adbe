"""Intervals, tests and efficiency against numbers worked out by hand."""

import math

import numpy as np
import pytest

from trainer.experiments.statistics import (
    Estimate,
    above,
    all_of,
    judge_all,
    mean_estimate,
    paired_t,
    smoothed,
    stars,
    success_estimate,
    within,
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


def test_within_is_decided_by_the_whole_interval():
    assert within(Estimate(0.0, -1.0, 2.0, 3), 2.0) == "yes"
    assert within(Estimate(0.0, -1.0, 2.0, 3), 1.5) == "undecided"
    assert within(Estimate(2.0, 1.6, 2.4, 3), 1.5) == "no"
    assert within(Estimate(-2.0, -2.4, -1.6, 3), 1.5) == "no"


AHEAD = Estimate(1.0, 0.5, 1.5, 3)
WIDE, OPEN, BEHIND = (
    Estimate(20.0, -9.0, 50.0, 3), Estimate(-0.1, -0.4, 0.2, 3), Estimate(-1.0, -1.5, -0.5, 2)
)  # fmt: skip


@pytest.mark.parametrize(
    ("differences", "holds", "size", "decisive", "rival"),
    [
        ([AHEAD, Estimate(9.0, 0.1, 18.0, 2)], "yes", 2, Estimate(9.0, 0.1, 18.0, 2), "b"),
        ([AHEAD, WIDE, OPEN], "undecided", 3, OPEN, "c"),
        # Who says no decides, whatever is known of the others.
        ([AHEAD, OPEN, BEHIND, Estimate(5.0, -math.inf, math.inf, 1)], "no", 2, BEHIND, "c"),
        ([AHEAD, mean_estimate([])], "undecided", 0, None, ""),
        ([], "undecided", 0, None, ""),
    ],
)
def test_who_decides_a_comparison_with_all(differences, holds, size, decisive, rival):
    named = dict(zip("abcd", differences, strict=False))
    assert judge_all(named) == (holds, size, decisive, rival)
    opposites = {name: each.times(-1.0) for name, each in named.items()}
    mirrored = judge_all(opposites, sign=-1.0)
    assert mirrored == (holds, size, decisive.times(-1.0) if decisive else None, rival)


def test_an_interval_may_be_open_at_one_end():
    assert Estimate(2.0, 1.0, math.inf, 3).text(1) == "2.0 [1.0, ∞]"


def test_smoothing_is_over_twenty_episodes():
    curve = np.arange(100.0)
    both = smoothed(np.stack([curve, curve[::-1]]))
    assert both.shape == (2, 100)
    assert (both[0, 0], both[0, -1], both[1, -1]) == (0.0, 89.5, 9.5)
