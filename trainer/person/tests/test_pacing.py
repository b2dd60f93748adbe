"""The pace, on a clock that only moves when told to."""

from __future__ import annotations

import pytest

from trainer.person.pacing import Pacer


class Clock:
    """Moves when somebody sleeps or works."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def pass_s(self, seconds: float) -> None:
        self.now_s += seconds


def run(works_s: list[float]) -> tuple[list[float], int]:
    """When each period begins, from the first deadline on, and how many were late."""
    clock = Clock()
    pacer = Pacer(0.1, clock, clock.pass_s)
    began = []
    for work_s in works_s:
        clock.pass_s(work_s)
        pacer.wait()
        began.append(clock.now_s - 100.1)
    return began, pacer.late


def test_work_within_the_period_does_not_shift_it():
    began, late = run([0.0, 0.05, 0.09, 0.01])
    assert began == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert late == 0


def test_a_short_delay_is_counted_and_caught_up():
    began, late = run([0.0, 0.15, 0.0, 0.0])
    assert began == pytest.approx([0.0, 0.15, 0.2, 0.3])
    assert late == 1


def test_after_a_long_one_the_periods_begin_anew():
    began, late = run([0.0, 0.5, 0.0, 0.0])
    assert began == pytest.approx([0.0, 0.5, 0.6, 0.7])
    assert late == 1


def test_a_hair_is_not_late():
    began, late = run([0.0, 0.11, 0.0])
    assert began == pytest.approx([0.0, 0.11, 0.2])
    assert late == 0
