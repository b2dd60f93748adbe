"""Faults of messages: bad, foreign, too many, too large, and bytes that are no messages at all."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import partial

import msgspec
import numpy as np

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
from hil_tests.faults.rig import Rig, make_state
from hil_tests.faults.row import (
    GAP,
    Try,
    drives_on,
    drove_on,
    fault,
)
from hil_tests.processes import wait_until

FLOOD_PER_S, FLOOD_S = 10_000, 2.0
BAD_STATE_ROUNDS = 50
SECOND_S = 2.0
OVERSIZED_BYTES = 10_000_000
COUNT, PER_S = 10_000, 2_500
"""Of garbage, and its pace: enough to hurt, little enough that the drive goes on beside it."""
_FOREIGN = "garbage"
"""Session of the messages that mutations start from: what is valid still is rejected by it."""
_HOUR_NS = 3600 * 1_000_000_000
_LONGEST_RANDOM, _SPLICED = 512, 64

counted = partial(drives_on, expected="drives on; each rejected and counted by reason")
counted_at_its_end = partial(counted, flows=False, new_rig_each_try=True)
"""The simulator's counts are read in its report, for which the drive has to end."""


@counted(
    "truncated, wrong schema, NaN, old, repeated, reordered, future states", rig={"sender": True}
)
def bad_states(rig: Rig, number: int) -> Try:
    """Each kind of bad state between the good ones of the same simulator."""
    before, begin_s = rig.edge_counts(), time.monotonic()
    wanted: Counter[str] = Counter()
    for _ in range(BAD_STATE_ROUNDS):
        with rig.sender.lock:
            for reason, payload in _bad_of(rig.sender.step):
                rig.probe.put("state", payload)
                wanted[reason] += 1
            _send_reordered(rig, wanted)
        time.sleep(CONTROL_PERIOD_S / 2)
    end_s = time.monotonic()
    return drove_on(rig, begin_s, end_s, wanted, rig.edge_counts() - before)


@counted("states of 10 MB")
def oversized(rig: Rig, number: int) -> Try:
    """Five times; the memory must not grow by them."""
    payload = bytes(OVERSIZED_BYTES)
    before, begin_s = rig.edge_counts(), time.monotonic()
    memory_mb = rig.edge.resident_mb()
    for _ in range(5):
        rig.probe.put("state", payload)
        time.sleep(CONTROL_PERIOD_S)
    end_s = time.monotonic()
    found = rig.edge_counts() - before
    figures = {"memory grown, MB": rig.edge.resident_mb() - memory_mb}
    return drove_on(rig, begin_s, end_s, Counter(oversized=5), found, figures=figures)


@fault(
    f"{FLOOD_PER_S:,} states a second for {FLOOD_S:g} s", "answers the newest, or stops", GAP,
    rig={"sender": True}, alone=True,
)  # fmt: skip
def flood(rig: Rig, number: int) -> Try:
    """Valid states of one simulator at a hundred times the rate and more."""
    rig.sender.running.clear()
    memory_mb, begin_s = rig.edge.resident_mb(), time.monotonic()
    sent = 0
    while (now_s := time.monotonic()) < begin_s + FLOOD_S:
        while sent < (now_s - begin_s) * FLOOD_PER_S:
            rig.sender.send_next()
            sent += 1
        time.sleep(0.001)
    end_s = time.monotonic()
    rig.sender.running.set()
    recovered_s = rig.recovered_after_s(end_s)
    figures = {
        "states/s": sent / (end_s - begin_s),
        "memory grown, MB": rig.edge.resident_mb() - memory_mb,
    }
    return Try(rig.longest_gap(begin_s, end_s), recovered_s, figures=figures)


@counted("a second simulator with the same id")
def second_simulator(rig: Rig, number: int) -> Try:
    """States of another session on the same key, as a second simulator sends them."""
    before, begin_s = rig.edge_counts(), time.monotonic()
    wanted: Counter[str] = Counter()
    for step in range(round(SECOND_S / CONTROL_PERIOD_S)):
        # Where the first one is silent for 2 T it may be answered: it is no garbage.
        rig.timeline.states[("second", number, step)] = time.monotonic()
        rig.probe.put("state", encode(make_state(step, session="second", episode=number)))
        wanted["foreign_session"] += 1
        time.sleep(CONTROL_PERIOD_S)
    end_s = time.monotonic()
    return drove_on(rig, begin_s, end_s, wanted, rig.edge_counts() - before)


@counted_at_its_end(
    "a second edge runtime with the same id", expected="second one refuses; drives on"
)
def second_edge(rig: Rig, number: int) -> Try:
    """A second edge runtime with the same id gives way; the first answer to a state counts."""
    second = rig.start_edge()
    begin_s = time.monotonic()
    status = second.wait()
    end_s = time.monotonic()
    rig.end_drive()
    # By drives alone: its last safe stop is obeyed beside the other's drive, which is safe.
    answers = Counter(c.place for c in rig.timeline.commands if c.mode == DRIVE)
    wanted = Counter(stale=sum(count - 1 for count in answers.values()))
    ended = f"the second one ended with status {status}: {second.lines[-1:]}"
    wrong = [] if status == BAD_INPUT else [ended]
    return drove_on(rig, begin_s, end_s, wanted, rig.simulator_counts(), wrong=wrong)


@counted(f"{COUNT:,} random and mutated states")
def garbage_states(rig: Rig, number: int) -> Try:
    """On the state's key; the edge runtime counts each by reason."""
    payloads = list(mutated(encode(make_state(1, session=_FOREIGN)), COUNT, number))
    wanted = Counter(_reason(wire.decode_state(payload)) for payload in payloads)
    before = rig.edge_counts()
    begin_s = time.monotonic()
    _put_all(rig, "state", payloads)
    end_s = time.monotonic()
    return drove_on(rig, begin_s, end_s, wanted, rig.edge_counts() - before)


@counted_at_its_end(f"{COUNT:,} random and mutated commands; future, old, wrong size")
def garbage_commands(rig: Rig, number: int) -> Try:
    """On the command's key, and commands of other times; the simulator counts them."""
    payloads = list(mutated(encode(_command(rig, session=_FOREIGN)), COUNT, number))
    wanted = Counter(_reason(wire.decode_command(payload)) for payload in payloads)
    begin_s = time.monotonic()
    _put_all(rig, "command", payloads)
    others = {
        "unknown_step": _command(rig, ahead=1000),
        "stale": _command(rig, ahead=-3),
        "action_size": _command(rig, action=[0.1, 0.2]),
    }
    for reason, command in others.items():
        rig.probe.put("command", encode(command))
        wanted[reason] += 1
    end_s = time.monotonic()
    # Its own answers are in order, so that every rejection is one of these.
    rig.end_drive()
    return drove_on(rig, begin_s, end_s, wanted, rig.simulator_counts())


@counted(f"{COUNT:,} random and mutated feedback messages", expected="drives on")
def garbage_feedback(rig: Rig, number: int) -> Try:
    """On the feedback's key: nobody drives by it, and nobody minds."""
    feedback = Feedback(
        vehicle="mock", session=_FOREIGN, episode=0, step=0, mode="drive", action=[0.1],
        speed_mps=1.0, self_braking=False, faults=[], sent_ns=time.time_ns(),
    )  # fmt: skip
    begin_s = time.monotonic()
    _put_all(rig, "feedback", mutated(encode(feedback), COUNT, number))
    return drove_on(rig, begin_s, time.monotonic())


@counted_at_its_end(f"{COUNT:,} random and mutated health messages")
def garbage_health(rig: Rig, number: int) -> Try:
    """On the health's key, which the simulator reads for its report, and counts."""
    wait_until(lambda: rig.probe.health, "a health message")
    valid: Health = rig.probe.health[-1]
    payloads = list(mutated(encode(valid), COUNT, number))
    decoded = [wire.decode_health(payload) for payload in payloads]
    wanted = Counter(f"health_{m.reason.value}" for m in decoded if isinstance(m, Rejection))
    begin_s = time.monotonic()
    _put_all(rig, "health", payloads)
    end_s = time.monotonic()
    rig.end_drive()
    counts = rig.simulator_counts()
    unread = Counter({name: n for name, n in counts.items() if name.startswith("health_")})
    return drove_on(rig, begin_s, end_s, wanted, unread)


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
    rig.sender.step += 3
    step = rig.sender.step
    rig.sender.send(make_state(step - 1))
    rig.probe.put("state", encode(make_state(step - 2)))
    wanted["stale"] += 1
    rig.sender.send(make_state(step, sent_ns=time.time_ns() + _HOUR_NS))


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


def mutated(valid: bytes, count: int, seed: int) -> Iterator[bytes]:
    """``count`` payloads; the n-th is the same for the same seed. Some may be valid still."""
    generator = np.random.default_rng(seed)
    for _ in range(count):
        yield _mutant(valid, generator)


def _mutant(valid: bytes, generator: np.random.Generator) -> bytes:
    def below(limit: int) -> int:
        return int(generator.integers(limit))

    match below(7):
        case 0:
            return generator.bytes(below(_LONGEST_RANDOM))
        case 1:
            data = bytearray(valid)
            for _ in range(1 + below(4)):
                data[below(len(data))] ^= 1 << below(8)
            return bytes(data)
        case 2:
            return valid[: below(len(valid))]
        case 3:
            return valid + generator.bytes(1 + below(_SPLICED))
        case 4:  # a stretch of it replaced by a random one of another length
            begin, end = sorted((below(len(valid)), below(len(valid))))
            return valid[:begin] + generator.bytes(below(_SPLICED)) + valid[end:]
    names = sorted(msgspec.msgpack.decode(valid))
    name = names[below(len(names))]
    if below(2):
        return without(valid, name)
    return with_fields(valid, **{name: _ABSURD[below(len(_ABSURD))]})


def with_fields(valid: bytes, **changes: object) -> bytes:
    """The same MessagePack map with fields replaced by values of any type."""
    return msgspec.msgpack.encode({**msgspec.msgpack.decode(valid), **changes})


def without(valid: bytes, name: str) -> bytes:
    """The same map without one of its fields."""
    fields = msgspec.msgpack.decode(valid)
    del fields[name]
    return msgspec.msgpack.encode(fields)


_ABSURD: tuple[object, ...] = (
    None, True, -1, 2**63, -(2**63), float("nan"), float("inf"), 1e308, "", "x" * 300,
    b"", b"\xff" * 70_000, [], [float("nan")], [2.0], [[[[]]]], {}, {"a": {"b": {}}}, "drive",
)  # fmt: skip
