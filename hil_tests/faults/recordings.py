"""Faults of the recorder: its disk is full, or it is killed. The drive must not notice."""

from __future__ import annotations

import resource
import time
from pathlib import Path

from bridge.recording import Recording
from edge_runtime.wire import CONTROL_PERIOD_S, State, decode_state
from hil_tests.faults.ends import at_any_phase
from hil_tests.faults.processes import Process
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Row, Try
from hil_tests.faults.timeline import longest_gap_s, stops_between

FULL_AT_BYTES = 60_000
"""The recorder writes about 1 kB for each state: the picture of noise compresses badly."""
RECORDED_S = 2.5
MOST_LOST_S = 1.0
_STOPPED = 1
"""Exit status of a recorder that cannot write."""
_FEWEST_STATES = 5


def disk_full(rig: Rig, number: int) -> Try:
    """No file may grow beyond a limit: the same failing write as on a full disk."""
    path, recorder = _start(rig, number)
    begin_s = rig.mark()
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (FULL_AT_BYTES, FULL_AT_BYTES))
    status = recorder.wait()
    end_s = rig.mark()
    wrong = [] if status == _STOPPED else [f"status {status}: {recorder.lines[-1:]}"]
    if not any("error: recording" in line for _, line in recorder.lines):
        wrong.append(f"it does not say so: {recorder.lines[-1:]}")
    return _drove_on(rig, begin_s, end_s, states_in(path), wrong)


def recorder_killed(rig: Rig, number: int) -> Try:
    """SIGKILL in the middle of a recording: at most the last second is lost."""
    path, recorder = _start(rig, number)
    begin_s = rig.mark()
    time.sleep(RECORDED_S)
    at_any_phase(number)
    sent = len(rig.timeline.states)
    recorder.kill()
    end_s = rig.mark()
    states = states_in(path)
    places = list(rig.timeline.states)
    last = (states[-1].session, states[-1].episode, states[-1].step) if states else None
    lost = sent - 1 - places.index(last) if last in places else sent
    lost_s = max(0, lost) * CONTROL_PERIOD_S
    wrong = [f"{lost_s:.1f} s lost"] if lost_s > MOST_LOST_S + CONTROL_PERIOD_S / 2 else []
    return _drove_on(rig, begin_s, end_s, states, wrong, {"lost, s": lost_s})


def states_in(path: Path) -> list[State]:
    """The states that can be read from a recording, whole or torn."""
    found = []
    for stored in Recording(path).messages():
        if stored.channel.topic.endswith("/state") and stored.channel.message_encoding == "msgpack":
            state = decode_state(stored.message.data)
            if isinstance(state, State):
                found.append(state)
    return found


def _start(rig: Rig, number: int) -> tuple[Path, Process]:
    path = rig.directory / f"{number}.mcap"
    recorder = rig.start_recorder(path)
    recorder.wait_for_line("recording")
    return path, recorder


def _drove_on(
    rig: Rig,
    begin_s: float,
    end_s: float,
    states: list[State],
    wrong: list[str],
    figures: dict[str, float] | None = None,
) -> Try:
    if len(states) < _FEWEST_STATES:
        wrong = [*wrong, f"only {len(states)} states can be read"]
    gap_s = longest_gap_s((c.seen_s for c in list(rig.timeline.commands)), begin_s, end_s)
    wrong = [*wrong, *stops_between(rig.timeline.commands, begin_s, end_s)]
    return Try(gap_s, wrong=wrong, figures=figures or {})


_GAP = "longest gap between commands"

ROWS = (
    Row("disk_full", "disk full while recording",
        "recorder says so and ends; the recording is readable; drives on", _GAP, disk_full,
        recovery_limit_s=None, flows=True),
    Row("recorder_killed", "SIGKILL to the recorder",
        "at most 1 s of the recording is lost; drives on", _GAP, recorder_killed,
        recovery_limit_s=None, flows=True),
)  # fmt: skip
