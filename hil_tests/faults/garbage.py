"""Faults of messages that are none: random and mutated payloads on every key."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable

from edge_runtime import wire
from edge_runtime.wire import Command, Feedback, Health, Rejection, State, encode
from hil_tests.faults.counting import (
    DRIVES_ON,
    GAP,
    counted_row,
    drove_on,
    edge_counts,
    simulator_counts,
)
from hil_tests.faults.payloads import mutated
from hil_tests.faults.processes import wait_until
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Try
from hil_tests.faults.sender import make_state

COUNT = 10_000
PER_S = 2_500
"""Pace of the garbage: enough to hurt, little enough that the drive goes on beside it."""
_FOREIGN = "garbage"
"""Session of the messages that mutations start from: what is valid still is rejected by it."""


def garbage_states(rig: Rig, number: int) -> Try:
    """Random and mutated payloads on the state's key; the edge runtime counts each by reason."""
    payloads = list(mutated(encode(make_state(1, session=_FOREIGN)), COUNT, number))
    wanted = Counter(_reason(wire.decode_state(payload)) for payload in payloads)
    before = edge_counts(rig)
    begin_s = rig.mark()
    _put_all(rig, "state", payloads)
    end_s = rig.mark()
    counted = edge_counts(rig) - before
    return drove_on(rig, begin_s, end_s, wanted, counted)


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
    return drove_on(rig, begin_s, end_s, wanted, simulator_counts(rig))


def garbage_feedback(rig: Rig, number: int) -> Try:
    """The same on the feedback's key: nobody drives by it, and nobody minds."""
    feedback = Feedback(
        vehicle="mock", session=_FOREIGN, episode=0, step=0, mode="drive", action=[0.1],
        speed_mps=1.0, self_braking=False, faults=[], sent_ns=time.time_ns(),
    )  # fmt: skip
    begin_s = rig.mark()
    _put_all(rig, "feedback", mutated(encode(feedback), COUNT, number))
    return drove_on(rig, begin_s, rig.mark(), Counter(), Counter())


def garbage_health(rig: Rig, number: int) -> Try:
    """The same on the health's key, which the simulator reads for its report and counts."""
    wait_until(lambda: rig.probe.health, "a health message")
    valid: Health = rig.probe.health[-1]
    payloads = list(mutated(encode(valid), COUNT, number))
    decoded = [wire.decode_health(payload) for payload in payloads]
    wanted = Counter(f"health_{m.reason.value}" for m in decoded if isinstance(m, Rejection))
    begin_s = rig.mark()
    _put_all(rig, "health", payloads)
    end_s = rig.mark()
    rig.end_drive()
    counts = simulator_counts(rig)
    unread = Counter({name: n for name, n in counts.items() if name.startswith("health_")})
    return drove_on(rig, begin_s, end_s, wanted, unread)


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


ROWS = (
    counted_row(
        "garbage_states",
        f"{COUNT:,} random and mutated states",
        DRIVES_ON,
        GAP,
        garbage_states,
        recovery_limit_s=None,
    ),
    counted_row(
        "garbage_commands",
        f"{COUNT:,} random and mutated commands; future, old, wrong size",
        DRIVES_ON,
        GAP,
        garbage_commands,
        recovery_limit_s=None,
        new_rig_each_try=True,
        flows=False,
    ),
    counted_row(
        "garbage_feedback",
        f"{COUNT:,} random and mutated feedback messages",
        "drives on",
        GAP,
        garbage_feedback,
        recovery_limit_s=None,
    ),
    counted_row(
        "garbage_health",
        f"{COUNT:,} random and mutated health messages",
        DRIVES_ON,
        GAP,
        garbage_health,
        recovery_limit_s=None,
        new_rig_each_try=True,
        flows=False,
    ),
)
