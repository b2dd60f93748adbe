"""How a training is laid out: the road and who drives on the left, what is learned on the right."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from bridge.messages import SeenScene
from bridge.rerun import APPLIED, HUMAN, POLICY
from bridge.rerun.draw import (
    ALL_OF_IT,
    BLUE,
    GREY,
    ORANGE,
    PURPLE,
    Plot,
    frames_view,
    full_blueprint,
    plot_view,
    road_view,
)

APPLICATION, SITTING_APPLICATION = "phil_hil_training", "phil_hil_sittings"
TIMELINE = "step"
RECENT_STEPS = 200
"""Shown of what changes within an episode."""
EPISODES = (
    Plot("return", "Return of an episode, and the mean of 20"),
    Plot("success", "Success: mean of 20 episodes, and policy alone in validation", (-0.05, 1.05)),
    Plot("loss", "Losses, means of an episode"),
    Plot("priority", "Mean priority in the replay buffer: the human's samples, the policy's"),
    Plot("human", "The human's share of the steps", (-0.05, 1.05)),
    Plot("advantage", "Q advantage of the human's action, where it took over"),
)
"""Of a training, from top to bottom."""
SITTINGS = (EPISODES[0], EPISODES[1], EPISODES[4])
"""Of recorded sittings, of which a learner has told nothing."""
RECENT = (
    Plot("action", "Action in [-1, 1], the last 20 s", (-1.1, 1.1)),
    Plot("speed", "Speed, m/s, the last 20 s"),
)
LINES = {
    "return/episode": GREY,
    "return/mean_of_20": BLUE,
    "success/mean_of_20": BLUE,
    "success/validation": ORANGE,
    "loss/critic": PURPLE,
    "loss/policy": POLICY,
    "loss/cloning": HUMAN,
    "priority/human": HUMAN,
    "priority/policy": POLICY,
    "human/share": HUMAN,
    "action/policy": POLICY,
    "action/applied": APPLIED,
    "speed/ego": BLUE,
}
POINTS = {"advantage/of_the_human": HUMAN}

ROAD = "Road from above (blue: the policy drives, green: the human)"


def make_blueprint(scene: SeenScene | None, episodes: Sequence[Plot]) -> rrb.Blueprint:
    """Lay out the views; the ground shown is fixed by the first scene (None: as rerun sees fit)."""
    left = rrb.Vertical(
        road_view(scene, ROAD),
        frames_view(),
        rrb.StateTimelineView(
            origin="driver",
            name="Who drives: the policy, or the human, and why",
            time_view=rrb.TimeAxis(view_range=ALL_OF_IT),
        ),
        *(_recent(plot) for plot in RECENT),
        row_shares=[3, 1.6, 0.9, 1.2, 1.1],
    )
    right = rrb.Vertical(*map(plot_view, episodes))
    return full_blueprint(left, right, [1, 1], TIMELINE)


def _recent(plot: Plot) -> rrb.TimeSeriesView:
    recent = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-RECENT_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return plot_view(plot, recent)
