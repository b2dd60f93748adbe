"""Faults of messages: bad states among good ones, too many, too large, or from a second one."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable

from edge_runtime import wire
from edge_runtime.cli import BAD_INPUT
from edge_runtime.wire import (
    CONTROL_PERIOD_S,
    DRIVE,
    encode,
)
from hil_tests.faults.counting import (
    DRIVES_ON,
    GAP,
    counted_row,
    drove_on,
    edge_counts,
    simulator_counts,
)
from hil_tests.faults.ends import at_any_phase
from hil_tests.faults.payloads import with_fields, without
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Try
from hil_tests.faults.sender import make_state
from hil_tests.faults.timeline import longest_gap_s
from hil_tests.faults.waits import drive_after_s

FLOOD_PER_S = 10_000
FLOOD_S = 2.0
BAD_STATE_ROUNDS = 50
SECOND_S = 2.0
OVERSIZED_BYTES = 10_000_000
_HOUR_NS = 3600 * 1_000_000_000


def bad_states(rig: Rig, number: int) -> Try:
    """Each kind of bad state between the good ones of the same simulator."""
    assert rig.sender is not None
    at_any_phase(number)
    before, begin_s = edge_counts(rig), rig.mark()
    wanted: Counter[str] = Counter()
    for _ in range(BAD_STATE_ROUNDS):
        with rig.sender.lock:
            for reason, payload in _bad_of(rig.sender.step):
                rig.probe.put("state", payload)
                wanted[reason] += 1
            _send_reordered(rig, wanted)
        time.sleep(CONTROL_PERIOD_S / 2)
    end_s = rig.mark()
    counted = edge_counts(rig) - before
    return drove_on(rig, begin_s, end_s, wanted, counted)


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
    before, begin_s = edge_counts(rig), rig.mark()
    wanted: Counter[str] = Counter()
    for step in range(round(SECOND_S / CONTROL_PERIOD_S)):
        # Where the first one is silent for 2 T it may be answered: it is no garbage.
        rig.timeline.states[("second", number, step)] = time.monotonic()
        rig.probe.put("state", encode(make_state(step, session="second", episode=number)))
        wanted["foreign_session"] += 1
        time.sleep(CONTROL_PERIOD_S)
    end_s = rig.mark()
    return drove_on(rig, begin_s, end_s, wanted, edge_counts(rig) - before)


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
    outcome = drove_on(rig, begin_s, end_s, wanted, simulator_counts(rig))
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
    before, begin_s = edge_counts(rig), rig.mark()
    memory_mb = rig.edge.resident_mb()
    for _ in range(5):
        rig.probe.put("state", payload)
        time.sleep(CONTROL_PERIOD_S)
    end_s = rig.mark()
    counted = edge_counts(rig) - before
    outcome = drove_on(rig, begin_s, end_s, Counter(oversized=5), counted)
    figures = {"memory grown, MB": rig.edge.resident_mb() - memory_mb}
    return Try(**{**outcome.__dict__, "figures": figures})


ROWS = (
    counted_row(
        "bad_states",
        "truncated, wrong schema, NaN, old, repeated, reordered, future states",
        DRIVES_ON,
        GAP,
        bad_states,
        recovery_limit_s=None,
        rig={"sender": True},
    ),
    counted_row("oversized", "states of 10 MB", DRIVES_ON, GAP, oversized, recovery_limit_s=None),
    counted_row(
        "flood",
        f"{FLOOD_PER_S:,} states a second for {FLOOD_S:g} s",
        "answers the newest, or stops",
        GAP,
        flood,
        rig={"sender": True},
        alone=True,
        flows=False,
    ),
    counted_row(
        "second_simulator",
        "a second simulator with the same id",
        DRIVES_ON,
        GAP,
        second_simulator,
        recovery_limit_s=None,
    ),
    counted_row(
        "second_edge",
        "a second edge runtime with the same id",
        "second one refuses; drives on",
        GAP,
        second_edge,
        recovery_limit_s=None,
        new_rig_each_try=True,
        flows=False,
    ),
)
