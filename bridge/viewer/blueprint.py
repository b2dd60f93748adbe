"""How the recording is laid out: the road large, what the policy sees below it, numbers beside."""

from __future__ import annotations

import rerun.blueprint as rrb

from bridge.scene import Scene
from viewing.colours import APPLIED, POLICY
from viewing.layout import frames_view, full_blueprint, road_view
from viewing.series import ALL_OF_IT, BLUE, GREEN, ORANGE, PURPLE, Plot, plot_view

APPLICATION = "phil_hil"
PLOTS = (
    Plot("action", "Command in [-1, 1]: asked and achieved", (-1.1, 1.1)),
    Plot("speed", "Speed, m/s: of the simulated car and of the vehicle"),
    Plot("latency", "Latency, ms: round trip, and its parts"),
    Plot("rejected", "Messages rejected so far, by reason"),
)
"""From top to bottom."""
SERIES = {
    "action/asked": POLICY,
    "action/achieved": APPLIED,
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
    left = rrb.Vertical(road_view(scene, "Road from above"), frames_view(), row_shares=[3, 1.4])
    return full_blueprint(left, _numbers(), [3, 2], "sim_time")


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
