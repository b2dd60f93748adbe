"""The messages on the wire: MessagePack maps, validated on arrival. Contract, section 3.

Pure: no clock and no socket. A decoder never raises: it returns the message, or a Rejection
that says why it never reaches the policy. The keys stand in topics.py, the messages in
messages.py; both are re-exported here.
"""

from __future__ import annotations

import math
from typing import Any, Dict, Iterator, Tuple, Type, TypeVar, Union

import msgspec

from edge_runtime.messages import (
    COMMAND_MODES,
    DRIVE,
    FRAMES_BYTES,
    FRAMES_SHAPE,
    SAFE_STOP,
    SCHEMA,
    Command,
    Feedback,
    Health,
    Message,
    Reason,
    Rejection,
    State,
)
from edge_runtime.topics import CONTROL_PERIOD_S, TOPICS, Topic, check_vehicle_id, key

__all__ = [
    "COMMAND_MODES",
    "CONTROL_PERIOD_S",
    "DRIVE",
    "FRAMES_BYTES",
    "FRAMES_SHAPE",
    "MAX_PAYLOAD_BYTES",
    "MAX_TEXT_CHARS",
    "SAFE_STOP",
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

MAX_PAYLOAD_BYTES = 64 * 1024
MAX_TEXT_CHARS = 256


class _Envelope(msgspec.Struct):
    schema: int


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
    least = _LEAST.get(type(message), 0)
    for name, value in _leaves(message):
        if isinstance(value, float):
            if not math.isfinite(value):
                return Rejection(Reason.NOT_FINITE, f"{name} is {value}")
        elif isinstance(value, str):
            if len(value) > MAX_TEXT_CHARS:
                detail = f"{name} is longer than {MAX_TEXT_CHARS} characters"
                return Rejection(Reason.MALFORMED, detail)
        elif isinstance(value, int) and value < least:
            return Rejection(Reason.MALFORMED, f"{name} is {value}, below the least value")
    return message


# A vehicle that has not yet had a command reports step -1.
_LEAST: Dict[Any, int] = {Feedback: -1}


def _leaves(message: Message) -> Iterator[Tuple[str, Any]]:
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if isinstance(value, dict):
            for label, item in value.items():
                yield f"{name}.{label}", item
        elif isinstance(value, list):
            for index, item in enumerate(value):
                yield f"{name}[{index}]", item
        else:
            yield name, value
