"""How the recording is laid out: the road large, what the policy sees below it, numbers beside."""

from __future__ import annotations

import rerun.blueprint as rrb

from bridge.scene import Scene
from viewing.series import ALL_OF_IT, BLUE, GREEN, ORANGE, PURPLE, Plot, plot_view
from viewing.shapes import view_bounds

APPLICATION = "phil_hil"
PLOTS = (
    Plot("action", "Command in [-1, 1]: asked and achieved", (-1.1, 1.1)),
    Plot("speed", "Speed, m/s: of the simulated car and of the vehicle"),
    Plot("latency", "Latency, ms: round trip, and its parts"),
    Plot("rejected", "Messages rejected so far, by reason"),
)
"""From top to bottom."""
SERIES = {
    "action/asked": BLUE,
    "action/achieved": ORANGE,
    "speed/simulated": BLUE,
    "speed/vehicle": ORANGE,
    "latency/uplink": BLUE,
    "latency/inference": GREEN,
    "latency/downlink": PURPLE,
    "latency/round_trip": ORANGE,
}
"""Lines that are there from the start; those of rejections come with their reasons."""


def make_blueprint(scene: Scene | None) -> rrb.Blueprint:
    """Lay out the views; the ground shown is fixed by the first scene (None: as rerun sees fit)."""
    left = rrb.Vertical(_road(scene), _frames(), row_shares=[3, 1.4])
    return rrb.Blueprint(
        rrb.Horizontal(left, _numbers(), column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
    )


def _road(scene: Scene | None) -> rrb.Spatial2DView:
    bounds = None
    if scene is not None:
        x_range, y_range = view_bounds(scene)
        bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(
        origin="road",
        name="Road from above",
        background=[222, 229, 216],
        visual_bounds=bounds,
    )


def _frames() -> rrb.Horizontal:
    return rrb.Horizontal(
        rrb.Spatial2DView(origin="frames/before", name="Policy sees t-1"),
        rrb.Spatial2DView(origin="frames/now", name="Policy sees t"),
        rrb.TextDocumentView(origin="status", name="Now"),
        column_shares=[1, 1, 1],
    )


def _numbers() -> rrb.Vertical:
    return rrb.Vertical(
        rrb.StateTimelineView(
            origin="mode",
            name="Mode, and why it does not drive",
            time_view=rrb.TimeAxis(view_range=ALL_OF_IT),
        ),
        *map(plot_view, PLOTS),
        rrb.TextLogView(
            origin="events",
            name="Events: modes, rejections, episodes",
            columns=rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"]),
        ),
        row_shares=[2.2, 2, 2, 2, 1.6, 1.8],
    )
