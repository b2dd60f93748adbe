"""Progress and learning efficiency against curves whose answer is known."""

import math

import numpy as np
import pytest

from trainer.experiments.efficiency import efficiency, episodes_to_reach
from trainer.experiments.outcome import Outcome
from trainer.experiments.progress import ALONE, Progress, final, progress
from trainer.experiments.statistics import above
from trainer.experiments.units import Unit


def outcome(metric: str, values, seed: int = 1) -> Outcome:
    return Outcome(Unit("left_turn", "phil_td3", "normal", seed), {metric: np.array(values)}, {})


def validated(*values: float, every: int = 10) -> Outcome:
    """Each after so many episodes."""
    rows = np.full(every * len(values), np.nan)
    rows[every - 1 :: every] = values
    return outcome(ALONE, rows)


def made(*outcomes: Outcome) -> Progress:
    (metric,) = outcomes[0].metrics
    found = progress(outcomes, metric)
    assert found is not None
    return found


def ramp(length: int, height: float = 1.0, seeds: int = 3) -> Progress:
    """Rises from 0 in ``length`` of 200 episodes, in every seed alike; as it was measured."""
    curve = height * np.minimum(np.arange(1, 201) / length, 1.0)
    return Progress(
        np.arange(200) + 1, np.tile(curve, (seeds, 1)), np.ones(200, bool), np.full(seeds, height)
    )


def test_in_training_curves_are_averages_and_reaching_counts_from_the_first_whole_one_on():
    found = made(outcome("episode_return", np.concatenate([np.full(10, 9.0), np.arange(40.0)])))
    assert found.episodes.tolist() == list(range(1, 51))
    assert np.flatnonzero(found.whole)[0] + 1 == 20
    assert found.curves[0, 0] == 9.0  # by luck
    assert episodes_to_reach(found, found.curves[0], 9.0) == (28, 29)  # (9 + ... of twenty)
    # An average of twenty cannot say in which of them it was: perhaps from the first one on.
    assert episodes_to_reach(found, found.curves[0], 0.0) == (0, 20)
    assert episodes_to_reach(found, found.curves[0], 99.0) == (50, math.inf)
    assert found.ends.tolist() == [29.5]


def test_what_was_validated_now_and_then_is_taken_where_it_was_measured():
    found = made(validated(0.0, 5.0, 7.0, 8.0), validated(2.0, 7.0, 9.0, 6.0, 1.0))
    assert found.episodes.tolist() == [10, 20, 30, 40]
    assert found.curves.mean(axis=0).tolist() == [1.0, 6.0, 8.0, 7.0]
    assert episodes_to_reach(found, found.curves.mean(axis=0), 6.0) == (10, 20)
    # Two validations are within the last twenty episodes.
    assert found.ends.tolist() == [7.5, 3.5]


def test_how_fast_the_goal_is_crossed_makes_no_difference():
    own, other = (
        made(outcome("distance_m", np.array(metres)))
        for metres in ([21.1, 21.2, 21.3], [21.4, 21.4, 21.4])
    )
    assert efficiency(own, other).ratio.value == 1.0
    assert own.ends.tolist() == [21.0]


def test_a_single_validation_is_an_end():
    assert final(validated(4.0), ALONE) == 4.0
    assert progress([], ALONE) is None


def test_a_step_at_ten_against_one_at_seventy_is_seven_times():
    soon, late = (validated(*(20.0 * (n >= step) for n in range(1, 21))) for step in (1, 7))
    found = efficiency(made(soon, soon), made(late, late))
    assert (found.episodes, found.baseline_episodes) == (10.0, 70.0)
    # The first one may have been there after its first episode.
    assert found.ratio[:3] == (7.0, 6.0, math.inf)


def test_what_lies_between_two_validations_is_in_the_interval():
    """Reached within episodes 11 to 20 and 21 to 30: from as soon to three times as soon."""
    soon, late = (validated(*(20.0 * (n >= step) for n in range(1, 11))) for step in (2, 3))
    found = efficiency(made(soon, soon), made(late, late))
    assert found.ratio[:3] == (1.5, 1.0, 3.0)


def test_two_who_are_there_at_the_first_validation_cannot_be_told_apart():
    own = made(*[validated(21.0, 21.0, 21.0)] * 3)
    found = efficiency(own, own)
    assert (found.episodes, found.baseline_episodes) == (10, 10)
    assert found.ratio[:3] == (1.0, 0.0, math.inf)
    assert above(found.ratio, 2.2) == "undecided"


def test_two_who_arrive_in_every_training_episode_cannot_be_told_apart():
    own = made(*[outcome("distance_m", np.full(50, 21.0))] * 3)
    found = efficiency(own, own)
    assert found.ratio[:3] == (1.0, 0.0, math.inf)
    assert above(found.ratio, 2.2) == "undecided"


def test_one_that_never_gets_there_has_the_ratio_nothing():
    assert efficiency(ramp(25, 0.5), ramp(100)).ratio.value == 0.0
    # On the common level, which both reach, it is twice as soon.
    assert efficiency(ramp(25, 0.5), ramp(100), common=True).ratio.value == 2.0


def test_one_seed_has_no_interval():
    ratio = efficiency(ramp(25, seeds=1), ramp(100)).ratio
    assert ratio.value == 4.0
    assert above(ratio) == "undecided"


def test_the_bootstrap_shows_the_spread_of_the_seeds():
    curves = np.concatenate([ramp(length, seeds=1).curves for length in (25, 50, 100)])
    ratio = efficiency(ramp(25)._replace(curves=curves), ramp(100)).ratio
    assert (ratio.low, ratio.high) == (99 / 100, 100 / 24)  # each to the episode


@pytest.mark.parametrize("metric", ["distance_m", ALONE])
def test_who_is_compared_with_itself_is_as_soon(metric):
    values = np.random.default_rng(0).random((3, 60))
    own = made(*(outcome(metric, row, seed) for seed, row in enumerate(values)))
    assert efficiency(own, own).ratio.value == 1.0
