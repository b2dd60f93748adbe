"""What is drawn of a scene seen from above: metres, y grows downwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

Point = Sequence[float]


class Car(Protocol):
    """One car; ``x``, ``y`` are its centre."""

    @property
    def x(self) -> float: ...  # noqa: D102
    @property
    def y(self) -> float: ...  # noqa: D102
    @property
    def heading_rad(self) -> float: ...  # noqa: D102
    @property
    def length_m(self) -> float: ...  # noqa: D102
    @property
    def width_m(self) -> float: ...  # noqa: D102
    @property
    def ego(self) -> bool: ...  # noqa: D102


class Scene(Protocol):
    """Roads, lane lines and the path as polylines, the goal, and the cars."""

    @property
    def roads(self) -> Sequence[Sequence[Point]]: ...  # noqa: D102
    @property
    def road_width_m(self) -> float: ...  # noqa: D102
    @property
    def lane_lines(self) -> Sequence[Sequence[Point]]: ...  # noqa: D102
    @property
    def path(self) -> Sequence[Point]: ...  # noqa: D102
    @property
    def goal(self) -> Point | None: ...  # noqa: D102
    @property
    def vehicles(self) -> Sequence[Car]: ...  # noqa: D102


@dataclass(frozen=True)
class SeenCar:
    """A car of a scenario's ``scene()``."""

    x: float
    y: float
    heading_rad: float
    length_m: float
    width_m: float
    ego: bool = False


@dataclass(frozen=True)
class SeenScene:
    """A scenario's ``scene()``."""

    roads: Sequence[Sequence[Point]] = ()
    road_width_m: float = 4.0
    lane_lines: Sequence[Sequence[Point]] = ()
    path: Sequence[Point] = ()
    goal: Point | None = None
    vehicles: Sequence[SeenCar] = ()


_CAR_FIELDS = [field.name for field in fields(SeenCar)]
_SCENE_FIELDS = [field.name for field in fields(SeenScene)]


def read_scene(scene: Mapping[str, Any]) -> SeenScene:
    """A scenario's ``scene()`` as what is drawn; what is not drawn is left out."""
    cars = [
        SeenCar(**{name: car[name] for name in _CAR_FIELDS if name in car})
        for car in scene.get("vehicles", ())
    ]
    drawn = {name: scene[name] for name in _SCENE_FIELDS if name in scene}
    return SeenScene(**{**drawn, "vehicles": cars})
