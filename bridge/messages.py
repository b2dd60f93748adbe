"""The messages on the wire as listeners get them: the table of topics, and the scene.

The scene is an extension topic, ``phil/<vehicle_id>/scene``: the road from above, for viewers. The
policy never hears it: it holds what the environment knows and the vehicle does not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from edge_runtime import wire
from edge_runtime.wire import MAX_PAYLOAD_BYTES, check_vehicle_id

WIRE_TOPICS = ("state", "command", "feedback", "health", "scene")
TOKEN_TOPICS = ("alive", "simulator")
"""Liveliness tokens: of the edge runtime, and of the simulator (extension)."""


class Heard(NamedTuple):
    """One message, or one change of a liveliness token, as it arrived here."""

    key: str
    topic: str
    payload: bytes  # Of a token: 1 byte, 1 where it has come, 0 where it has gone
    arrived_ns: int
    """This process's clock: the wall's at the start, then monotonic, so that it never goes back."""
    size: int  # Bytes on the wire; a payload over the contract's limit is not kept


Point = list[float]


class SeenCar(msgspec.Struct, frozen=True):
    """One car as it is drawn; ``x``, ``y`` (m) are its centre and y grows downwards."""

    x: float
    y: float
    heading_rad: float
    length_m: float
    width_m: float
    ego: bool = False


class SeenScene(msgspec.Struct, frozen=True, kw_only=True):
    """What is drawn: roads, lane lines and the path as polylines, the goal, and the cars."""

    roads: Sequence[Sequence[Point]] = ()
    road_width_m: float = 4.0
    lane_lines: Sequence[Sequence[Point]] = ()
    path: Sequence[Point] = ()
    goal: Point | None = None
    vehicles: Sequence[SeenCar] = ()


class SceneVehicle(SeenCar, frozen=True, kw_only=True):
    """One car on the wire."""

    id: int
    speed_mps: float


class Scene(SeenScene, frozen=True, kw_only=True):
    """The scene on the wire, with its place in time and what the simulator says beside it."""

    vehicles: Sequence[SceneVehicle] = ()
    episode: int
    step: int
    sim_time_s: float
    round_trip_ms: float | None = None
    """Of the newest command: from its state sent until it acts, injected delays included."""
    answered_step: int | None = None  # The state, of this episode, that ``round_trip_ms`` is of
    rejected: dict[str, int] = {}  # What the simulator did not believe so far, by reason


class Stamps(NamedTuple):
    """What the simulator adds to an environment's ``scene()``: the fields of ``Scene``."""

    episode: int
    step: int
    sim_time_s: float
    round_trip_ms: float | None = None
    answered_step: int | None = None
    rejected: Mapping[str, int] = {}


_ENCODER = msgspec.msgpack.Encoder(
    enc_hook=lambda value: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
)
_DECODER = msgspec.msgpack.Decoder(Scene)


def scene_key(vehicle_id: str) -> str:
    """Return the Zenoh key of the scene topic."""
    return f"phil/{check_vehicle_id(vehicle_id)}/scene"


def encode_scene(scene: dict[str, Any], stamps: Stamps) -> bytes:
    """Encode an environment's ``scene()`` with its place in time as a MessagePack map."""
    return _ENCODER.encode({**scene, **stamps._asdict()})


def read_scene(scene: Mapping[str, Any]) -> SeenScene:
    """An environment's ``scene()`` as what is drawn; what is not drawn is left out."""
    return msgspec.msgpack.decode(_ENCODER.encode(scene), type=SeenScene)


def decode_scene(payload: bytes) -> Scene | None:
    """Return the scene; None if the payload is not one (a viewer has nothing better to do)."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        return None
    try:
        return _DECODER.decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


DECODERS: dict[str, Callable[[bytes], Any]] = {
    "state": wire.decode_state,
    "command": wire.decode_command,
    "feedback": wire.decode_feedback,
    "health": wire.decode_health,
    "scene": decode_scene,
}
"""Topic -> decoder; for what is not valid it returns a ``Rejection``, for a scene None."""


BURST = 2.0  # Two at once, so that the jitter of a stream at just the pace costs no message


class Pace:
    """Lets one message an interval through on average, and two at once at most; of 0 s, all."""

    def __init__(self, interval_s: float) -> None:
        self.skipped = 0
        self._interval_s = interval_s
        self._tokens = BURST
        self._filled_s: float | None = None

    def due(self, now_s: float) -> bool:
        """Whether a message may pass now; one that may not is counted."""
        if not self._interval_s:
            return True
        elapsed_s = 0.0 if self._filled_s is None else max(0.0, now_s - self._filled_s)
        self._filled_s = now_s
        self._tokens = min(BURST, self._tokens + elapsed_s / self._interval_s)
        if self._tokens < 1.0:
            self.skipped += 1
            return False
        self._tokens -= 1.0
        return True
