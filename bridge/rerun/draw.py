"""What the views of a drive (``wire_view``) and of a training (``trainer.view``) share.

A `Canvas` draws lines, states, pictures and the road from above; the functions after it lay views
out. Metres; y grows downwards, as in the scene. Cars are lines: rerun cannot turn its flat boxes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from bridge.messages import Point, SeenCar, SeenScene
from bridge.rerun import APPLIED, GLASS, GOAL, GROUND, MARKING, PATH, ROAD, Colour, shades

BLUE, ORANGE, GREEN, RED = (40, 120, 230), (235, 140, 40), (60, 170, 90), (220, 50, 50)
PURPLE, GREY = (150, 80, 200), (120, 124, 130)
MARGIN_M = (10.0, 5.0)  # Ground shown beyond path and cars: along x, along y
CAMERA = "camera"  # From here the road is seen
NEAR_M = 20.0  # Cars farther from the path than this do not widen the view
PICTURE_INTERVAL_S = 0.1
"""Ten pictures a second, as many as a control period of ours makes, are plenty for an eye."""
Bounds = tuple[tuple[float, float], tuple[float, float]]  # Ranges of x and y, m
WHOLE = rrb.TimeRange(start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
"""The whole time axis; without it rerun scrolls the axis with the cursor."""


class Canvas:
    """Draws on a recording at the time that ``stand_at`` has set; used by one thread.

    ``lines``: path of each line that is there from the start -> its colour.
    """

    def __init__(self, recording: rr.RecordingStream, lines: Mapping[str, Colour]) -> None:
        self.recording, self.log = recording, recording.log
        self._colours, self._names = lines, {path: [_name(path)] for path in lines}
        self._ground: object = None
        for path, colour in lines.items():
            self.style(path, [colour], self._names[path])

    def stand_at(self, steps: Mapping[str, int], seconds: Mapping[str, float] = {}) -> None:
        """Set the time, by timeline, of all that is drawn next."""
        self.recording.reset_time()
        for timeline, step in steps.items():
            self.recording.set_time(timeline, sequence=step)
        for timeline, time_s in seconds.items():
            self.recording.set_time(timeline, duration=time_s)

    def scalar(self, path: str, *values: float) -> None:
        """Draw the newest value of a line, or of each of several lines at one path."""
        self.log(path, rr.Scalars(values))

    def style(self, path: str, colours: Sequence[Colour], names: Sequence[str]) -> None:
        """Give the lines at a path their colours and names."""
        style = rr.SeriesLines(colors=colours, names=names, widths=[2.0] * len(names))
        self.log(path, style, static=True)

    def name_actions(self, path: str, names: Sequence[str]) -> None:
        """Tell several actions at one path apart by their names and by shades of its colour."""
        shown = [f"{_name(path)} {name}" for name in names] if len(names) > 1 else [_name(path)]
        if self._names[path] != shown:
            self._names[path] = shown
            self.style(path, shades(self._colours[path], len(names)), shown)

    def lanes(self, path: str, colours: Mapping[str, Colour]) -> None:
        """Declare the states that may be logged at a path, and their colours."""
        names = list(colours)
        lanes = rr.StateConfiguration(values=names, labels=names, colors=list(colours.values()))
        self.log(path, lanes, static=True)

    def status(self, lines: Sequence[str]) -> None:
        """Replace the text that says how things stand; empty lines are left out."""
        text = "\n\n".join(filter(None, lines))
        self.log("status", rr.TextDocument(text, media_type="text/markdown"))

    def is_new_ground(self, ground: object) -> bool:
        """Whether another ground is to be shown than the one of the last call."""
        before, self._ground = self._ground, ground
        return before != ground

    def draw_ground(self, scene: SeenScene) -> None:
        """Draw what does not move: roads, path and goal."""
        self._strips("road/roads", scene.roads, ROAD, scene.road_width_m / 2, order=0.0)
        self._strips("road/lanes", scene.lane_lines, MARKING, 0.06, order=0.5)
        self._strips("road/path", [scene.path] if scene.path else [], PATH, 0.15, order=1.0)
        if scene.goal is not None:
            look: Any = {"colors": [GOAL], "radii": [0.9], "labels": ["goal"], "draw_order": 2.0}
            self.log("road/goal", rr.Points2D([scene.goal], **look))

    def draw_cars(self, scene: SeenScene, bounds: Bounds, ego_colour: Colour) -> None:
        """Draw the cars; the view moves to above the ego car where that has left the bounds."""
        self.log(CAMERA, rr.Transform3D(translation=[*away_m(scene, bounds), 0.0]))
        for name, colour in (("traffic", APPLIED), ("ego", ego_colour)):
            cars = [car for car in scene.vehicles if car.ego == (name == "ego")]
            half_m = [car.width_m / 2 for car in cars]
            for part, shade, radius_m, order in (
                ("body", colour, half_m, 3.0),
                ("outline", GLASS, 0.1, 4.0),
                ("glass", GLASS, 0.3, 5.0),
            ):
                strips = [shapes_of(car)[part] for car in cars]
                self._strips(f"road/{name}/{part}", strips, shade, radius_m, order)

    def _strips(self, path: str, strips: Any, colour: Colour, radii_m: Any, order: float) -> None:
        drawn = rr.LineStrips2D(strips, colors=[colour], radii=radii_m, draw_order=order)
        self.log(path, drawn)


def _name(path: str) -> str:
    return path.rpartition("/")[2].replace("_", " ")


def shapes_of(car: SeenCar) -> dict[str, list[Point]]:
    """A car's lines: its outline, the windscreen, which tells front from back, and the body.

    The body is an axis that fills the outline when it is drawn as wide as the car (round ends).
    """
    cos, sin = math.cos(car.heading_rad), math.sin(car.heading_rad)

    def placed(*points: Point) -> list[Point]:
        return [(car.x + a * cos - b * sin, car.y + a * sin + b * cos) for a, b in points]

    ahead, aside = car.length_m / 2, car.width_m / 2
    reach = max(0.0, ahead - aside)
    box = [(ahead, aside), (ahead, -aside), (-ahead, -aside), (-ahead, aside), (ahead, aside)]
    return {
        "body": placed((-reach, 0.0), (reach, 0.0)),
        "outline": placed(*box),
        "glass": placed((0.4 * ahead, -0.7 * aside), (0.4 * ahead, 0.7 * aside)),
    }


def view_bounds(scene: SeenScene) -> Bounds:
    """Return the x and y ranges (m) that show the path, and the cars that are near it now."""
    cars = [(car.x, car.y) for car in scene.vehicles]
    ranges = []
    for axis, margin in enumerate(MARGIN_M):
        known = [point[axis] for point in scene.path or cars] or [0.0]
        low, high = min(known), max(known)
        near = [point[axis] for point in cars if low - NEAR_M < point[axis] < high + NEAR_M]
        ranges.append((min([low, *near]) - margin, max([high, *near]) + margin))
    return ranges[0], ranges[1]


def away_m(scene: SeenScene, bounds: Bounds) -> list[float]:
    """Return how far (x, y) the ego car is from the bounds' middle; [0, 0] where it is inside."""
    for ego in (car for car in scene.vehicles if car.ego):
        place = list(zip((ego.x, ego.y), bounds, strict=True))
        if not all(low <= at <= high for at, (low, high) in place):
            return [at - (low + high) / 2 for at, (low, high) in place]
    return [0.0, 0.0]


class Plot(NamedTuple):
    """One plot of a layout."""

    origin: str
    title: str
    limits: tuple[float, float] | None = None  # Of the y axis; None: as the values need


def plot_view(plot: Plot, shown: rrb.TimeRange = WHOLE) -> rrb.TimeSeriesView:
    """The view of a plot; ``shown`` is the part of the time axis."""
    limits = None if plot.limits is None else rrb.ScalarAxis(range=plot.limits)
    axes: Any = {"axis_x": rrb.TimeAxis(view_range=shown), "axis_y": limits}
    legend = rrb.Corner2D.LeftTop
    return rrb.TimeSeriesView(origin=plot.origin, name=plot.title, plot_legend=legend, **axes)


def lanes_view(origin: str, title: str) -> rrb.StateTimelineView:
    """The view of states over time."""
    axis = rrb.TimeAxis(view_range=WHOLE)
    return rrb.StateTimelineView(origin=origin, name=title, time_view=axis)


def road_view(scene: SeenScene | None, name: str) -> rrb.Spatial2DView:
    """The road from above; the ground shown is fixed by ``scene`` (None: as rerun sees fit)."""
    look: dict[str, Any] = {"name": name, "background": list(GROUND)}
    if scene is None:
        return rrb.Spatial2DView(origin="road", **look)
    x_range, y_range = view_bounds(scene)
    bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(origin=CAMERA, contents="/road/**", visual_bounds=bounds, **look)


def sees_view(frames: bool = True, array: str = "") -> rrb.Horizontal:
    """What the policy sees (two frames, else a large ``array``, else lines), and the status."""
    seen: list[Any] = [plot_view(Plot("observation", "Policy sees"))]
    if frames:
        view = rrb.Spatial2DView
        times = {"before": "t-1", "now": "t"}.items()
        seen = [view(origin=f"frames/{at}", name=f"Policy sees {t}") for at, t in times]
    elif array:
        seen = [rrb.TensorView(origin=f"observation/{array}", name=f"Policy sees: {array}")]
    now = rrb.TextDocumentView(origin="status", name="Now")
    return rrb.Horizontal(*seen, now, column_shares=[1, 1, 1] if frames else [2, 1])


def two_columns(
    left: rrb.Container, right: rrb.Container, column_shares: list[int], timeline: str
) -> rrb.Blueprint:
    """Two columns and nothing else open, along ``timeline``."""
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=column_shares),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline),
    )
