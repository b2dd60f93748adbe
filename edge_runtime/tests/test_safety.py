from pathlib import Path

import pytest
from hil_tests.tests.shared.policies import T

import edge_runtime
from edge_runtime import safety as rules
from edge_runtime.safety import TRANSITIONS, Event, Mode, Safety, advance, note_arrival

STANDBY, DRIVE, STOP = Mode.STANDBY, Mode.DRIVE, Mode.SAFE_STOP
GOOD = {"fresh_state", "recovered", "final_state"}
# The words that health and commands say: a reader on the other end compares with them.
BAD = {
    "no_fresh_state", "output_not_finite", "inference_failed", "policy_thread_dead", "other_task",
    "inference_too_long", "pause_too_long", "other_session", "not_armed", "vehicle_fault",
    "state_late", "episode", "leash",
}  # fmt: skip


def test_the_events_are_the_good_the_bad_and_the_permission():
    assert {event.value for event in Event} == GOOD | BAD | {"rearm"}
    assert {event.value for event in rules.FAULTS} == BAD


@pytest.mark.parametrize("rearmed", [False, True])
@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("event", Event)
def test_every_pair(mode, event, rearmed):
    """Of the whole record: where it goes, why, and what it remembers."""
    expected = TRANSITIONS[mode, event]
    stopped = mode is STOP
    before = Safety(T, mode, "before" if stopped else "", 3, rearmed, 7.5, "s", 9, 6.5)
    after = advance(before, event)
    assert after.mode is expected
    assert after.safe_stops == 9 + int(not stopped and expected is STOP)
    if expected is not STOP:
        assert after.reason == ""
    else:
        assert after.reason == (event.value if event.value in BAD else "before")
    assert after.fresh_in_a_row == (0 if event.value in BAD else 3 + int(event.value in GOOD))
    kept = rearmed or event is Event.REARM
    assert after.rearmed == (kept and expected is STOP and event.value not in BAD)
    assert (after.last_fresh_s, after.session, after.permitted_s) == (7.5, "s", 6.5)


def test_the_limits_are_the_contracts():
    assert rules.FRESH_STATES_TO_RECOVER == 5
    assert round(Safety(T).silence_s, 9) == 0.22  # 2 T and a grace within the promised T / 2
    assert rules.MAX_PAUSE_S == 10.0
    assert Safety(T) == (T, STANDBY, "", 0, False, None, None, 0, None, 0.0)


@pytest.mark.parametrize(
    ("mode", "gap_s", "session", "without", "with_vehicle"),
    [
        (STANDBY, 0.2, "a", None, None),
        (STANDBY, 0.3, "a", Event.SILENT, Event.SILENT),
        (STANDBY, 10.0, "a", Event.SILENT, Event.SILENT),
        (STANDBY, 10.001, "a", Event.SILENT, Event.PAUSED),
        (STANDBY, 0.1, "b", Event.SILENT, Event.OTHER_SESSION),
        (STANDBY, 0.1, "0", Event.SILENT, Event.OTHER_SESSION),
        (STANDBY, 60.0, "b", Event.SILENT, Event.OTHER_SESSION),
        (DRIVE, 0.2, "a", None, None),
        (DRIVE, 60.0, "a", Event.SILENT, Event.SILENT),
        (DRIVE, 0.2, "b", Event.SILENT, Event.OTHER_SESSION),
        (STOP, 60.0, "a", Event.SILENT, Event.SILENT),
        (STOP, 0.2, "b", Event.SILENT, Event.OTHER_SESSION),
    ],
)
def test_what_the_time_before_a_state_means(mode, gap_s, session, without, with_vehicle):
    safety = note_arrival(Safety(T, mode), "a", 1000.0)
    for needs_rearm, event in ((False, without), (True, with_vehicle)):
        assert rules.classify_arrival(safety, session, 1000.0 + gap_s, needs_rearm) is event
        # Before the first state of all nothing was due.
        assert rules.classify_arrival(Safety(T), session, gap_s, needs_rearm) is None


@pytest.mark.parametrize("mode", Mode)
def test_only_the_first_state_and_those_that_come_in_drive_put_off_the_pause(mode):
    first = note_arrival(Safety(T, mode), "a", 1.0)
    assert first == Safety(T, mode, last_fresh_s=1.0, session="a", permitted_s=1.0)
    permitted_s = 2.0 if mode is DRIVE else 1.0
    then = note_arrival(first, "b", 2.0)
    assert then == Safety(T, mode, last_fresh_s=2.0, session="b", permitted_s=permitted_s)


@pytest.mark.parametrize(
    ("mode", "before", "rearmed", "without", "with_vehicle"),
    [
        (STANDBY, 9, False, Event.FRESH, Event.FRESH),
        (DRIVE, 9, False, Event.FRESH, Event.FRESH),
        (STOP, 3, True, Event.FRESH, Event.FRESH),
        (STOP, 4, False, Event.RECOVERED, Event.FRESH),
        (STOP, 50, False, Event.RECOVERED, Event.FRESH),
        (STOP, 4, True, Event.RECOVERED, Event.RECOVERED),
    ],
)
def test_the_fifth_fresh_state_recovers(mode, before, rearmed, without, with_vehicle):
    safety = Safety(T, mode, fresh_in_a_row=before, rearmed=rearmed)
    for needs_rearm, event in ((False, without), (True, with_vehicle)):
        assert rules.classify_fresh(safety, False, needs_rearm) is event
        assert rules.classify_fresh(safety, True, needs_rearm) is Event.FINAL


def test_only_what_drives_may_be_silent_for_as_long_as_it_rides():
    for mode, silent_s in ((STANDBY, 0.22), (DRIVE, 0.72), (STOP, 0.22)):
        safety = note_arrival(Safety(T, mode, ride_s=0.5), "a", 0.0)
        assert round(safety.answer_s, 9) == 0.22
        assert [rules.is_silent(safety, silent_s + by_s) for by_s in (-1e-6, 1e-6)] == [False, True]
    assert rules.is_silent(Safety(T), 0.0)
    # A state exactly as old as the limit is still in time.
    assert not rules.is_silent(Safety(T, last_fresh_s=0.0), 2.2 * T)


def test_the_readme_shows_the_table():  # written out a second time, from the contract
    readme = Path(edge_runtime.__file__).with_name("README.md").read_text()
    rows: dict[tuple[str, ...], list[str]] = {}
    for event in Event:
        modes = tuple(TRANSITIONS[mode, event].value for mode in Mode)
        rows.setdefault(modes, []).append(event.value)
    for modes, events in rows.items():
        assert f"| {' | '.join([', '.join(events), *modes])} |" in readme
