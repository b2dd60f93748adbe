"""``python -m bridge replay``: recordings written by hand, whose right answers are known."""

import json
import sys

import pytest
from PIL import Image

from bridge import replay as replay_module
from bridge.tests.recordings import ANSWER_S, SILENCE, Hand, bridge_status, flip_chunk, ns
from hil_tests.tests.shared.drives import make_policy
from hil_tests.tests.shared.messages import WHITE, frames, make_state

FAULT = {"mode": "safe_stop", "reason": "vehicle_fault", "action": [-1.0]}
NOT_ARMED = {"mode": "safe_stop", "reason": "not_armed", "action": [-1.0]}


@pytest.fixture
def hand(tmp_path):
    return Hand(tmp_path / "by_hand.mcap")


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    """They take longer than the replays."""
    monkeypatch.setattr(replay_module, "draw", lambda *_: None)
    monkeypatch.setattr(replay_module, "write_figure", lambda *_: None)


def replay(hand, policy=None, *options):
    hand.close()
    folder, out = hand.path.parent, hand.path.with_suffix(".json")
    policy = policy or make_policy(folder, "constant", 0.3)
    trust = ["--policy", str(policy), "--allow-unsigned"]
    status = bridge_status(["replay", str(hand.path), *trust, "--out", str(out), *options])
    return status, json.loads(out.read_text()) if out.exists() else {}


def test_the_same_policy_is_equal_and_the_report_says_of_what(hand):
    hand.drive(0, 20)
    hand.state(2.0, 20)  # Nobody answered it.
    hand.state(2.01, 19)  # A network has repeated this one.
    status, report = replay(hand)
    assert status == 0
    assert (report["compared"], report["different"], report["unanswered"]) == (20, 0, 1)
    assert 0 < report["largest_difference"] < 1e-7  # 0.3 as float32
    assert report["by_recorded"] == {"drive": 20}


def test_another_policy_differs_and_the_tolerance_decides(hand, tmp_path):
    hand.drive(0, 15)
    policy = make_policy(tmp_path, "constant", 0.31)
    status, report = replay(hand, policy)
    assert (status, report["different"]) == (1, 15)
    assert report["largest_difference"] == pytest.approx(0.01, abs=1e-6)
    assert len(report["first_differences"]) == 10
    first = report["first_differences"][0]
    assert (first["session"], first["episode"], first["step"]) == ("here", 0, 0)
    assert first["recorded"] == {"mode": "drive", "reason": "", "action": [0.3]}
    assert replay(hand, policy, "--tolerance", "0.02")[0] == 0


def test_what_differs_is_drawn_beside_the_report(hand, tmp_path, monkeypatch):
    monkeypatch.undo()
    for policy, action in ((None, [0.3]), (make_policy(tmp_path, "nan", 0.3), [0.3, 0.4])):
        hand = Hand(tmp_path / f"{len(action)}.mcap")
        hand.drive(0, 5, action=action)
        replay(hand, policy)
        with Image.open(hand.path.with_suffix(".png")) as picture:
            assert picture.size == (1100, 308)


def braked_gap(hand):
    hand.drive(0, 5)
    hand.stop(4, 4)  # 0.6 s of silence
    hand.drive(5, 9, start_s=0.5, **SILENCE)
    hand.drive(9, 12, start_s=0.5)


def ridden_gap(hand):
    hand.drive(0, 5, plan=[[0.3]] * 5)
    hand.drive(11, 15, plan=[[0.3]] * 5)  # 0.7 s without a state: it rode on.


def restart(hand):
    hand.hear_health(0.0, 5.0)
    hand.drive(0, 5)
    hand.stop(4, 2)
    hand.hear_health(2.9, 0.5)
    hand.drive(30, 33)  # The new runtime drives at once.
    hand.edge_clock_s = 3600.0  # A step of the board's clock changes nothing.
    hand.drive(33, 36)
    hand.state(3.6, 36)  # An inference that took too long is replayed as one.
    slow = {"mode": "safe_stop", "reason": "inference_too_long", "action": [-1.0]}
    hand.command(3.7005, 36, answer_s=0.1005, inference_ns=0, **slow)


def thirty_years(hand):
    hand.drive(0, 5)
    hand.stop(4, 3)
    hand.drive(5, 9, start_s=1e9, **SILENCE)
    hand.drive(9, 12, start_s=1e9)


def rearmed_vehicle(hand):
    hand.hear_health(0.0, 5.0, vehicle="mock")
    hand.drive(0, 3)
    hand.stop(2, 1)
    hand.drive(10, 20, **SILENCE)  # Nobody has re-armed it yet.
    hand.drive(20, 23)


def armed_later(hand):
    hand.hear_health(0.0, 5.0, vehicle="mock", needs_rearm=True)
    hand.drive(0, 8, **NOT_ARMED)
    hand.drive(8, 12)
    hand.hear_health(1.55, 0.3, vehicle="mock", needs_rearm=True)
    hand.drive(13, 20, **NOT_ARMED)


EPISODE, LEASH = ({**NOT_ARMED, "reason": reason} for reason in ("episode", "leash"))


def an_episode_and_a_leash(hand):
    hand.hear_health(0.0, 5.0, vehicle="mock")
    hand.drive(0, 3)
    hand.drive(3, 10, episode=1, **EPISODE)
    hand.drive(10, 13, episode=1)
    hand.drive(13, 20, episode=1, **LEASH)
    hand.drive(20, 23, episode=1)


def faults(hand):
    hand.hear_health(0.0, 5.0, vehicle="hunter")
    hand.drive(0, 3)
    hand.command(0.25, 2, answer_s=0.05, inference_ns=0, **FAULT)  # While nothing else happens.
    hand.drive(3, 10, **FAULT)
    hand.drive(10, 13)
    hand.drive(13, 20, **FAULT)  # Seen when a state was to be answered.
    hand.drive(20, 23)


def late_watchdog(hand):
    hand.drive(0, 3)
    hand.state(0.425, 3)  # 2.25 T after the last one
    hand.command(0.425 + ANSWER_S, 3, **SILENCE)


STORIES = [
    (braked_gap, 12), (ridden_gap, 9), (restart, 12), (thirty_years, 12), (rearmed_vehicle, 16),
    (armed_later, 19), (faults, 23), (late_watchdog, 4), (an_episode_and_a_leash, 23),
]  # fmt: skip


@pytest.mark.parametrize(("story", "compared"), STORIES, ids=lambda it: getattr(it, "__name__", ""))
def test_the_same_policy_repeats_what_befell_the_runtime(hand, story, compared):
    story(hand)
    status, report = replay(hand)
    assert status == 0, report["first_differences"]
    assert report["compared"] == compared


@pytest.mark.parametrize("vehicle", ["none", "mock"])
def test_another_plan_differs_and_a_longer_gap_is_braked_for(tmp_path, vehicle):
    for name, last, other in (("plan", 0.31, 5), ("gap", 0.3, 12)):
        hand = Hand(tmp_path / f"{name}.mcap")
        hand.hear_health(0.0, 5.0, vehicle=vehicle)
        hand.drive(0, 5, plan=[[0.3]] * 5)
        hand.drive(other, other + 1, plan=[[0.3]] * 4 + [[last]])
        status, report = replay(hand)
        assert (status, report["compared"], report["different"]) == (1, 6, 1)


def test_a_runtime_that_drives_too_early_is_found_out(hand):
    hand.drive(0, 5)
    hand.drive(8, 12)  # Nobody braked over the gap.
    status, report = replay(hand)
    assert status == 1
    assert [row["step"] for row in report["first_differences"]] == [8, 9, 10, 11]
    assert report["first_differences"][0]["replayed"]["mode"] == "safe_stop"


def test_a_recorder_that_was_held_up_changes_nothing(hand):
    hand.drive(0, 3)
    for step in range(3, 6):  # Heard half a second late, answered in time.
        sent_s = step * 0.1 + ANSWER_S
        hand.state(0.8 + step * 0.01, step)
        stamps = {"received_ns": ns(sent_s - ANSWER_S), "sent_ns": ns(sent_s)}
        hand.command(0.8 + step * 0.01, step, **stamps)
    assert replay(hand)[0] == 0


def test_a_policy_that_answers_nan_brakes_where_the_recorded_one_drove(hand, tmp_path):
    hand.drive(0, 2)
    hand.state(0.2, 2, observation=frames(WHITE))
    hand.command(0.2 + ANSWER_S, 2)
    status, report = replay(hand, make_policy(tmp_path, "nan", 0.3))
    assert (status, report["different"]) == (1, 1)
    answer = report["first_differences"][0]["replayed"]
    assert (answer["mode"], answer["reason"]) == ("safe_stop", "output_not_finite")


def test_no_recording_decides_what_is_imported(tmp_path, refusal, monkeypatch):
    (tmp_path / "planted.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    policy = make_policy(tmp_path, "constant")
    for vehicle, says in (("planted:Rover", "planted:Rover"), ("Rover", "Rover")):
        hand = Hand(tmp_path / f"{vehicle[:4]}.mcap")
        hand.hear_health(0.0, 5.0, vehicle=vehicle)
        hand.drive(0, 3)
        hand.close()
        assert says in refusal("replay", hand.path, "--policy", policy, "--allow-unsigned")
    assert "planted" not in sys.modules


def test_a_vehicles_limits_follow_from_the_settings(hand, tmp_path):
    hand.hear_health(0.0, 5.0, vehicle="hunter")
    hand.drive(0, 3)
    settings = tmp_path / "edge.toml"
    link = "connect = 'tls/10.0.0.1:7447'"  # It opens none, and takes no --tls.
    settings.write_text(f"{link}\nvehicle.driver = 'hunter'\nvehicle.hunter.scale = 0.2\n")
    assert replay(hand, None, "--config", str(settings))[0] == 0
    settings.write_text("[vehicle.hunter]\nscale = -1\n")
    assert replay(hand, None, "--config", str(settings))[0] == 2


def test_of_several_vehicles_one_is_named(hand):
    hand.drive(0, 3)
    hand.hear(1.0, "state", make_state(0), vehicle_id="w")
    assert replay(hand)[0] == 2
    assert replay(hand, None, "--vehicle-id", "v")[0] == 0
    assert replay(hand, None, "--vehicle-id", "w")[0] == 2


def test_of_a_damaged_recording_the_rest_is_replayed(hand, capsys):
    for first in (0, 20, 40):
        hand.drive(first, first + 20)
        hand.writer.flush()
    hand.close()
    flip_chunk(hand.path, 1)
    assert replay(hand)[1]["compared"] == 40
    (line,) = capsys.readouterr().err.splitlines()
    assert "1 damaged place" in line


def test_no_terminal_obeys_what_a_recording_holds(hand, tmp_path, capsys):
    """Its topics, and the reasons in its commands."""
    hand.drive(0, 3, action=[0.1], reason="\x1b]0;title\x07")
    policy = make_policy(tmp_path, "constant", 0.3)
    assert replay(hand, policy)[0] == 1
    hand = Hand(tmp_path / "other.mcap")
    for vehicle_id in ("v", "\x1b[2J\x9b"):
        hand.hear(0.0, "state", make_state(1), vehicle_id)
    hand.close()
    for command in (["replay", "--policy", str(policy)], ["view", "--save", "none.rrd"]):
        assert bridge_status([*command, str(tmp_path / "other.mcap")]) == 2
    said = capsys.readouterr()
    assert "\\x1b]0;title\\x07" in said.out
    assert "\\x1b[2J" in said.err
    assert all(line.isprintable() for line in (said.out + said.err).splitlines())


@pytest.mark.parametrize(
    "stamps",
    [{"received_ns": 0}, {"sent_ns": 2**63, "received_ns": 2**64 - 1}, {"inference_ns": 2**63},
     {"sent_ns": ns(0.7 - 3600.0)}],
    ids=repr,
)  # fmt: skip
def test_a_clock_that_is_set_between_two_stamps_changes_nothing(hand, stamps):
    hand.drive(0, 7)
    hand.state(0.7, 7)
    hand.command(0.7 + ANSWER_S, 7, **stamps)
    hand.drive(8, 12)
    status, report = replay(hand)
    assert (status, report["compared"]) == (0, 12), report["first_differences"]
