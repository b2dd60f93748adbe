"""The wire: its keys, and its messages as MessagePack maps that are validated on arrival.

Pure: no clock and no socket. A decoder never raises: it returns the message, or a Rejection that
says why it never reaches the policy. A field that came after schema 1 was first spoken has a
default, so that both sides of a mixed pair go on understanding each other. Contract, section 3.
"""

from __future__ import annotations

import math
import re
from enum import Enum
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Tuple, Type, TypeVar, Union

import msgspec
import numpy as np

from edge_runtime.util import UserError

CONTROL_PERIOD_S = 0.1
SCHEMA = 1
FRAMES_SHAPE = (2, 45, 80)
FRAMES_BYTES = 2 * 45 * 80

DRIVE = "drive"
SAFE_STOP = "safe_stop"
COMMAND_MODES = (DRIVE, SAFE_STOP)

MAX_PAYLOAD_BYTES = 64 * 1024
MAX_TEXT_CHARS = 256

DEFAULT_VEHICLE_ID = "hunter01"  # of both ends, so that a single vehicle needs no option


# How often a second each of them is sent.
TOPICS: Dict[str, float] = {
    "state": 1 / CONTROL_PERIOD_S,  # simulator to edge
    "command": 1 / CONTROL_PERIOD_S,  # edge to simulator and vehicle
    "feedback": 20.0,  # vehicle to all
    "health": 2.0,  # edge to all
    "alive": 0.0,  # liveliness token of the edge
    "status": 0.0,  # queryable of the edge: JSON
    "rearm": 0.0,  # queryable of the edge: an operator lets it drive again
}
_VEHICLE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


def check_vehicle_id(vehicle_id: str) -> str:
    """The id itself; UserError if it could not be part of a key."""
    if not _VEHICLE_ID.fullmatch(vehicle_id):
        raise UserError(f"vehicle id {vehicle_id!r} is not valid: use 1 to 64 of A-Z a-z 0-9 _ -")
    return vehicle_id


def key(vehicle_id: str, topic: str) -> str:
    """The Zenoh key of a row of TOPICS, as in `phil/hunter01/state`."""
    assert topic in TOPICS, topic
    return f"phil/{check_vehicle_id(vehicle_id)}/{topic}"


class Reason(str, Enum):
    """Why a message was rejected. The newest-state logic (latest.py) adds the last four."""

    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    SCHEMA = "schema"
    FRAMES_SIZE = "frames_size"
    NOT_FINITE = "not_finite"
    STALE = "stale"
    DUPLICATE = "duplicate"
    FOREIGN_SESSION = "foreign_session"
    FUTURE = "future"


class Rejection(NamedTuple):
    """A message that was not accepted: the reason that is counted, and a sentence for the log."""

    reason: Reason
    detail: str


class State(msgspec.Struct, frozen=True, kw_only=True):
    """What the simulator sees at one step. `frames`: 2x45x80 uint8 in C order, [t-1, t].

    `task` is what its environment is for, as `manifest.task_text` says it; left out where unknown.
    """

    session: str
    episode: int
    step: int
    sim_time_s: float
    sent_ns: int
    frames: bytes
    speed_mps: float
    final: bool
    task: Union[str, msgspec.UnsetType] = msgspec.UNSET
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
    `speed_mps` and `commanded_speed_mps` (what a vehicle that takes a speed is asked for now) are
    the vehicle's own; `scenario_speed_mps` is the speed of the scenario's car by the similarity.
    These two and `battery_v` are None where the driver does not know them.
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
    scenario_speed_mps: Optional[float] = None
    commanded_speed_mps: Optional[float] = None
    battery_v: Optional[float] = None
    schema: int = SCHEMA


class Health(msgspec.Struct, frozen=True, kw_only=True):
    """How the edge runtime is, twice a second.

    `inference_ms` and `command_ms` (from a state's arrival to its command's sending) hold p50,
    p99 and max over the last 1,024 (0 before the first). `superseded` counts accepted states that
    a newer one replaced before the policy took them, `rivals` other runtimes that were seen under
    this vehicle id. `temperature_c` is the board's hottest sensor, None where it has none.
    `vehicle_fault` is what is wrong with the vehicle in words, or what has stopped it and waits for
    a re-arm; empty if nothing.
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
    command_ms: Dict[str, float] = msgspec.field(default_factory=dict)
    temperature_c: Optional[float] = None
    load_1min: float = 0.0
    rss_mb: float = 0.0
    rivals: int = 0
    vehicle_fault: str = ""
    schema: int = SCHEMA


Message = Union[State, Command, Feedback, Health]


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
        detail = f"frames hold {len(state.frames)} bytes, not {FRAMES_BYTES}"
        return Rejection(Reason.FRAMES_SIZE, detail)
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
        detail = f"{len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are read"
        return Rejection(Reason.OVERSIZED, detail)
    try:
        # The schema first: another schema's fields need not fit, and that is no malformed message.
        schema = _ENVELOPE.decode(payload).schema
        if schema != SCHEMA:
            return Rejection(Reason.SCHEMA, f"schema {schema}, this side speaks {SCHEMA}")
        message: _M = _DECODERS[kind].decode(payload)
    except _DECODE_ERRORS as error:
        return Rejection(Reason.MALFORMED, str(error))
    # Finite floats, short texts and no negative counts, for every field of every message.
    least = -1 if kind is Feedback else 0  # before its first command a vehicle reports step -1
    for name, value in _leaves(message):
        if isinstance(value, float) and not math.isfinite(value):
            return Rejection(Reason.NOT_FINITE, f"{name} is {value}")
        if isinstance(value, str) and len(value) > MAX_TEXT_CHARS:
            detail = f"{name} is longer than {MAX_TEXT_CHARS} characters"
            return Rejection(Reason.MALFORMED, detail)
        if isinstance(value, int) and value < least:
            return Rejection(Reason.MALFORMED, f"{name} is {value}, below the least value")
    return message


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
