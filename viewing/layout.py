"""What the layouts of a drive and of a training have in common."""

from __future__ import annotations

import rerun.blueprint as rrb

from viewing.scene import Scene
from viewing.shapes import view_bounds

GROUND = [222, 229, 216]


def road_view(scene: Scene | None, name: str) -> rrb.Spatial2DView:
    """The road from above; the ground shown is fixed by ``scene`` (None: as rerun sees fit)."""
    bounds = None
    if scene is not None:
        x_range, y_range = view_bounds(scene)
        bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(origin="road", name=name, background=GROUND, visual_bounds=bounds)


def frames_view() -> rrb.Horizontal:
    """What the policy sees, and what is to be said of it now."""
    return rrb.Horizontal(
        rrb.Spatial2DView(origin="frames/before", name="Policy sees t-1"),
        rrb.Spatial2DView(origin="frames/now", name="Policy sees t"),
        rrb.TextDocumentView(origin="status", name="Now"),
        column_shares=[1, 1, 1],
    )


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
