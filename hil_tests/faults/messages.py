"""Faults of messages: garbage on every key, states and commands that are old, and too many."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable
from typing import Any

from edge_runtime import wire
from edge_runtime.cli import BAD_INPUT
from edge_runtime.wire import (
    CONTROL_PERIOD_S,
    DRIVE,
    Command,
    Feedback,
    Health,
    Rejection,
    State,
    encode,
)
from hil_tests.faults.ends import at_any_phase, drive_after_s
from hil_tests.faults.payloads import mutated, with_fields, without
from hil_tests.faults.processes import wait_until
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Row, Try
from hil_tests.faults.sender import make_state
from hil_tests.faults.timeline import longest_gap_s, stops_between

COUNT = 10_000
PER_S = 2_500
"""Pace of the garbage: enough to hurt, little enough that the drive goes on beside it."""
FLOOD_PER_S = 10_000
FLOOD_S = 2.0
BAD_STATE_ROUNDS = 50
SECOND_S = 2.0
OVERSIZED_BYTES = 10_000_000
_HOUR_NS = 3600 * 1_000_000_000
_FOREIGN = "garbage"
"""Session of the messages that mutations start from: what is valid still is rejected by it."""
_HEALTH_S = 0.6


def garbage_states(rig: Rig, number: int) -> Try:
    """Random and mutated payloads on the state's key; the edge runtime counts each by reason."""
    payloads = list(mutated(encode(make_state(1, session=_FOREIGN)), COUNT, number))
    wanted = Counter(_reason(wire.decode_state(payload)) for payload in payloads)
    before = _edge_counts(rig)
    begin_s = rig.mark()
    _put_all(rig, "state", payloads)
    end_s = rig.mark()
    counted = _edge_counts(rig) - before
    return _drove_on(rig, begin_s, end_s, wanted, counted)


def garbage_commands(rig: Rig, number: int) -> Try:
    """The same on the command's key, and commands of other times; the simulator counts them."""
    valid = encode(_command(rig, session=_FOREIGN))
    payloads = list(mutated(valid, COUNT, number))
    wanted = Counter(_reason(wire.decode_command(payload)) for payload in payloads)
    begin_s = rig.mark()
    _put_all(rig, "command", payloads)
    others = {
        "unknown_step": _command(rig, ahead=1000),
        "stale": _command(rig, ahead=-3),
        "action_size": _command(rig, action=[0.1, 0.2]),
    }
    for reason, command in others.items():
        rig.probe.put("command", encode(command))
        wanted[reason] += 1
    end_s = rig.mark()
    # Its own answers are in order, so that every rejection is one of these.
    rig.end_drive()
    return _drove_on(rig, begin_s, end_s, wanted, _simulator_counts(rig))


def garbage_feedback(rig: Rig, number: int) -> Try:
    """The same on the feedback's key: nobody drives by it, and nobody minds."""
    feedback = Feedback(
        vehicle="mock", session=_FOREIGN, episode=0, step=0, mode="drive", action=[0.1],
        speed_mps=1.0, self_braking=False, faults=[], sent_ns=time.time_ns(),
    )  # fmt: skip
    begin_s = rig.mark()
    _put_all(rig, "feedback", mutated(encode(feedback), COUNT, number))
    return _drove_on(rig, begin_s, rig.mark(), Counter(), Counter())


def garbage_health(rig: Rig, number: int) -> Try:
    """The same on the health's key, which the simulator reads for its report."""
    wait_until(lambda: rig.probe.health, "a health message")
    valid: Health = rig.probe.health[-1]
    begin_s = rig.mark()
    _put_all(rig, "health", mutated(encode(valid), COUNT, number))
    return _drove_on(rig, begin_s, rig.mark(), Counter(), Counter())


def bad_states(rig: Rig, number: int) -> Try:
    """Each kind of bad state between the good ones of the same simulator."""
    assert rig.sender is not None
    at_any_phase(number)
    before, begin_s = _edge_counts(rig), rig.mark()
    wanted: Counter[str] = Counter()
    for _ in range(BAD_STATE_ROUNDS):
        with rig.sender.lock:
            for reason, payload in _bad_of(rig.sender.step):
                rig.probe.put("state", payload)
                wanted[reason] += 1
            _send_reordered(rig, wanted)
        time.sleep(CONTROL_PERIOD_S / 2)
    end_s = rig.mark()
    counted = _edge_counts(rig) - before
    return _drove_on(rig, begin_s, end_s, wanted, counted)


def flood(rig: Rig, number: int) -> Try:
    """Valid states of one simulator at a hundred times the rate and more."""
    assert rig.sender is not None
    rig.sender.running.clear()
    memory_mb, begin_s = rig.edge.resident_mb(), rig.mark()
    sent = 0
    while (now_s := time.monotonic()) < begin_s + FLOOD_S:
        while sent < (now_s - begin_s) * FLOOD_PER_S:
            rig.sender.send_next()
            sent += 1
        time.sleep(0.001)
    end_s = rig.mark()
    rig.sender.running.set()
    recovery_s = drive_after_s(rig, end_s) - end_s
    gap_s = longest_gap_s((c.seen_s for c in rig.timeline.commands), begin_s, end_s)
    figures = {
        "states/s": sent / (end_s - begin_s),
        "memory grown, MB": rig.edge.resident_mb() - memory_mb,
    }
    return Try(gap_s, recovery_s, figures=figures)


def second_simulator(rig: Rig, number: int) -> Try:
    """States of another session on the same key, as a second simulator sends them."""
    at_any_phase(number)
    before, begin_s = _edge_counts(rig), rig.mark()
    wanted: Counter[str] = Counter()
    for step in range(round(SECOND_S / CONTROL_PERIOD_S)):
        # Where the first one is silent for 2 T it may be answered: it is no garbage.
        rig.timeline.states[("second", number, step)] = time.monotonic()
        rig.probe.put("state", encode(make_state(step, session="second", episode=number)))
        wanted["foreign_session"] += 1
        time.sleep(CONTROL_PERIOD_S)
    end_s = rig.mark()
    return _drove_on(rig, begin_s, end_s, wanted, _edge_counts(rig) - before)


def second_edge(rig: Rig, number: int) -> Try:
    """A second edge runtime with the same id gives way; the first answer to a state counts."""
    at_any_phase(number)
    second = rig.start_edge()
    begin_s = rig.mark()
    status = second.wait()
    end_s = rig.mark()
    rig.end_drive()
    # By drives alone: its last safe stop is obeyed beside the other's drive, which is safe.
    answers = Counter(c.place for c in rig.timeline.commands if c.mode == DRIVE)
    wanted = Counter(stale=sum(count - 1 for count in answers.values()))
    outcome = _drove_on(rig, begin_s, end_s, wanted, _simulator_counts(rig))
    if status != BAD_INPUT:
        outcome.wrong.append(f"the second one ended with status {status}: {second.lines[-1:]}")
    return outcome


def _bad_of(step: int) -> Iterable[tuple[str, bytes]]:
    """(reason, payload) of what must not reach the policy, around the newest step."""
    valid = encode(make_state(step + 1))
    yield "malformed", valid[: len(valid) // 2]
    yield "malformed", without(valid, "frames")
    yield "oversized", with_fields(valid, frames=bytes(wire.MAX_PAYLOAD_BYTES))
    yield "schema", with_fields(valid, schema=2)
    yield "frames_size", with_fields(valid, frames=bytes(100))
    yield "not_finite", with_fields(valid, speed_mps=float("nan"))
    yield "duplicate", encode(make_state(step))
    yield "stale", encode(make_state(step - 1))
    # From another time of day is no reason: the next one is good whatever its clock says.


def _send_reordered(rig: Rig, wanted: Counter[str]) -> None:
    """Two states that have overtaken one another, and one that says it comes from the future."""
    assert rig.sender is not None
    rig.sender.step += 3
    step = rig.sender.step
    rig.sender.send(make_state(step - 1))
    rig.probe.put("state", encode(make_state(step - 2)))
    wanted["stale"] += 1
    rig.sender.send(make_state(step, sent_ns=time.time_ns() + _HOUR_NS))


def oversized(rig: Rig, number: int) -> Try:
    """A state of 10 MB, five times."""
    payload = bytes(OVERSIZED_BYTES)
    before, begin_s = _edge_counts(rig), rig.mark()
    memory_mb = rig.edge.resident_mb()
    for _ in range(5):
        rig.probe.put("state", payload)
        time.sleep(CONTROL_PERIOD_S)
    end_s = rig.mark()
    counted = _edge_counts(rig) - before
    outcome = _drove_on(rig, begin_s, end_s, Counter(oversized=5), counted)
    figures = {"memory grown, MB": rig.edge.resident_mb() - memory_mb}
    return Try(**{**outcome.__dict__, "figures": figures})


def _command(rig: Rig, ahead: int = 0, **changes: object) -> Command:
    """A drive command to the newest state, or to one ``ahead`` of it."""
    newest = rig.timeline.commands[-1]
    session, episode, step = newest.place
    fields: dict = {
        "session": session,
        "episode": episode,
        "step": max(0, step + ahead),
        "mode": "drive",
        "action": [0.1],
        "policy_id": "0" * 64,
        "received_ns": time.time_ns(),
        "inference_ns": 1,
        "sent_ns": time.time_ns(),
    }
    return Command(**{**fields, **changes})


def _reason(message: State | Command | Rejection) -> str:
    return message.reason.value if isinstance(message, Rejection) else "foreign_session"


def _put_all(rig: Rig, topic: str, payloads: Iterable[bytes]) -> None:
    begin_s = time.monotonic()
    for sent, payload in enumerate(payloads):
        rig.probe.put(topic, payload)
        if sent % 25 == 0:
            time.sleep(max(0.0, begin_s + sent / PER_S - time.monotonic()))


def _edge_counts(rig: Rig) -> Counter[str]:
    """The edge's counts, by a health message that was sent after all that was sent so far."""
    time.sleep(_HEALTH_S)
    seen = len(rig.probe.health)
    wait_until(lambda: len(rig.probe.health) > seen, "a health message")
    return Counter(rig.probe.rejected())


def _simulator_counts(rig: Rig) -> Counter[str]:
    report = json.loads((rig.directory / "report.json").read_text())
    return Counter(report["rejected_by_simulator"])


def _drove_on(
    rig: Rig, begin_s: float, end_s: float, wanted: Counter[str], counted: Counter[str]
) -> Try:
    """The try of a row in which nothing is to happen but counting."""
    gap_s = longest_gap_s((c.seen_s for c in list(rig.timeline.commands)), begin_s, end_s)
    wrong = [] if counted == wanted else [f"counted {dict(counted)}, sent {dict(wanted)}"]
    # Safe stops come as steadily as drives: the gaps alone would not tell.
    wrong += stops_between(rig.timeline.commands, begin_s, end_s)
    return Try(gap_s, rejected=dict(counted), wrong=wrong)


def _row(*cells: Any, **options: Any) -> Row:
    """States flow on, but in the flood and where the drive is ended to read its report."""
    return Row(*cells, **{"flows": True, **options})


_ON = "drives on; each rejected and counted by reason"
_GAP = "longest gap between commands"

ROWS = (
    _row("garbage_states", f"{COUNT:,} random and mutated states", _ON, _GAP, garbage_states,
        recovery_limit_s=None),
    _row("garbage_commands", f"{COUNT:,} random and mutated commands; future, old, wrong size",
        _ON, _GAP, garbage_commands, recovery_limit_s=None, new_rig_each_try=True, flows=False),
    _row("garbage_feedback", f"{COUNT:,} random and mutated feedback messages", "drives on", _GAP,
        garbage_feedback, recovery_limit_s=None),
    _row("garbage_health", f"{COUNT:,} random and mutated health messages", "drives on", _GAP,
        garbage_health, recovery_limit_s=None),
    _row("bad_states", "truncated, wrong schema, NaN, old, repeated, reordered, future states", _ON,
        _GAP, bad_states, recovery_limit_s=None, rig={"sender": True}),
    _row("oversized", "states of 10 MB", _ON, _GAP, oversized, recovery_limit_s=None),
    _row("flood", f"{FLOOD_PER_S:,} states a second for {FLOOD_S:g} s",
        "answers the newest, or stops", _GAP, flood, rig={"sender": True}, alone=True,
        flows=False),
    _row("second_simulator", "a second simulator with the same id", _ON, _GAP, second_simulator,
        recovery_limit_s=None),
    _row("second_edge", "a second edge runtime with the same id", "second one refuses; drives on",
        _GAP, second_edge, recovery_limit_s=None, new_rig_each_try=True, flows=False),
)  # fmt: skip
