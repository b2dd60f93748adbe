"""Two real faults (all: `hil_tests campaign --only faults`), and what the verdicts rest on."""

import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import MagicMock, Mock, patch

import msgspec
import pytest

from edge_runtime.util import UserError
from hil_tests.campaign import choose, render_faults
from hil_tests.faults import hunter, observe
from hil_tests.faults.rig import ChassisProcess, Rig, Truth
from hil_tests.faults.run import Outcome, report_row, run_faults, run_row
from hil_tests.faults.table import ROWS, Row, Try
from hil_tests.mock_hunter import FAULTS
from hil_tests.testing.policies import TASK

PLACE = ("session", 0, 7)
STATES = {PLACE: 10.0}
ROW = Row("name", "done", "expected", "measured", lambda rig, number: Try())


def command(**changes):
    fields = {"seen_s": 10.002, "sent_s": 10.001, "place": PLACE, "mode": "drive", "action": [0.5]}
    return observe.CommandSeen(**{**fields, "reason": "", **changes})


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"action": [1.01]}, "action"),
        ({"action": [0.5, 0.5]}, "action"),
        ({"action": [float("nan")]}, "action"),
        ({"place": ("session", 0, 8)}, "no acceptable state"),
        ({"sent_s": 10.001 + observe.REACTION_LIMIT_S, "seen_s": 11.0}, "old"),
    ],
)
def test_each_way_to_be_unsafe_is_found(changes, why):
    (found,) = observe.unsafe_commands([command(**changes)], STATES)
    assert why in found
    assert observe.unsafe_commands([command(mode="safe_stop", **changes)], STATES) == []
    in_time = [command(), command(sent_s=10.0 + observe.REACTION_LIMIT_S, seen_s=11.0)]
    assert observe.unsafe_commands(in_time, STATES) == []
    assert observe.unsafe_commands([command(sent_s=3610.0)], STATES) == []  # a stepped clock


def test_safe_stops_at_the_pace_of_drives_are_no_drive():
    stop = command(mode="safe_stop", reason="no_fresh_state")
    stops = [stop._replace(seen_s=10.0 + 0.1 * number) for number in range(5)]
    assert observe.longest_gap_s((c.seen_s for c in stops), 10.0, 10.4) < observe.REACTION_LIMIT_S
    assert observe.stops_between([command(), *stops], 9.9, 10.5) == ["safe stop: no_fresh_state"]
    assert observe.stops_between([command()], 9.9, 10.5) == []
    assert observe.stops_between(stops, 10.5, 11.0) == []
    # Gaps count the edges of the window.
    assert observe.longest_gap_s([1.0, 1.1, 1.5, 9.0], 0.9, 1.6) == pytest.approx(0.4)
    assert observe.longest_gap_s([], 2.0, 5.0) == pytest.approx(3.0)


def test_a_rig_that_cannot_start_leaves_no_process(tmp_path, monkeypatch):
    started = []

    def no_edge(rig):
        started.append(rig.simulator)
        raise UserError("no edge runtime today")

    monkeypatch.setattr(Rig, "start_edge", no_edge)
    with pytest.raises(UserError, match="today"):
        Rig((), tmp_path)
    assert [process.has_ended for process in started] == [True]


def run_with(rig, tries=1):
    """Run a row that does nothing, with a rig that is not real."""
    with patch("hil_tests.faults.run.Rig", rig), TemporaryDirectory() as folder:
        return run_row(ROW, (), TASK, Path(folder), tries, lambda name: None, threading.Event())


def test_a_rig_that_fails_is_a_failed_try_and_ends_no_campaign():
    assert run_with(Mock(side_effect=UserError("no multicast")), 3).failures == [
        "try 0: no multicast"
    ]
    gone = MagicMock(crashes=[], timeline=observe.DriveTimeline())
    gone.__enter__.return_value = gone
    gone.wait_until_driving.side_effect = BrokenPipeError("the chassis is gone")
    found = run_with(Mock(return_value=gone), 2)
    assert found.failures == [f"try {number}: the chassis is gone" for number in range(2)]


def judged(*tries, **outcome):
    return report_row(ROW, Outcome(tries=list(tries), **outcome))


def test_a_row_passes_only_within_its_limits_and_a_slower_policy_has_more_time():
    assert judged(Try(0.25, 1.0))["passed"]
    slow, late = judged(Try(0.251, 0.5)), judged(Try(0.2, 1.001))
    assert (slow["reactions_late"], late["recoveries_late"]) == (1, 1)
    for bad in (
        slow, late, judged(Try(0.2, 0.5, wrong=["drove on"])),
        judged(Try(0.2, 0.5), unsafe=["late"]), judged(Try(0.2, 0.5), crashes=["edge"]),
        judged(failures=["try 0: nothing"]),
    ):  # fmt: skip
        assert not bad["passed"]
    later_s = observe.later_s(msgspec.structs.replace(TASK, control_period_s=0.3))
    for reaction_s, recovery_s, is_met in ((0.649, 1.999, True), (0.651, 2.001, False)):
        found = report_row(ROW, Outcome(tries=[Try(reaction_s, recovery_s)]), later_s)
        assert found["passed"] == is_met


def test_rows_are_chosen_once_by_names_of_their_own_and_in_the_tables_order():
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names)
    assert f"{len(names)} faults" in (Path(__file__).parents[2] / "README.md").read_text()
    with pytest.raises(UserError, match=r"'meteor_\*'; choose from .*edge_killed"):
        choose("meteor_*", None)
    hunters = {name for name in names if name.startswith("hunter_")}
    assert hunters == {f"hunter_{name}" for name in FAULTS}
    axes, rows = choose("vehicle_s*,vehicle_stuck,edge_killed,delay", None)
    assert [axis.name for axis in axes] == ["delay"]
    wanted = ["edge_killed", "vehicle_silent", "vehicle_stuck", "vehicle_self_braking"]
    assert [row.name for row in rows] == wanted


@pytest.mark.parametrize(
    ("name", "reason"), [("edge_killed", "no_command"), ("hunter_bus_off", "vehicle_fault")]
)
def test_a_real_fault_stops_it_and_it_drives_on_when_it_may(name, reason):
    """Off the bus for over 500 ms the chassis stands by, and takes control again when frames come
    back: the very thing that our own latch is for."""
    progress: list[str] = []
    report = run_faults(choose(name, "faults")[1], 1, on_try=progress.append)
    (row,) = report["rows"]
    assert (row["wrong"], row["unsafe"], row["crashes"]) == ([], [], [])
    assert row["reasons"] == {reason: 1}
    # Measured, and not before its time; how fast it is is the campaign's business.
    assert row["reaction_ms"]["min"] > 100.0
    assert row["recovery_ms"]["min"] > 0.0
    if name == "hunter_bus_off":
        assert row["figures"]["stands, ms"] > 500.0  # by the chassis's own time-out
    assert progress == [name]
    assert row["done"] in render_faults(report)


FAST = bytes.fromhex("03 E8 00 00 00 00 00 00")


@pytest.fixture
def monitor(request):
    one = observe.CanMonitor(f"virtual:{request.node.name}")
    yield one
    one.close()


def asked(*frames):
    return [observe.BusFrame(seen_s, 0x111, data) for seen_s, data in frames]


def test_frames_and_speeds_that_should_never_be_are_found(monitor):
    monitor.heard += asked((1.0, FAST))
    assert hunter._kept_to_its_own(monitor) == []
    monitor.heard += asked((1.0, bytes.fromhex("06 40 00 00 00 00 00 00")))  # 1.6 m/s
    monitor.strange.append(observe.BusFrame(1.0, 0x7DF, b""))
    assert hunter._kept_to_its_own(monitor) == ["0x7df was on the bus", "asked for 1.60 m/s"]


@pytest.mark.parametrize(
    ("truth", "moved"),
    [
        ([(0.0, True)], True),  # since before
        ([(0.0, True), (1.0, False)], False),
        ([(0.0, False), (1.5, True), (1.51, False)], True),  # a jerk
    ],
)
def test_any_movement_in_between_is_found(truth, moved):
    chassis = ChassisProcess.__new__(ChassisProcess)
    chassis.truth = [Truth(*each) for each in truth]
    assert chassis.moved_between(1.0, 2.0) == moved
