"""The messages on the wire as listeners get them: the table of topics, and the scene.

The scene is for viewers: the road from above, which the policy never sees.
"""

from __future__ import annotations

import cmath
import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from edge_runtime import wire
from edge_runtime.manifest import MAX_PERIOD_S, MIN_PERIOD_S, Entry, Task, check_task
from edge_runtime.util import UserError

MOST = 1e12  # Of metres, seconds, milliseconds and all else that is drawn
MOST_STEPS = 10**8  # In an episode: 11 days at the shortest control period
SHADOW = "shadow"
"""Topic of a shadow policy's commands: in recordings only, never on the wire."""
TOKEN_TOPICS = ("alive", "simulator")
"""Liveliness tokens: of the edge runtime, and of the simulator (extension)."""


class Heard(NamedTuple):
    """One message, or one change of a liveliness token, as it arrived here."""

    key: str
    topic: str
    payload: bytes  # Of a token: 1 byte, 1 if it has appeared, 0 if it has gone
    arrived_ns: int
    """This process's clock: wall time at the start, then monotonic, so that it never goes back."""
    size: int  # Bytes on the wire; a payload over the contract's limit is not kept

    @property
    def vehicle_id(self) -> str:
        return self.key.split("/")[1]

    @property
    def is_whole(self) -> bool:
        return self.size == len(self.payload)


Point = tuple[float, float]


class SeenCar(msgspec.Struct, frozen=True):
    """One car; ``x``, ``y`` (m) are its centre and y grows downwards.

    Only a viewer's copy of the scene shows ``id`` and ``speed_mps``.
    """

    x: float
    y: float
    heading_rad: float
    length_m: float
    width_m: float
    ego: bool = False
    id: int = 0
    speed_mps: float = 0.0


def body(car: SeenCar) -> list[Point]:
    """Return the line that fills the car when drawn with the car's width (round ends)."""
    reach = max(0.0, (car.length_m - car.width_m) / 2)
    return _line(car, -reach, reach)


def windscreen(car: SeenCar) -> list[Point]:
    return _line(car, *(complex(0.2 * car.length_m, y * car.width_m) for y in (-0.35, 0.35)))


def _line(car: SeenCar, *points: complex) -> list[Point]:
    """Return points (m) from car coordinates: ahead of the centre (real) and aside (imaginary)."""
    placed = (complex(car.x, car.y) + cmath.rect(1.0, car.heading_rad) * each for each in points)
    return [(each.real, each.imag) for each in placed]


class SeenScene(msgspec.Struct, frozen=True, kw_only=True):
    """The drawn scene: roads, lane lines and the path as polylines, the goal, and the cars."""

    roads: Sequence[Sequence[Point]] = ()
    road_width_m: float = 4.0
    lane_lines: Sequence[Sequence[Point]] = ()
    path: Sequence[Point] = ()
    goal: Point | None = None
    vehicles: Sequence[SeenCar] = ()


class Origin(msgspec.Struct, frozen=True, kw_only=True):
    """How an episode began: with ``Scene.applied``, all that ``bridge fork`` needs.

    The fields are the options of ``bridge simulate``; ``seed`` is the episode's own.
    """

    session: str
    environment: str
    condition: str
    seed: Annotated[int, msgspec.Meta(ge=0)]
    standing: bool
    clock: str
    loop: str
    latency: str


class Scene(SeenScene, frozen=True, kw_only=True):
    """The scene on the wire, with its place in time and the simulator's own facts.

    ``task`` says how to read the states. ``picture`` is a JPEG where there is no ``scene()``. The
    environment's last step had the action ``applied``, whoever decided it; ``braked``: with the
    brake pressed; ``ridden``: its number in an earlier command's plan, 0 for none. ``waited``
    counts the first steps of the episode, in which the environment stood still because its vehicle
    waited for a re-arm.
    """

    episode: int
    step: int
    sim_time_s: float
    round_trip_ms: float | None = None
    """Of the newest command: from its state sent until it acts, injected delays included."""
    answered_step: int | None = None  # This episode's state that ``round_trip_ms`` belongs to
    rejected: dict[str, int] = {}  # Messages that the simulator has rejected so far, by reason
    task: Task | None = None
    picture: bytes = b""
    origin: Origin | None = None
    applied: list[float] | None = None
    braked: bool = False
    ridden: int = 0
    waited: int = 0


def plain(value: Any) -> Any:
    """Return NumPy's arrays and numbers as Python's, for msgspec to encode."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


ENCODER = msgspec.msgpack.Encoder(enc_hook=plain)  # Of an environment's own ``scene()``, too
_DECODER = msgspec.msgpack.Decoder(Scene)


def encode_scene(scene: dict[str, Any], stamps: Scene) -> bytes:
    own = msgspec.structs.asdict(stamps).items()
    drawn = SeenScene.__struct_fields__
    return ENCODER.encode({**scene, **{name: value for name, value in own if name not in drawn}})


def read_scene(scene: Mapping[str, Any]) -> SeenScene:
    """Decode an environment's ``scene()``; ValueError where it cannot be drawn."""
    seen = msgspec.msgpack.decode(ENCODER.encode(scene), type=SeenScene)
    if not _is_drawable(seen):
        raise ValueError("a scene with numbers that cannot be drawn")
    return seen


def is_picture(values: Entry | np.ndarray) -> bool:
    return values.dtype == "uint8" and len(values.shape) > 1


def images_of(picture: np.ndarray) -> np.ndarray:
    """Return what `is_picture` as images [count, height, width, 1 or 3]."""
    in_colours = picture.ndim > 2 and picture.shape[-1] == 3
    shape = picture.shape[-3:] if in_colours else (*picture.shape[-2:], 1)
    return picture.reshape(-1, *shape)


def decode_scene(payload: bytes) -> Scene | wire.Rejection:
    with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError, RecursionError, UserError):
        scene = _DECODER.decode(payload)
        if scene.task is not None:
            check_task(scene.task)  # A viewer reads states by it, whoever sent it.
        return scene
    return wire.Rejection(wire.Reason.MALFORMED, "not a scene")


DECODERS: dict[str, Callable[[bytes], Any]] = {
    "state": wire.decode_state,
    "command": wire.decode_command,
    "feedback": wire.decode_feedback,
    "health": wire.decode_health,
    "scene": decode_scene,
    SHADOW: wire.decode_command,
}
"""Topic -> decoder, which returns a ``Rejection`` for an invalid message."""


def decode(heard: Heard) -> Any:
    """Decode a message; ``Rejection`` also for numbers that no plot or time axis can show."""
    message = DECODERS[heard.topic](heard.payload)
    if isinstance(message, wire.Rejection):
        return message
    step, period_s = getattr(message, "step", 0), MIN_PERIOD_S
    if isinstance(message, wire.State | Scene) and step:
        period_s = message.sim_time_s / step
    is_placed = MIN_PERIOD_S / 2 < period_s < 2 * MAX_PERIOD_S and -1 <= step <= MOST_STEPS
    if is_placed and _is_drawable(message):
        return message
    return wire.Rejection(wire.Reason.MALFORMED, "numbers that cannot be drawn")


def _is_drawable(value: Any) -> bool:
    """Return whether every floating-point number in the value is finite, and at most MOST."""
    if isinstance(value, float):
        return abs(value) <= MOST  # False of NaN
    if isinstance(value, dict):
        value = list(value.values())
    elif isinstance(value, msgspec.Struct) and not isinstance(value, Task):
        value = msgspec.structs.astuple(value)
    return not isinstance(value, list | tuple) or all(map(_is_drawable, value))


class Pace:
    """Passes one message an interval on average, at most two at once; all for 0 s."""

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._free_s = -math.inf  # When the next one is due

    def due(self, now_s: float) -> bool:
        # A message may be one interval early, so that a stream with jitter loses none.
        if self._interval_s and now_s < self._free_s - self._interval_s:
            return False
        self._free_s = max(self._free_s, now_s) + self._interval_s
        return True
