"""Two real faults (all: `hil_tests campaign --only faults`), and what the verdicts rest on."""

from pathlib import Path
from unittest.mock import MagicMock

import msgspec
import pytest

from edge_runtime.util import UserError
from hil_tests.campaign import choose, render_faults
from hil_tests.faults import hunter, observe
from hil_tests.faults.observe import REACTION_LIMIT_S, DriveTimeline
from hil_tests.faults.rig import Chassis
from hil_tests.faults.rows import Row, Try
from hil_tests.faults.run import ROWS, Outcome, report_row, run_faults, use_rig
from hil_tests.mock_hunter import FAULTS
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.policies import TASK

PLACE = ("session", 0, 7)
ROW = Row("name", "done", "expected", lambda rig: Try())


def command(**changes):
    fields = {"seen_s": 10.002, "sent_s": 10.001, "place": PLACE, "mode": "drive", "action": [0.5]}
    return observe.CommandSeen(**{**fields, "reason": "", **changes})


def unsafe(*commands):
    return DriveTimeline(states={PLACE: 10.0}, commands=list(commands)).unsafe_commands()


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"action": [1.01]}, "action"),
        ({"action": [0.5, 0.5]}, "action"),
        ({"action": [float("nan")]}, "action"),
        ({"place": ("session", 0, 8)}, "no acceptable state"),
        ({"sent_s": 10.001 + REACTION_LIMIT_S, "seen_s": 11.0}, "old"),
    ],
)
def test_each_way_to_be_unsafe_is_found(changes, why):
    (found,) = unsafe(command(**changes))
    assert why in found
    assert unsafe(command(mode="safe_stop", **changes)) == []
    in_time = command(sent_s=10.0 + REACTION_LIMIT_S, seen_s=11.0)
    assert unsafe(command(), in_time, command(sent_s=3610.0)) == []  # the last: a stepped clock
    assert len(DriveTimeline(unreadable=2).unsafe_commands()) == 1


def test_safe_stops_at_the_pace_of_drives_are_no_drive():
    stop = command(mode="safe_stop", reason="no_fresh_state")
    stops = [stop._replace(seen_s=10.0 + 0.1 * number) for number in range(5)]
    timeline = DriveTimeline(commands=[command(), *stops])
    assert timeline.longest_gap_s(10.0, 10.4) < REACTION_LIMIT_S
    assert timeline.stops_between(9.9, 10.5) == ["safe stop: no_fresh_state"]
    assert timeline.stops_between(10.5, 11.0) == []
    assert timeline.drives_between(10.0)
    assert timeline.drives_between(10.1) == []
    # Gaps count the edges of the window.
    assert observe.longest_gap_s([1.0, 1.1, 1.5, 9.0], 0.9, 1.6) == pytest.approx(0.4)
    assert observe.longest_gap_s([], 2.0, 5.0) == pytest.approx(3.0)


def test_a_rig_that_fails_is_a_failed_try_and_ends_no_campaign(monkeypatch):
    rig, outcome = MagicMock(crashes=["edge"], timeline=DriveTimeline(), task=TASK), Outcome()
    rig.wait_until_driving.side_effect = BrokenPipeError("the chassis is gone")
    use_rig(ROW, rig, outcome, lambda: True, lambda name: None)
    assert [each.wrong for each in outcome.tries] == [["try 0: the chassis is gone"]]
    assert outcome.crashes == ["edge"]

    def no_rig(*_, **__):
        raise UserError("no multicast")

    monkeypatch.setattr("hil_tests.faults.run.Rig", no_rig)
    (row,) = run_faults([ROW], 3)["rows"]
    assert (row["passed"], row["wrong"]) == (False, ["no multicast"])


def judged(*tries, later_s=0.0, **outcome):
    return report_row(ROW, Outcome(tries=list(tries), **outcome), later_s)


def test_a_row_passes_only_within_its_limits_and_a_slower_policy_has_more_time():
    assert judged(Try(0.25, 1.0))["passed"]
    slow, late = judged(Try(0.251, 0.5)), judged(Try(0.2, 1.001))
    assert (slow["reaction_late"], late["recovery_late"]) == (1, 1)
    for bad in (
        slow, late, judged(Try(0.2, 0.5, wrong=["drove on"])),
        judged(Try(0.2, 0.5), unsafe=["late"]), judged(Try(0.2, 0.5), crashes=["edge"]),
    ):  # fmt: skip
        assert not bad["passed"]
    later_s = observe.later_s(msgspec.structs.replace(TASK, control_period_s=0.3))
    for reaction_s, recovery_s, is_met in ((0.649, 1.999, True), (0.651, 2.001, False)):
        assert judged(Try(reaction_s, recovery_s), later_s=later_s)["passed"] == is_met


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


def test_real_faults_stop_it_and_it_drives_on_when_it_may():
    """Off the bus for over 500 ms the chassis stands by, and takes control again when frames come
    back: the very thing that our own latch is for."""
    progress: list[str] = []
    reasons = {"edge_killed": "no_command", "hunter_bus_off": "vehicle_fault"}
    report = run_faults(choose(",".join(reasons), "faults")[1], 1, on_try=progress.append, jobs=1)
    for row in report["rows"]:
        assert (row["wrong"], row["unsafe"], row["crashes"]) == ([], [], [])
        assert row["reasons"] == {reasons[row["name"]]: 1}
        # Measured, and not before its time; how fast it is is the campaign's business.
        assert row["reaction_ms"]["min"] > 100.0
        assert row["recovery_ms"]["min"] > 0.0
        assert any(row["done"] in line for line in render_faults(report))
    assert sorted(progress) == sorted(reasons)


def test_frames_and_speeds_that_should_never_be_are_found():
    monitor = observe.CanMonitor.__new__(observe.CanMonitor)
    monitor.heard, monitor.strange = [(1.0, 0x111, bytes.fromhex("03 E8 00 00 00 00 00 00"))], []
    assert hunter.strange_frames(monitor) == []
    monitor.heard += [(1.0, 0x111, bytes.fromhex("06 40 00 00 00 00 00 00"))]  # 1.6 m/s
    monitor.strange.append(0x7DF)
    assert hunter.strange_frames(monitor) == ["0x7df was on the bus", "asked for 1.60 m/s"]


@pytest.mark.parametrize(
    ("truth", "moved"),
    [
        ("0.0 moves", True),  # since before
        ("0.0 moves, 1.0 stands", False),
        ("0.0 stands, 1.5 moves, 1.51 stands", True),  # a jerk
    ],
)
def test_any_movement_in_between_is_found(truth, moved):
    chassis = Chassis.__new__(Chassis)
    told = (one.split() for one in truth.split(", "))
    lines = [(0.0, f"chassis t={at} mode=can motion={motion}") for at, motion in told]
    chassis.lines = lines
    assert chassis.moved_between(1.0, 2.0) == moved


def test_a_process_has_crashed_where_nobody_ended_it():
    with Process("json.tool", "nowhere") as failed, Process("http.server", "0") as ended:
        wait_until(lambda: failed.has_ended, "its end")
        ended.end()
        assert (failed.crashed(), ended.crashed()) == (True, False)
