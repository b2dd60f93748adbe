"""The faults of a Hunter: one with all its processes, and what the rows' verdicts rest on."""

import fnmatch
import itertools

import pytest

from hil_tests.faults import hunter, run_faults
from hil_tests.faults.can_ears import CanEars, Heard
from hil_tests.faults.chassis import ChassisProcess, Truth
from hil_tests.faults.table import ROWS
from hil_tests.mock_hunter.faults import FAULTS

FAST = bytes.fromhex("03 E8 00 00 00 00 00 00")
_buses = itertools.count()


def test_off_the_bus_it_stops_does_not_resume_by_itself_and_drives_once_rearmed():
    """Off for longer than 500 ms the chassis stands by, and takes control again when frames come
    back: the very thing that our own latch is for."""
    report = run_faults(1, ["hunter_bus_off"])
    (row,) = report["rows"]
    assert (row["wrong"], row["unsafe"], row["crashes"]) == ([], [], [])
    assert row["reasons"] == {"vehicle_fault": 1}
    assert row["reaction_ms"]["min"] > 100.0  # measured, and not before its time
    assert row["figures"]["stands, ms"] > 500.0  # by the chassis's own time-out: it hears nothing


def test_every_fault_of_the_mock_has_a_row():
    names = {row.name for row in ROWS if fnmatch.fnmatch(row.name, "hunter_*")}
    assert names == {f"hunter_{name}" for name in FAULTS}


@pytest.fixture
def ears():
    one = CanEars(f"virtual:ears{next(_buses)}", (0x111, 0x221))
    yield one
    one.close()


def asked(*frames):
    return [Heard(seen_s, 0x111, data) for seen_s, data in frames]


def test_the_set_point_counts_from_where_it_stays_zero(ears):
    stop = bytes(8)
    ears.heard += asked((1.0, FAST), (1.1, stop), (1.2, FAST), (1.3, stop), (1.4, stop))
    assert hunter._told_s(ears, 0.9, 2.0) == 1.3
    ears.heard += asked((1.5, FAST))
    assert hunter._told_s(ears, 0.9, 2.0) == 2.0  # it never was for good
    assert hunter._told_s(ears, 0.9, 1.45) == 1.3


def test_frames_and_speeds_that_should_never_be_are_found(ears):
    ears.heard += asked((1.0, FAST))
    assert hunter._kept_to_its_own(ears) == []
    ears.heard += asked((1.0, bytes.fromhex("06 40 00 00 00 00 00 00")))  # 1.6 m/s
    ears.strange.append(Heard(1.0, 0x7DF, b""))
    assert hunter._kept_to_its_own(ears) == ["0x7df was on the bus", "asked for 1.60 m/s"]


def test_the_speed_of_a_frame_has_a_sign():
    assert hunter.speed_mps(Heard(0.0, 0x221, FAST)) == pytest.approx(1.0)
    backwards = bytes.fromhex("FF 6A 00 00 00 00 00 00")
    assert hunter.speed_mps(Heard(0.0, 0x221, backwards)) == pytest.approx(-0.15)


def moved_between(truth, begin_s, end_s):
    chassis = ChassisProcess.__new__(ChassisProcess)
    chassis.truth = [Truth(since_s, "can", "ok", moves) for since_s, moves in truth]
    return chassis.moved_between(begin_s, end_s)


@pytest.mark.parametrize(
    ("truth", "moved"),
    [
        ([(0.0, True)], True),  # since before
        ([(0.0, True), (1.0, False)], False),
        ([(0.0, False), (1.5, True), (1.51, False)], True),  # a jerk
        ([(0.0, False), (2.5, True)], False),  # afterwards
    ],
)
def test_any_movement_in_between_is_found(truth, moved):
    assert moved_between(truth, 1.0, 2.0) == moved
