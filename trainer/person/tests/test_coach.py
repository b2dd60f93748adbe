import math
from dataclasses import replace
from typing import Any

import pytest

from trainer.person.coach import Coach, SittingEpisode, advise

FINE = SittingEpisode(0, "goal", 0.0, 0)
HELPED = SittingEpisode(0, "goal", 2.0, 1, since_takeover_s=3.0)
ALONE_FAILED = SittingEpisode(0, "collision", 0.0, 0)
TOO_LATE = SittingEpisode(0, "collision", 0.5, 1, since_takeover_s=2.0)
IN_TIME = SittingEpisode(0, "collision", 3.0, 1, since_takeover_s=2.1)
RESTARTED = SittingEpisode(0, "restarted", 0.0, 0)
ALL, NONE = dict.fromkeys(range(10), True), dict.fromkeys(range(10), False)


@pytest.mark.parametrize(
    ("episodes", "alone", "mastered", "begins"),
    [
        ([], None, {}, ""),
        ([FINE] * 10, 0.5, ALL, ""),
        ([ALONE_FAILED] * 10, 0.98, {}, "The policy alone reaches 98%: you may stop"),
        ([ALONE_FAILED] * 10, 0.9, {}, "The policy alone reaches 90%: watch only"),
        ([ALONE_FAILED, TOO_LATE, TOO_LATE, FINE], 0.89, {}, "Take over earlier: 3 of the last 4"),
        ([ALONE_FAILED, TOO_LATE, FINE, FINE], None, {}, ""),
        ([IN_TIME] * 9 + [RESTARTED], None, {}, ""),
        ([RESTARTED] * 10, None, {}, ""),
        ([replace(TOO_LATE, since_takeover_s=math.nan)] * 10, None, {}, ""),
        ([HELPED] * 3, 0.6, ALL, "Let it go on for longer: alone, it masters 3 of the last 3"),
        ([HELPED] * 2, 0.6, ALL, ""),
        ([HELPED] * 6, 0.6, {**ALL, 4: False, 5: False}, "Let it go on for longer: alone, it mas"),
        ([HELPED] * 6, 0.6, {**ALL, 3: False, 4: False, 5: False}, ""),
        ([HELPED] * 6, 0.6, NONE, ""),
        ([HELPED] * 6 + [FINE] * 4, 0.6, {n: n < 3 or n > 5 for n in range(10)}, ""),
        ([HELPED] * 3 + [ALONE_FAILED] * 3, 0.6, ALL, "Take over earlier"),
    ],
)
def test_the_first_rule_that_fits_is_the_advice(episodes, alone, mastered, begins):
    numbered = [replace(one, number=number) for number, one in enumerate(episodes)]
    advice = advise(numbered, alone, mastered)
    assert advice.startswith(begins) if begins else advice == ""


def test_a_run_that_goes_on_is_remembered():
    coach = Coach(learning=True)
    names = ("episode", "outcome", "human_steps", "interventions", "validation_success")
    rows = [("0", "goal", "20", "1", "nan"), ("1", "collision", "0", "0", "0.4")]
    coach.recall([dict(zip(names, row, strict=True)) for row in rows], period_s=0.1)
    cost = {"human_s": 3.0, "takeovers": 1, "failures": 1}
    shown: Any = coach.show(cost)
    assert (shown.curve, shown.alone) == ([(2.0, 0.4)], "40%")
    assert [one.outcome for one in shown.episodes] == ["goal", "collision"]
    assert coach.to_check() == [0]
    coach.take(3.04, 0.5004, {})
    shown = coach.show(cost)
    assert shown.curve == [(2.0, 0.4), (3.0, 0.5)]


def test_whoever_only_drives_sees_episodes_and_no_advice():
    coach, cost = Coach(), {"human_s": 0.0, "takeovers": 0, "failures": 0}
    assert coach.show(cost) is None
    coach.episodes.extend([ALONE_FAILED] * 20)
    shown: Any = coach.show(cost)
    assert (shown.advice, shown.alone, len(shown.episodes)) == ("", "", 10)
