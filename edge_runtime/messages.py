"""The messages on the wire, as they are in memory. Contract, section 3; wire.py reads and writes.

A field that came after schema 1 was first spoken has a default, so that both sides of a mixed
pair go on understanding each other.
"""

from __future__ import annotations

from enum import Enum
from typing import Dict, List, NamedTuple, Optional, Union

import msgspec
import numpy as np

SCHEMA = 1
FRAMES_SHAPE = (2, 45, 80)
FRAMES_BYTES = 2 * 45 * 80

DRIVE = "drive"
SAFE_STOP = "safe_stop"
COMMAND_MODES = (DRIVE, SAFE_STOP)


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
