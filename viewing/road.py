"""The road from above in rerun: roads, path, goal and cars; y grows downwards as in the scene."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from viewing.scene import Car, Scene
from viewing.shapes import body, outline, windscreen

ROAD = (92, 97, 105)
PATH = (120, 190, 255)
GOAL = (84, 200, 120)
TRAFFIC = (235, 140, 40)
MARKING = (235, 235, 235)
GLASS = (30, 34, 40)


def draw_ground(recording: rr.RecordingStream, scene: Scene) -> None:
    """Draw what stays for an episode: roads, path and goal."""
    _lines(recording, "road/roads", scene.roads, ROAD, scene.road_width_m / 2, order=0.0)
    _lines(recording, "road/lanes", scene.lane_lines, MARKING, 0.06, order=0.5)
    _lines(recording, "road/path", [scene.path] if scene.path else [], PATH, 0.15, order=1.0)
    if scene.goal is not None:
        recording.log(
            "road/goal",
            rr.Points2D([scene.goal], colors=[GOAL], radii=[0.9], labels=["goal"], draw_order=2.0),
        )


def draw_cars(
    recording: rr.RecordingStream, scene: Scene, ego_colour: tuple[int, int, int]
) -> None:
    """Draw the cars; the ego car's colour may say what it does, or by whose will."""
    for name, ego in (("traffic", False), ("ego", True)):
        cars = [car for car in scene.vehicles if car.ego == ego]
        _draw_cars(recording, f"road/{name}", cars, ego_colour if ego else TRAFFIC)


def _draw_cars(
    recording: rr.RecordingStream,
    path: str,
    cars: Sequence[Car],
    colour: tuple[int, int, int],
) -> None:
    half_widths = [car.width_m / 2 for car in cars]
    _lines(recording, f"{path}/body", [body(car) for car in cars], colour, half_widths, order=3.0)
    _lines(recording, f"{path}/outline", [outline(car) for car in cars], GLASS, 0.1, order=4.0)
    _lines(recording, f"{path}/glass", [windscreen(car) for car in cars], GLASS, 0.3, order=5.0)


def _lines(
    recording: rr.RecordingStream,
    path: str,
    strips: Sequence[Sequence[Sequence[float]]],
    colour: tuple[int, int, int],
    radii_m: float | list[float],
    order: float,
) -> None:
    recording.log(path, rr.LineStrips2D(strips, colors=[colour], radii=radii_m, draw_order=order))
