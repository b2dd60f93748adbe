"""Claims about poor guidance against made-up drives whose answer is known."""

from dataclasses import replace

import numpy as np

from trainer.experiments.catalogue import EXPERIMENTS
from trainer.experiments.outcome import Drives
from trainer.tests.synthetic import gathered

SEEDS = 3


def test_poor_guidance_is_a_change_of_the_mean_distance():
    units = EXPERIMENTS["fig14"].units(SEEDS)
    made = gathered(units, SEEDS)
    for unit, outcome in made.found.items():
        scale = 0.9 + 0.001 * unit.seed if unit.setting == "poor" else 1.0
        tests = {
            name: Drives({**drives.columns, "distance_m": np.full(50, 20.0 * scale)})
            for name, drives in outcome.tests.items()
        }
        made.found[unit] = replace(outcome, tests=tests)
    phil, each, ia, hi, *robust = EXPERIMENTS["fig14"].judge(made)
    assert [one.holds for one in (phil, each, ia, hi)] == ["no", "no", "yes", "no"]
    assert [one.holds for one in robust] == ["undecided"] * 2
    assert "-9.8 [-10.0, -9.6] %" in phil.ours
    assert each.ours.count("-9.8 [-10.0, -9.6] %") == 6


def test_poor_guidance_that_two_scenes_take_two_ways_is_no_even_share():
    units = EXPERIMENTS["fig14"].units(SEEDS)
    made = gathered(units, SEEDS)
    for unit, outcome in made.found.items():
        poor = unit.setting == "poor"
        tests = {
            name: Drives(
                {**drives.columns, "distance_m": np.full(50, 15.0 + poor * (name == "variant"))}
            )
            for name, drives in outcome.tests.items()
        }
        made.found[unit] = replace(outcome, tests=tests)
    phil, each, *_ = EXPERIMENTS["fig14"].judge(made)
    assert (phil.holds, each.holds) == ("yes", "no")
    assert "L 0.0 [0.0, 0.0] %, L-N 0.0 [0.0, 0.0] %, L-V 6.7 [6.7, 6.7] %" in each.ours


def test_poor_guidance_counts_nothing_beyond_the_goal():
    made = gathered(EXPERIMENTS["fig14"].units(SEEDS), SEEDS)
    for unit, outcome in made.found.items():
        distance_m = 500.0 if unit.setting == "poor" else 100.0
        tests = {
            name: Drives({**drives.columns, "distance_m": np.full(50, distance_m)})
            for name, drives in outcome.tests.items()
        }
        made.found[unit] = replace(outcome, tests=tests)
    phil, each, *_ = EXPERIMENTS["fig14"].judge(made)
    assert "0.0 [0.0, 0.0] %" in phil.ours
    assert (each.holds, each.seeds) == ("yes", 3)
