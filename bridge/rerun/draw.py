"""What both views draw: the road from above, plots, and their places in a layout.

Metres; y grows downwards, as in the scene. Cars are lines, because rerun's flat boxes cannot be
turned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from bridge.messages import SeenCar, SeenScene
from bridge.rerun import APPLIED, GLASS, GOAL, GROUND, MARKING, PATH, ROAD, Colour, shades

BLUE, ORANGE, GREEN, RED = (40, 120, 230), (235, 140, 40), (60, 170, 90), (220, 50, 50)
PURPLE, GREY = (150, 80, 200), (120, 124, 130)
MARGIN_M = (10.0, 5.0)  # Ground shown beyond path and cars: along x, along y
CAMERA = "camera"  # From here the road is seen
NEAR_M = 20.0  # Cars farther from the path than this do not widen the view
Bounds = tuple[tuple[float, float], tuple[float, float]]  # Ranges of x and y, m
ALL_OF_IT = rrb.TimeRange(
    start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
)
"""The whole time axis; otherwise rerun scrolls it with the cursor."""
PICTURE_INTERVAL_S = 0.1
"""Ten a second are as many as a control period makes, and plenty for an eye."""


def draw_ground(recording: rr.RecordingStream, scene: SeenScene) -> None:
    """Draw what stays for an episode: roads, path and goal."""
    _lines(recording, "road/roads", scene.roads, ROAD, scene.road_width_m / 2, order=0.0)
    _lines(recording, "road/lanes", scene.lane_lines, MARKING, 0.06, order=0.5)
    _lines(recording, "road/path", [scene.path] if scene.path else [], PATH, 0.15, order=1.0)
    if scene.goal is not None:
        recording.log(
            "road/goal",
            rr.Points2D([scene.goal], colors=[GOAL], radii=[0.9], labels=["goal"], draw_order=2.0),
        )


def draw_cars(recording: rr.RecordingStream, scene: SeenScene, ego_colour: Colour) -> None:
    """Draw the cars; the ego car's colour may say what it does, or who decides."""
    for name, ego in (("traffic", False), ("ego", True)):
        path, colour = f"road/{name}", ego_colour if ego else APPLIED
        cars = [car for car in scene.vehicles if car.ego == ego]
        half_m = [car.width_m / 2 for car in cars]
        _lines(recording, f"{path}/body", [body(car) for car in cars], colour, half_m, order=3.0)
        _lines(recording, f"{path}/outline", [outline(car) for car in cars], GLASS, 0.1, order=4.0)
        _lines(recording, f"{path}/glass", [windscreen(car) for car in cars], GLASS, 0.3, order=5.0)


def _lines(
    recording: rr.RecordingStream,
    path: str,
    strips: Sequence[Sequence[Sequence[float]]],
    colour: Colour,
    radii_m: float | list[float],
    order: float,
) -> None:
    recording.log(path, rr.LineStrips2D(strips, colors=[colour], radii=radii_m, draw_order=order))


def outline(car: SeenCar) -> list[tuple[float, float]]:
    """Return the closed outline of the oriented box (five points)."""
    ahead, aside = car.length_m / 2, car.width_m / 2
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))
    return [_place(car, sx * ahead, sy * aside) for sx, sy in signs]


def body(car: SeenCar) -> list[tuple[float, float]]:
    """Return the axis which, drawn as wide as the car, fills its outline (with round ends)."""
    reach = max(0.0, (car.length_m - car.width_m) / 2)
    return [_place(car, -reach, 0.0), _place(car, reach, 0.0)]


def windscreen(car: SeenCar) -> list[tuple[float, float]]:
    """Return a bar across the car, before its middle, that tells front from back."""
    ahead, aside = 0.2 * car.length_m, 0.35 * car.width_m
    return [_place(car, ahead, -aside), _place(car, ahead, aside)]


def view_bounds(scene: SeenScene) -> Bounds:
    """Return the x and y ranges (m) that show the path, and the cars that are near it now."""
    path = [(point[0], point[1]) for point in scene.path]
    cars = [(car.x, car.y) for car in scene.vehicles]
    ranges = []
    for axis, margin in enumerate(MARGIN_M):
        known = [point[axis] for point in path] or [point[axis] for point in cars] or [0.0]
        low, high = min(known), max(known)
        near = [point[axis] for point in cars if low - NEAR_M < point[axis] < high + NEAR_M]
        ranges.append((min([low, *near]) - margin, max([high, *near]) + margin))
    return ranges[0], ranges[1]


def follow(recording: rr.RecordingStream, scene: SeenScene, bounds: Bounds) -> None:
    """Hold the view above the ego car where that has left the ground shown (``view_bounds``)."""
    ego = next((car for car in scene.vehicles if car.ego), None)
    away_m = [0.0, 0.0]
    if ego is not None:
        place = list(zip((ego.x, ego.y), bounds, strict=True))
        if any(not low <= at <= high for at, (low, high) in place):
            away_m = [at - (low + high) / 2 for at, (low, high) in place]
    recording.log(CAMERA, rr.Transform3D(translation=[*away_m, 0.0]))


def _place(car: SeenCar, ahead_m: float, aside_m: float) -> tuple[float, float]:
    cos, sin = math.cos(car.heading_rad), math.sin(car.heading_rad)
    return car.x + ahead_m * cos - aside_m * sin, car.y + ahead_m * sin + aside_m * cos


def road_view(scene: SeenScene | None, name: str) -> rrb.Spatial2DView:
    """The road from above; the ground shown is fixed by ``scene`` (None: as rerun sees fit)."""
    look: dict[str, Any] = {"name": name, "background": list(GROUND)}
    if scene is None:
        return rrb.Spatial2DView(origin="road", **look)
    x_range, y_range = view_bounds(scene)
    bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(origin=CAMERA, contents="/road/**", visual_bounds=bounds, **look)


def frames_view() -> rrb.Horizontal:
    """What the policy sees, and what is to be said of it now."""
    return rrb.Horizontal(
        rrb.Spatial2DView(origin="frames/before", name="Policy sees t-1"),
        rrb.Spatial2DView(origin="frames/now", name="Policy sees t"),
        rrb.TextDocumentView(origin="status", name="Now"),
        column_shares=[1, 1, 1],
    )


def numbers_view(array: str) -> rrb.Horizontal:
    """The same for a policy that sees no picture: lines, or the ``array`` of many numbers."""
    seen: Any = plot_view(Plot("observation", "Policy sees"))
    if array:
        seen = rrb.TensorView(origin=f"observation/{array}", name=f"Policy sees: {array}")
    now = rrb.TextDocumentView(origin="status", name="Now")
    return rrb.Horizontal(seen, now, column_shares=[2, 1])


def full_blueprint(
    left: rrb.Container, right: rrb.Container, column_shares: list[int], timeline: str
) -> rrb.Blueprint:
    """Two columns and nothing else open, along ``timeline``."""
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=column_shares),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline),
    )


class Plot(NamedTuple):
    """One plot of a layout."""

    origin: str
    title: str
    limits: tuple[float, float] | None = None  # Of the y axis; None: as the values need


def plot_view(plot: Plot, shown: rrb.TimeRange = ALL_OF_IT) -> rrb.TimeSeriesView:
    """The view of a plot; ``shown`` is the part of the time axis."""
    return rrb.TimeSeriesView(
        origin=plot.origin,
        name=plot.title,
        axis_y=None if plot.limits is None else rrb.ScalarAxis(range=plot.limits),
        axis_x=rrb.TimeAxis(view_range=shown),
        plot_legend=rrb.Corner2D.LeftTop,
    )


def style_actions(
    recording: rr.RecordingStream, path: str, colour: Colour, names: Sequence[str]
) -> None:
    """Give each of several actions at one path its name and its colour."""
    what = path.rpartition("/")[2]
    shown = [f"{what} {name}" for name in names] if len(names) > 1 else [what]
    colours, widths = shades(colour, len(names)), [2.0] * len(names)
    style = rr.SeriesLines(colors=colours, names=shown, widths=widths)
    recording.log(path, style, static=True)


def style_lines(recording: rr.RecordingStream, lines: Mapping[str, Colour]) -> None:
    """Name and colour lines by their entities; the name is the path's last part."""
    for path, colour in lines.items():
        name = path.rpartition("/")[2].replace("_", " ")
        style = rr.SeriesLines(colors=[colour], names=[name], widths=[2.0])
        recording.log(path, style, static=True)
