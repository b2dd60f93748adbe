"""Faults of messages: invalid, foreign, too many, too large, and random bytes."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import msgspec
import numpy as np

from bridge.messages import DECODERS
from edge_runtime import wire
from edge_runtime.cli import BAD_INPUT
from edge_runtime.manifest import Layout, Task
from edge_runtime.wire import DRIVE, Command, Feedback, Message, Rejection, encode
from hil_tests.faults.rig import Rig, noisy_state
from hil_tests.faults.rows import Row, Try, drives_on
from hil_tests.processes import wait_until

FLOOD_PER_S, FLOOD_S = 10_000, 2.0
COUNT, PER_S = 10_000, 2_500
"""Number of garbage messages and their rate: a load beside which the drive can still go on."""
_FOREIGN = "garbage"
"""Session of the messages before their mutation: a mutant that is valid is rejected by it."""
_HOUR_NS = 3600 * 1_000_000_000


def bad_states(rig: Rig) -> Try:
    sent: Counter[str] = Counter()
    for turn in range(50):
        with rig.sender.lock:
            for reason, payload in _bad_of(rig.sender.step, rig.task):
                rig.probe.put("state", payload)
                sent[reason] += 1
            # From now on the states' stamps are in the future, which is no reason to stop.
            rig.sender.ahead_ns += _HOUR_NS * (turn == 25)
            rig.sender.step += 2  # Two states have overtaken one another.
            rig.sender.send(rig.sender.state(rig.sender.step))
            rig.probe.put("state", encode(rig.sender.state(rig.sender.step - 1)))
            sent["stale"] += 1
        time.sleep(rig.period_s / 2)
    return Try(rejected=sent)


def _bad_of(step: int, task: Task) -> Iterable[tuple[str, bytes]]:
    state, (name, *_) = noisy_state(step + 1, task), task.observation
    large, small = ({**state.observation, name: bytes(n)} for n in (wire.MAX_PAYLOAD_BYTES, 3))
    valid = encode(state)
    yield "malformed", valid[: len(valid) // 2]
    yield "malformed", without(valid, "observation")
    yield "oversized", with_fields(valid, observation=large)
    yield "schema", with_fields(valid, schema=1)
    yield "observation", with_fields(valid, observation=small)
    yield "not_finite", with_fields(valid, speed_mps=float("nan"))
    yield "duplicate", encode(noisy_state(step, task))
    yield "stale", encode(noisy_state(step - 1, task))


def oversized(rig: Rig) -> Try:
    for _ in range(5):
        rig.probe.put("state", bytes(10_000_000))
        time.sleep(rig.period_s)
    return Try(rejected={"oversized": 5})


def flood(rig: Rig) -> Try:
    rig.sender.running.clear()
    begin_s, sent = time.monotonic(), 0
    while (now_s := time.monotonic()) < begin_s + FLOOD_S:
        while sent < (now_s - begin_s) * FLOOD_PER_S:
            rig.sender.send_next()
            sent += 1
        time.sleep(0.001)
    end_s = time.monotonic()
    rig.sender.running.set()
    return Try(rig.timeline.longest_gap_s(begin_s, end_s), rig.recovered_after_s(end_s))


def second_simulator(rig: Rig) -> Try:
    steps = round(2.0 / rig.period_s)
    for step in range(steps):
        # Noted, because it may be answered if the first simulator is silent for 2 T.
        rig.timeline.states[("second", rig.number, step)] = time.monotonic()
        state = noisy_state(step, rig.task, session="second", episode=rig.number)
        rig.probe.put("state", encode(state))
        time.sleep(rig.period_s)
    return Try(rejected={"foreign_session": steps})


def second_edge(rig: Rig) -> Try:
    second = rig.start_edge()
    status = second.wait()
    time.sleep(rig.period_s)  # Until the probe has received the last commands of both.
    # Drives only: the simulator also takes the second one's last safe stop, which is safe.
    answers = Counter(c.place for c in rig.timeline.commands if c.mode == DRIVE)
    stale = {"stale": sum(count - 1 for count in answers.values())}
    ended = f"the second one ended with status {status}: {second.lines[-1:]}"
    return Try(rejected=stale, wrong=[] if status == BAD_INPUT else [ended])


def garbage_states(rig: Rig) -> Try:
    return _put_garbage(rig, "state", noisy_state(1, rig.task, session=_FOREIGN))


def garbage_commands(rig: Rig) -> Try:
    done = _put_garbage(rig, "command", _command(rig, session=_FOREIGN))
    others = {
        "unknown_step": _command(rig, ahead=1000),
        "stale": _command(rig, ahead=-3),
        "action_size": _command(rig, action=[0.1] * (len(rig.task.action) + 1)),
    }
    for command in others.values():
        rig.probe.put("command", encode(command))
    # The edge's own answers are in order, so that every rejection is one of these.
    return Try(rejected=Counter(done.rejected) + Counter(others.keys()))


def _command(rig: Rig, ahead: int = 0, **changes: object) -> Command:
    session, episode, step = rig.timeline.commands[-1].place
    middle = [0.45 * one.low + 0.55 * one.high for one in rig.task.action]
    fields: dict[str, Any] = {
        "session": session, "episode": episode, "step": max(0, step + ahead), "mode": DRIVE,
        "action": middle, "policy_id": "p", "received_ns": 1, "inference_ns": 1,
        "sent_ns": time.time_ns(),
    }  # fmt: skip
    return Command(**{**fields, **changes})


def garbage_feedback(rig: Rig) -> Try:
    feedback = Feedback(
        vehicle="robot", session=_FOREIGN, episode=0, step=0, mode=DRIVE, action=[0.5],
        speed_mps=1.0, self_braking=False, faults=[], sent_ns=1,
    )  # fmt: skip
    _put_garbage(rig, "feedback", feedback)
    return Try()


def garbage_health(rig: Rig) -> Try:
    wait_until(lambda: rig.timeline.health, "a health message")
    _put_garbage(rig, "health", rig.timeline.health[-1])
    return Try()


def _put_garbage(rig: Rig, topic: str, valid: Message) -> Try:
    """Send COUNT mutations of a message; those still valid belong to a foreign session."""
    decode = Layout(rig.task).decode if topic == "state" else DECODERS[topic]
    legal = "foreign_session" if topic in ("state", "command") else ""
    sent: Counter[str] = Counter()
    begin_s = time.monotonic()
    for number, payload in enumerate(mutated(encode(valid), COUNT, rig.number)):
        rig.probe.put(topic, payload)
        found = decode(payload)
        sent[found.reason.value if isinstance(found, Rejection) else legal] += 1
        if number % 25 == 0:
            time.sleep(max(0.0, begin_s + number / PER_S - time.monotonic()))
    del sent[""]
    return Try(rejected=sent)


def mutated(valid: bytes, count: int, seed: int) -> Iterator[bytes]:
    """Yield ``count`` mutations of a message from a seed. Some may still be valid."""
    generator = np.random.default_rng(seed)
    names = sorted(msgspec.msgpack.decode(valid))
    for _ in range(count):
        kind, name = generator.integers(4), names[generator.integers(len(names))]
        begin, end = sorted(generator.integers(len(valid), size=2))
        if kind == 0:  # a stretch of it replaced by a random one of another length
            yield valid[:begin] + generator.bytes(int(generator.integers(512))) + valid[end:]
        elif kind == 1:  # bits flipped, or cut off
            data = bytearray(valid[: end + 1])
            data[begin] ^= 1 << generator.integers(8)
            yield bytes(data)
        elif kind == 2:
            yield without(valid, name)
        else:
            yield with_fields(valid, **{name: _ABSURD[generator.integers(len(_ABSURD))]})


def with_fields(valid: bytes, **changes: object) -> bytes:
    return msgspec.msgpack.encode({**msgspec.msgpack.decode(valid), **changes})


def without(valid: bytes, name: str) -> bytes:
    fields = msgspec.msgpack.decode(valid)
    del fields[name]
    return msgspec.msgpack.encode(fields)


_ABSURD: tuple[object, ...] = (
    None, True, -1, 2**63, -(2**63), float("nan"), float("inf"), 1e308, "", "x" * 300,
    b"", b"\xff" * 70_000, [], [float("nan")], [2.0], [[[[]]]], {}, {"a": {"b": {}}}, "drive",
)  # fmt: skip
_COUNTED: dict[str, Any] = {"expected": "drives on; each rejected and counted by reason"}
_BY_EDGE, _BY_SIMULATOR = ({**_COUNTED, "counted": end} for end in ("edge", "simulator"))
_ENDS: dict[str, Any] = {"flows": False}  # The simulator reports its counts when the drive ends
ROWS = [
    drives_on("bad_states", "Truncated, wrong schema, NaN, old, repeated, reordered, future states",
              bad_states, **_BY_EDGE, rig={"sender": True}),
    drives_on("oversized", "States of 10 MB", oversized, **_BY_EDGE),
    Row("flood", "10,000 states a second for 2 s", "answers the newest, or stops", flood,
        rig={"sender": True}, alone=True),
    drives_on("second_simulator", "A second simulator with the same id", second_simulator,
              **_BY_EDGE),
    drives_on("second_edge", "A second edge runtime with the same id", second_edge,
              "second one refuses; drives on", counted="simulator", **_ENDS),
    drives_on("garbage_states", "10,000 random and mutated states", garbage_states, **_BY_EDGE),
    drives_on("garbage_commands", "10,000 random and mutated commands; future, old, wrong size",
              garbage_commands, **_BY_SIMULATOR, **_ENDS),
    drives_on("garbage_feedback", "10,000 random and mutated feedback messages", garbage_feedback),
    drives_on("garbage_health", "10,000 random and mutated health messages", garbage_health,
              **_BY_SIMULATOR, **_ENDS),
]  # fmt: skip
