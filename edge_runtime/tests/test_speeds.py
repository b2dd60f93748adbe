import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.vehicles.speeds import Speeds

accelerations = st.floats(-5.0, 5.0)
periods = st.floats(0.005, 0.1)


def test_before_the_first_it_stands():
    speeds = Speeds()
    assert (speeds.newest_mps, speeds.stands, speeds.acceleration_mps2()) == (0.0, True, 0.0)


@given(accelerations, periods, st.integers(2, 60), st.floats(-1.0, 1.0))
def test_an_even_acceleration_is_found_at_any_rate(acceleration, period_s, count, start_mps):
    speeds = Speeds()
    for number in range(count):
        speeds.note(start_mps + acceleration * number * period_s, 100.0 + number * period_s)
    assert speeds.acceleration_mps2() == pytest.approx(acceleration, abs=1e-6)
    assert speeds.newest_mps == start_mps + acceleration * (count - 1) * period_s


@given(st.lists(st.floats(-10.0, 10.0), min_size=1), periods)
def test_what_is_older_than_a_control_period_counts_no_more(earlier, period_s):
    speeds = Speeds()
    for number, speed_mps in enumerate(earlier):
        speeds.note(speed_mps, number * period_s)
    later_s = len(earlier) * period_s + 0.2
    speeds.note(1.0, later_s)
    assert speeds.acceleration_mps2() == 0.0
    speeds.note(1.1, later_s + 0.1)
    assert speeds.acceleration_mps2() == pytest.approx(1.0)


def test_what_is_forgotten_is_as_before_the_first():
    speeds = Speeds()
    speeds.note(3.0, 0.0)
    assert not speeds.stands
    speeds.forget()
    assert (speeds.newest_mps, speeds.stands) == (0.0, True)


def test_two_reports_in_one_moment_are_no_acceleration():
    speeds = Speeds()
    speeds.note(1.0, 5.0)
    speeds.note(2.0, 5.0)
    assert speeds.acceleration_mps2() == 0.0
