"""The wire: its keys, and its messages as MessagePack maps that are validated on arrival.

Pure: no clock and no socket. A decoder never raises: it returns the message, or a Rejection. The
policy's manifest says what an observation and an action must be (manifest.py). Contract, section 3.
"""

from __future__ import annotations

import math
import re
from enum import Enum
from functools import partial
from typing import Any, Dict, List, NamedTuple, Optional, TypeVar, Union

import msgspec

from edge_runtime.util import UserError

SCHEMA = 2

DRIVE = "drive"
SAFE_STOP = "safe_stop"
COMMAND_MODES = (DRIVE, SAFE_STOP)

MAX_PAYLOAD_BYTES = 64 * 1024
MAX_STATE_BYTES = 4 * 1024 * 1024
"""Of any state; the policy's manifest sets a lower limit for the states it is sent."""
MAX_TEXT_CHARS = 256
MAX_PLAN, MAX_RIDE_S = 10, 1.0  # further actions of a command at most, and for how long

DEFAULT_VEHICLE_ID = "hunter01"  # of both ends, so that a single vehicle needs no option

TOPICS = (
    "state",  # simulator to edge, once a control period
    "command",  # edge to simulator and vehicle, in answer to it
    "feedback",  # vehicle to all
    "health",  # edge to all
    "alive",  # liveliness token of the edge
    "status",  # queryable of the edge: JSON
    "rearm",  # queryable of the edge: an operator lets it drive again
)
FEEDBACK_HZ, HEALTH_HZ = 20.0, 2.0  # sent at least so often
_VEHICLE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


def check_vehicle_id(vehicle_id: str) -> str:
    """Return the id; UserError if it could not be part of a key."""
    if not _VEHICLE_ID.fullmatch(vehicle_id):
        raise UserError(f"vehicle id {vehicle_id!r} is not valid: use 1 to 64 of A-Z a-z 0-9 _ -")
    return vehicle_id


def key(vehicle_id: str, topic: str) -> str:
    """Return the Zenoh key of one of TOPICS, as in `phil/hunter01/state`."""
    assert topic in TOPICS, topic
    return f"phil/{check_vehicle_id(vehicle_id)}/{topic}"


class Reason(str, Enum):
    """Why a message was rejected. The newest-state logic (latest.py) adds the last four."""

    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    SCHEMA = "schema"
    OBSERVATION = "observation"
    NOT_FINITE = "not_finite"
    STALE = "stale"
    DUPLICATE = "duplicate"
    FOREIGN_SESSION = "foreign_session"
    FUTURE = "future"
    CERTIFICATE = "certificate"  # the far end's has expired, or our own


class Rejection(NamedTuple):
    """A message that was not accepted: the reason that is counted, and a sentence for the log."""

    reason: Reason
    detail: str


class State(msgspec.Struct, frozen=True, kw_only=True):
    """The simulator's state at one step. `observation` holds each array's bytes, in C order.

    `speed_mps` is None where the environment has none. `task` is `manifest.Task.text`, left out
    where unknown. `heard` counts the distinct commands received; the last was sent at
    `heard_sent_ns` by the edge's clock, and received at `heard_ns` by the simulator's.
    """

    session: str
    episode: int
    step: int
    sim_time_s: float
    sent_ns: int
    observation: Dict[str, bytes]
    speed_mps: Optional[float]
    final: bool
    task: Union[str, msgspec.UnsetType] = msgspec.UNSET
    heard: Union[int, msgspec.UnsetType] = msgspec.UNSET
    heard_sent_ns: Union[int, msgspec.UnsetType] = msgspec.UNSET
    heard_ns: Union[int, msgspec.UnsetType] = msgspec.UNSET
    schema: int = SCHEMA


class Command(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to the state (session, episode, step); it is its own heartbeat.

    `received_ns` and `sent_ns` are the edge's wall clock, `inference_ns` is a duration. `plan`
    holds the actions of the next periods, where nothing newer comes; mostly left out.
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
    plan: Union[List[List[float]], msgspec.UnsetType] = msgspec.UNSET
    schema: int = SCHEMA


class Feedback(msgspec.Struct, frozen=True, kw_only=True):
    """The vehicle's report. `action` is what the actuators have reached, not what was asked.

    `episode` and `step` are those of the last command taken (-1 before the first). `speed_mps` and
    `commanded_speed_mps` (asked of it now) are its own; `scenario_speed_mps` is its speed as the
    scenario's car. Values that the driver does not know are None.
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
    """The state of the edge runtime, twice a second.

    `inference_ms` and `command_ms` (from a state's arrival to its command's sending) hold p50, p99
    and max over the last 1,024. `superseded` counts accepted states that the policy never took,
    `rivals` other runtimes with this vehicle id. `temperature_c` is the board's hottest sensor.
    `vehicle_fault` says what is wrong with the vehicle, or what has stopped it. `link` is
    `LinkQuality.measured`. The operator's bounds follow. Values not known, or not set, are None.
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
    link: Dict[str, float] = msgspec.field(default_factory=dict)
    max_speed_mps: Optional[float] = None
    max_steering_rad: Optional[float] = None
    leash_m: Optional[float] = None
    leash_left_m: Optional[float] = None
    schema: int = SCHEMA


Message = Union[State, Command, Feedback, Health]


class Versioned(msgspec.Struct):
    """The field of every version of every message."""

    schema: int


_M = TypeVar("_M", State, Command, Feedback, Health)
_DECODERS: Dict[Any, Any] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in (Versioned, State, Command, Feedback, Health)
}
_ENCODER = msgspec.msgpack.Encoder()
# A hostile payload makes msgspec raise these: bad bytes, bad UTF-8, nesting, absurd lengths.
_DECODE_ERRORS = (msgspec.MsgspecError, ValueError, RecursionError, MemoryError, OverflowError)


def encode(message: Message) -> bytes:
    """Encode a message as a MessagePack map. Nothing is checked here: the receiver does that."""
    return _ENCODER.encode(message)


def decode_state(payload: bytes, max_bytes: int = MAX_STATE_BYTES) -> Union[State, Rejection]:
    """Decode a State with finite numbers and any observation (`Layout.decode` checks that)."""
    return _decode(payload, State, max_bytes)


def is_foreign(state: State, task: str) -> bool:
    """Return whether a state names another task than this; both as `manifest.Task.text`."""
    return state.task not in (msgspec.UNSET, task)


def decode_command(payload: bytes) -> Union[Command, Rejection]:
    """Decode a Command of a known mode with finite numbers.

    A drive command needs an action, and plan rows of its length. The plan of a stop is dropped.
    """
    command = _decode(payload, Command)
    if isinstance(command, Rejection):
        return command
    if command.mode not in COMMAND_MODES:
        return Rejection(Reason.MALFORMED, f"mode {command.mode!r} is neither drive nor safe_stop")
    if command.mode == SAFE_STOP:
        return msgspec.structs.replace(command, plan=msgspec.UNSET)
    if not command.action:
        return Rejection(Reason.MALFORMED, "action is empty")
    plan = command.plan or []
    if len(plan) > MAX_PLAN or any(len(row) != len(command.action) for row in plan):
        return Rejection(Reason.MALFORMED, f"plan: {len(plan)} actions, or of another length")
    return command


def _decode(
    payload: bytes, kind: type[_M], max_bytes: int = MAX_PAYLOAD_BYTES
) -> Union[_M, Rejection]:
    if len(payload) > max_bytes:
        detail = f"{len(payload)} bytes, at most {max_bytes} are read"
        return Rejection(Reason.OVERSIZED, detail)
    try:
        # The schema first: another schema's fields need not fit, and that is no malformed message.
        schema = _DECODERS[Versioned].decode(payload).schema
        if schema != SCHEMA:
            return Rejection(Reason.SCHEMA, f"schema {schema}, this side speaks {SCHEMA}")
        message: _M = _DECODERS[kind].decode(payload)
    except _DECODE_ERRORS as error:
        return Rejection(Reason.MALFORMED, str(error))
    least = -1 if kind is Feedback else 0  # before its first command a vehicle reports step -1
    for name, value in zip(message.__struct_fields__, msgspec.structs.astuple(message)):
        refusal = _refusal(name, value, least)
        if refusal is not None:
            return refusal
    return message


decode_feedback = partial(_decode, kind=Feedback)
decode_health = partial(_decode, kind=Health)
"""Decode a Feedback or a Health with finite numbers."""


def _refusal(name: str, value: Any, least: int) -> Optional[Rejection]:
    """Refuse floats that are not finite, long texts and counts below `least`, also inside."""
    kind = type(value)  # much quicker than isinstance, and every state passes here
    if kind is int and value < least:
        return Rejection(Reason.MALFORMED, f"{name} is {value}, below the least value")
    if kind is float and not math.isfinite(value):
        return Rejection(Reason.NOT_FINITE, f"{name} is {value}")
    if kind is str and len(value) > MAX_TEXT_CHARS:
        return Rejection(Reason.MALFORMED, f"{name} is longer than {MAX_TEXT_CHARS} characters")
    if kind is dict or kind is list:
        for place, item in value.items() if kind is dict else enumerate(value):
            refusal = _refusal(f"{name}.{place}", item, least)
            if refusal is not None:
                return refusal
    return None
