"""Plots over time: what each line is called and coloured, and where the plot stands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from viewing.colours import Colour

BLUE, ORANGE, GREEN, RED = (40, 120, 230), (235, 140, 40), (60, 170, 90), (220, 50, 50)
PURPLE, GREY = (150, 80, 200), (120, 124, 130)


class Plot(NamedTuple):
    """One plot of a layout."""

    origin: str
    title: str
    limits: tuple[float, float] | None = None
    """Of the y axis; None: as the values need."""


ALL_OF_IT = rrb.TimeRange(
    start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
)
"""Of the time axis. Otherwise rerun moves the axis with the cursor, and the beginning out of it."""


def plot_view(plot: Plot, shown: rrb.TimeRange = ALL_OF_IT) -> rrb.TimeSeriesView:
    """The view of a plot; ``shown`` is the part of the time axis."""
    return rrb.TimeSeriesView(
        origin=plot.origin,
        name=plot.title,
        axis_y=None if plot.limits is None else rrb.ScalarAxis(range=plot.limits),
        axis_x=rrb.TimeAxis(view_range=shown),
        plot_legend=rrb.Corner2D.LeftTop,
    )


def style_lines(recording: rr.RecordingStream, lines: Mapping[str, Colour]) -> None:
    """Name and colour lines by their entities; the name is the path's last part."""
    for path, colour in lines.items():
        name = path.rpartition("/")[2].replace("_", " ")
        style = rr.SeriesLines(colors=[colour], names=[name], widths=[2.0])
        recording.log(path, style, static=True)


def style_points(recording: rr.RecordingStream, points: Mapping[str, Colour]) -> None:
    """The same for what happens now and then: dots instead of a line."""
    for path, colour in points.items():
        name = path.rpartition("/")[2].replace("_", " ")
        style = rr.SeriesPoints(colors=[colour], names=[name], marker_sizes=[4.0])
        recording.log(path, style, static=True)
