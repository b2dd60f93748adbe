"""The messages on the wire: MessagePack maps, validated on arrival. Contract, section 3.

Pure: no clock and no socket. A decoder never raises: it returns the message, or a Rejection
that says why it never reaches the policy. The keys stand in topics.py and are re-exported here.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Any, Dict, List, NamedTuple, Tuple, Type, TypeVar, Union

import msgspec
import numpy as np

from edge_runtime.topics import CONTROL_PERIOD_S, TOPICS, Topic, check_vehicle_id, key

__all__ = [
    "CONTROL_PERIOD_S",
    "FRAMES_BYTES",
    "FRAMES_SHAPE",
    "MAX_PAYLOAD_BYTES",
    "SCHEMA",
    "TOPICS",
    "Command",
    "Feedback",
    "Health",
    "Message",
    "Reason",
    "Rejection",
    "State",
    "Topic",
    "check_vehicle_id",
    "decode_command",
    "decode_feedback",
    "decode_health",
    "decode_state",
    "encode",
    "key",
]

SCHEMA = 1
MAX_PAYLOAD_BYTES = 64 * 1024
MAX_TEXT_CHARS = 256
FRAMES_SHAPE = (2, 45, 80)
FRAMES_BYTES = 2 * 45 * 80

DRIVE = "drive"
SAFE_STOP = "safe_stop"
COMMAND_MODES = (DRIVE, SAFE_STOP)


class Reason(str, Enum):
    """Why a message was rejected. The newest-state logic (latest.py) adds the last three."""

    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    SCHEMA = "schema"
    FRAMES_SIZE = "frames_size"
    NOT_FINITE = "not_finite"
    STALE = "stale"
    DUPLICATE = "duplicate"
    FOREIGN_SESSION = "foreign_session"


class Rejection(NamedTuple):
    """A message that was not accepted: the reason that is counted, and a sentence for the log."""

    reason: Reason
    detail: str


class State(msgspec.Struct, frozen=True, kw_only=True):
    """What the simulator sees at one step. `frames`: 2x45x80 uint8 in C order, [t-1, t]."""

    session: str
    episode: int
    step: int
    sim_time_s: float
    sent_ns: int
    frames: bytes
    speed_mps: float
    final: bool
    schema: int = SCHEMA

    def frames_array(self) -> np.ndarray:
        """The frames as a read-only uint8 array of shape [2, 45, 80], not copied."""
        return np.frombuffer(self.frames, dtype=np.uint8).reshape(FRAMES_SHAPE)


class Command(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to the state (session, episode, step); it is its own heartbeat.

    `received_ns` and `sent_ns` are the edge's wall clock, `inference_ns` is a duration.
    """

    session: str
    episode: int
    step: int
    mode: str
    action: List[float]
    policy_id: str
    received_ns: int
    inference_ns: int
    sent_ns: int
    reason: str = ""
    schema: int = SCHEMA


class Feedback(msgspec.Struct, frozen=True, kw_only=True):
    """What the vehicle does. `action` is what the actuators have reached, not what was asked.

    `episode` and `step` are those of the last command taken (-1 before the first one).
    """

    vehicle: str
    session: str
    episode: int
    step: int
    mode: str
    action: List[float]
    speed_mps: float
    self_braking: bool
    faults: List[str]
    sent_ns: int
    schema: int = SCHEMA


class Health(msgspec.Struct, frozen=True, kw_only=True):
    """How the edge runtime is, twice a second.

    `inference_ms` holds p50, p99 and max over the last 1,024 inferences (0 before the first).
    `superseded` counts accepted states that a newer one replaced before the policy took them.
    """

    vehicle_id: str
    vehicle: str
    mode: str
    reason: str
    needs_rearm: bool
    accepted: int
    superseded: int
    rejected: Dict[str, int]
    deadline_misses: int
    safe_stops: int
    policy_id: str
    inference_ms: Dict[str, float]
    uptime_s: float
    sent_ns: int
    schema: int = SCHEMA


class _Envelope(msgspec.Struct):
    schema: int


Message = Union[State, Command, Feedback, Health]
_M = TypeVar("_M", State, Command, Feedback, Health)
_ENVELOPE = msgspec.msgpack.Decoder(_Envelope)
_DECODERS: Dict[Any, Any] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in (State, Command, Feedback, Health)
}
_ENCODER = msgspec.msgpack.Encoder()
# What a hostile payload makes msgspec raise: bad bytes, bad UTF-8, nesting, absurd lengths.
_DECODE_ERRORS = (msgspec.MsgspecError, ValueError, RecursionError, MemoryError, OverflowError)


def encode(message: Message) -> bytes:
    """The MessagePack map of a message. Nothing is checked here: the receiver does that."""
    return _ENCODER.encode(message)


def decode_state(payload: bytes) -> Union[State, Rejection]:
    """A State whose frames have the right size and whose numbers are finite, or why not."""
    state = _decode(payload, State)
    if isinstance(state, State) and len(state.frames) != FRAMES_BYTES:
        return Rejection(
            Reason.FRAMES_SIZE, f"frames hold {len(state.frames)} bytes, not {FRAMES_BYTES}"
        )
    return state


def decode_command(payload: bytes) -> Union[Command, Rejection]:
    """A Command of a known mode with at least one action, each in [-1, 1], or why not."""
    command = _decode(payload, Command)
    if isinstance(command, Rejection):
        return command
    if command.mode not in COMMAND_MODES:
        return Rejection(Reason.MALFORMED, f"mode {command.mode!r} is neither drive nor safe_stop")
    if not command.action or any(abs(value) > 1.0 for value in command.action):
        return Rejection(Reason.MALFORMED, "action is empty or leaves [-1, 1]")
    return command


def decode_feedback(payload: bytes) -> Union[Feedback, Rejection]:
    """A Feedback with finite numbers, or why not."""
    return _decode(payload, Feedback)


def decode_health(payload: bytes) -> Union[Health, Rejection]:
    """A Health with finite numbers, or why not."""
    return _decode(payload, Health)


def _decode(payload: bytes, kind: Type[_M]) -> Union[_M, Rejection]:
    if len(payload) > MAX_PAYLOAD_BYTES:
        return Rejection(
            Reason.OVERSIZED, f"{len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are read"
        )
    try:
        # The schema first: another schema's fields need not fit, and that is no malformed message.
        schema = _ENVELOPE.decode(payload).schema
        if schema != SCHEMA:
            return Rejection(Reason.SCHEMA, f"schema {schema}, this side speaks {SCHEMA}")
        message: _M = _DECODERS[kind].decode(payload)
    except _DECODE_ERRORS as error:
        return Rejection(Reason.MALFORMED, str(error))
    return _check_fields(message)


def _check_fields(message: _M) -> Union[_M, Rejection]:
    """Finite floats, short texts and no negative counts, for every field of every message."""
    for name, value in _leaves(message):
        if isinstance(value, float) and not math.isfinite(value):
            return Rejection(Reason.NOT_FINITE, f"{name} is {value}")
        if isinstance(value, str) and len(value) > MAX_TEXT_CHARS:
            return Rejection(Reason.MALFORMED, f"{name} is longer than {MAX_TEXT_CHARS} characters")
        if isinstance(value, int) and value < _LEAST.get(type(message), 0):
            return Rejection(Reason.MALFORMED, f"{name} is {value}, below the least value")
    return message


# A vehicle that has not yet had a command reports step -1.
_LEAST: Dict[Any, int] = {Feedback: -1}


def _leaves(message: Message) -> List[Tuple[str, Any]]:
    leaves: List[Tuple[str, Any]] = []
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if isinstance(value, dict):
            leaves.extend((f"{name}.{label}", item) for label, item in value.items())
        elif isinstance(value, list):
            leaves.extend((f"{name}[{index}]", item) for index, item in enumerate(value))
        else:
            leaves.append((name, value))
    return leaves
