import math
from dataclasses import replace
from typing import Any

import pytest

from trainer.person.coach import Coach, SittingEpisode, advise

FINE = SittingEpisode(0, "goal", 0.0, 0)
ALONE_FAILED = SittingEpisode(0, "collision", 0.0, 0)
TOO_LATE = SittingEpisode(0, "collision", 0.5, 1, since_takeover_s=2.0)
IN_TIME = SittingEpisode(0, "collision", 3.0, 1, since_takeover_s=2.1)
RESTARTED = SittingEpisode(0, "restarted", 0.0, 0)


@pytest.mark.parametrize(
    ("episodes", "alone", "begins"),
    [
        ([], None, ""),
        ([FINE] * 10, 0.5, ""),
        ([ALONE_FAILED] * 10, 0.98, "The policy alone reaches 98%: you may stop"),
        ([ALONE_FAILED] * 10, 0.9, "The policy alone reaches 90%: watch only"),
        ([ALONE_FAILED, TOO_LATE, TOO_LATE, FINE], 0.89, "Take over earlier: 3 of the last 4"),
        ([ALONE_FAILED, TOO_LATE, FINE, FINE], None, ""),
        ([IN_TIME] * 9 + [RESTARTED], None, ""),
        ([RESTARTED] * 10, None, ""),
        ([replace(TOO_LATE, since_takeover_s=math.nan)] * 10, None, ""),
    ],
)
def test_the_first_rule_that_fits_is_the_advice(episodes, alone, begins):
    advice = advise(episodes, [] if alone is None else [(1.0, alone)])
    assert advice.startswith(begins) if begins else advice == ""


def test_what_is_shown_is_rounded_and_names_the_newest_validation():
    coach = Coach(learning=True)
    coach.curve += [(2.0, 0.4), (3.04, 0.5004)]
    shown: Any = coach.show({"human_s": 3.0, "takeovers": 1, "failures": 1})
    assert (shown.curve, shown.alone) == ([(2.0, 0.4), (3.0, 0.5)], "50%")
