"""The manifest of a policy file: its task, observation and action. Contract, section 4.

The control period T, the size of a state and the safe stop follow from the task.
"""

from __future__ import annotations

import math
import zlib
from typing import Any, Dict, List, Mapping, NamedTuple, Optional, Tuple, Union

import msgspec
import numpy as np

from edge_runtime import wire
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_STATE_BYTES, MAX_TEXT_CHARS, Reason, Rejection, State

MANIFEST_KEY = "phil.manifest"
MANIFEST_SCHEMA = 2
MIN_PERIOD_S, MAX_PERIOD_S = 0.01, 1.0
MAX_ACTIONS = 600  # so that a command fits its 64 KiB with a plan: 11 rows of 9 bytes a number
DTYPES = ("uint8", "int32", "int64", "float32", "bool")
OVERHEAD_BYTES = 4096  # What a state holds besides its observation, at most
_HEADS_BYTES = 10  # MessagePack's headers of a name and its bytes, at most


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One array of the observation: one input of the network, behind a batch dimension."""

    dtype: str
    shape: List[int]
    meaning: str = ""


class Action(msgspec.Struct, frozen=True, kw_only=True):
    """One number of the network's output, its physical meaning, unit and range.

    `stop` is its value in a safe stop, None to hold the last one; `slew_per_s` the fastest change
    that is sent, None for any.
    """

    name: str
    meaning: str = ""
    unit: str = ""
    low: float
    high: float
    stop: Optional[float] = None
    slew_per_s: Optional[float] = None


class Car(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The car that a driving policy was trained on, for a robot that takes its place.

    `full_steering_rad` is the front-wheel angle at action +1, positive to the left.
    `wheelbase_m` is the length that its bicycle model turns by.
    """

    throttle_mps2: float
    brake_mps2: float
    max_speed_mps: float
    full_steering_rad: float
    wheelbase_m: float

    def curvature(self, steering: float) -> float:
        """Path curvature (1/m, positive to the left) of a steering action in -1 to 1.

        highway-env's bicycle turns about its centre: slip b = atan(tan(angle) / 2), and a heading
        rate of v sin(b) / (wheelbase / 2).
        """
        slip_rad = math.atan(0.5 * math.tan(steering * self.full_steering_rad))
        return math.sin(slip_rad) / (0.5 * self.wheelbase_m)

    def steering(self, curvature: float) -> float:
        """Steering action of a path curvature; not clamped. The inverse of `curvature`."""
        slip_rad = math.asin(min(max(0.5 * self.wheelbase_m * curvature, -1.0), 1.0))
        return math.atan(2.0 * math.tan(slip_rad)) / self.full_steering_rad


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """A policy's task. `car` is None if the policy drives no car."""

    task: str
    observation: Dict[str, Entry]
    action: List[Action]
    control_period_s: float
    car: Optional[Car] = None

    @property
    def text(self) -> str:
        """All that both sides must agree on, as in `rover: camera uint8 48x64x3, left 0 to 1, ...`.

        A text that is too long for the wire ends with a checksum of the whole text.
        """
        inputs = (
            f"{name} {entry.dtype} {'x'.join(map(str, entry.shape)) or 'number'}"
            for name, entry in sorted(self.observation.items())
        )
        outputs = (f"{row.name} {row.low:g} to {row.high:g}" for row in self.action)
        text = f"{self.task}: {', '.join((*inputs, *outputs))}, every {self.control_period_s:g} s"
        if len(text) > MAX_TEXT_CHARS:
            end = f"... {zlib.crc32(text.encode()):08x}"
            text = text[: MAX_TEXT_CHARS - len(end)] + end
        return text


class Manifest(Task, frozen=True, kw_only=True):
    """A task and the policy's origin. `training`: seed, episodes, config, source revision.

    `created` is ISO 8601 in UTC. Other fields are ignored.
    """

    algorithm: str
    training: Dict[str, Any]
    created: str
    schema: int = MANIFEST_SCHEMA


def decode_manifest(text: str) -> Manifest:
    """Decode and check the manifest of a policy file. Raises UserError."""
    try:
        # The schema first: another schema's fields need not fit.
        schema = msgspec.json.decode(text.encode(), type=wire.Versioned).schema
        if schema != MANIFEST_SCHEMA:
            found = f"the manifest has schema {schema}, this runtime reads {MANIFEST_SCHEMA}"
            raise UserError(f"{found}; export the policy again")
        manifest = msgspec.json.decode(text.encode(), type=Manifest)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"the manifest in the policy file is not valid: {error}") from None
    check_task(manifest)
    return manifest


def check_task(task: Task) -> None:
    """Raise UserError, with the first reason, for a task that this runtime cannot run."""
    if not MIN_PERIOD_S <= task.control_period_s <= MAX_PERIOD_S:  # NaN fails, too
        within = f"it must lie in {MIN_PERIOD_S} to {MAX_PERIOD_S} s"
        raise UserError(f"the control period is {task.control_period_s} s; {within}")
    for name, entry in task.observation.items():
        if entry.dtype not in DTYPES or len(entry.shape) > 32 or min(entry.shape, default=1) < 1:
            found = f"the observation {name!r} is {entry.dtype} of shape {entry.shape}"
            raise UserError(f"{found}; the wire carries {', '.join(DTYPES)}, not empty")
    Layout(task)
    names = [row.name for row in task.action]
    if not task.observation or not 1 <= len(set(names)) == len(names) <= MAX_ACTIONS:
        found = f"{len(task.observation)} arrays of observation and {len(names)} actions"
        raise UserError(f"the manifest names {found}; 1 to {MAX_ACTIONS} actions, each once")
    for row in task.action:
        stop = row.low if row.stop is None else row.stop
        slew_per_s = 1.0 if row.slew_per_s is None else row.slew_per_s
        in_order = -math.inf < row.low <= stop <= row.high < math.inf and row.low < row.high
        if not (in_order and 0.0 < slew_per_s < math.inf):
            must = "finite, low below high, stop between them, slew_per_s above 0"
            raise UserError(f"the action {row} must be {must}")


class _Part(NamedTuple):
    """One array of the observation as it lies in a state."""

    name: str
    dtype: np.dtype
    shape: Tuple[int, ...]
    size: int  # bytes


class Layout:
    """A task's observation as bytes in a state. Raises UserError if no state can hold it."""

    def __init__(self, task: Task) -> None:
        self.task_text = task.text
        self.parts = []
        for name, entry in task.observation.items():
            dtype = np.dtype(entry.dtype)
            size = math.prod(entry.shape) * dtype.itemsize
            self.parts.append(_Part(name, dtype, tuple(entry.shape), size))
        self.size = sum(part.size for part in self.parts)
        # A few names fit into half of the overhead; more are counted.
        names = sum(len(name.encode()) + _HEADS_BYTES for name in task.observation)
        names = max(0, names - OVERHEAD_BYTES // 2)
        self.max_payload_bytes = self.size + names + OVERHEAD_BYTES
        if self.max_payload_bytes > MAX_STATE_BYTES:
            found = f"the observation holds {self.size + names} bytes"
            raise UserError(f"{found}; the wire carries {MAX_STATE_BYTES - OVERHEAD_BYTES} at most")

    def decode(self, payload: bytes) -> Union[State, Rejection]:
        """Decode a state. One of another task passes unchecked, so that its sender is answered."""
        state = wire.decode_state(payload, self.max_payload_bytes)
        if isinstance(state, Rejection) or wire.is_foreign(state, self.task_text):
            return state
        return self.refusal(state.observation) or state

    def refusal(self, observation: Mapping[str, bytes]) -> Optional[Rejection]:
        """Return why an observation does not fit this task; None if it fits."""
        if len(observation) != len(self.parts):
            names = ", ".join(part.name for part in self.parts)
            found = f"{len(observation)} arrays, not {names}"
            return Rejection(Reason.OBSERVATION, f"the observation holds {found}")
        for name, dtype, _, size in self.parts:
            data = observation.get(name, b"")
            if len(data) != size:
                found = f"{name} holds {len(data)} bytes, not {size}"
                return Rejection(Reason.OBSERVATION, found)
            if dtype.kind == "f" and not np.isfinite(np.frombuffer(data, dtype)).all():
                return Rejection(Reason.NOT_FINITE, f"{name} holds a number that is not finite")
            if dtype.kind == "b" and max(data) > 1:
                return Rejection(Reason.OBSERVATION, f"{name} holds bytes that are no bool")
        return None

    def arrays(self, observation: Mapping[str, bytes]) -> Dict[str, np.ndarray]:
        """View an observation that was not refused as read-only arrays; no copies."""
        return {
            name: np.frombuffer(observation[name], dtype).reshape(shape)
            for name, dtype, shape, _ in self.parts
        }
