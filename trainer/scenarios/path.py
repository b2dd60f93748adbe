"""The ego car's planned path: a straight, a circular arc to the left, a straight."""

from __future__ import annotations

import math
from typing import NamedTuple

from highway_env.road.lane import CircularLane, StraightLane


class Pose(NamedTuple):
    """Position in metres and heading in rad, highway-env's frame (y down)."""

    x: float
    y: float
    heading: float


class LeftTurnPath:
    """North along the side road, a quarter circle to the left, then west along the main road.

    Args:
        start: where the path begins (x, y), metres.
        straight_m: length before the arc.
        radius_m: radius of the arc.

    Arc length ``s`` counts from the start; beyond the arc the path goes on for ever.
    """

    def __init__(self, start: tuple[float, float], straight_m: float, radius_m: float) -> None:
        self.start_x, self.start_y = start
        self.straight_m = straight_m
        self.radius_m = radius_m
        self.arc_m = 0.5 * math.pi * radius_m
        self.centre_x = self.start_x - radius_m
        self.centre_y = self.start_y - straight_m

    def pose(self, s_m: float) -> Pose:
        """The pose at arc length ``s_m`` (metres)."""
        on_arc_m = s_m - self.straight_m
        if on_arc_m <= 0.0:
            return Pose(self.start_x, self.start_y - s_m, -0.5 * math.pi)
        if on_arc_m <= self.arc_m:
            angle = on_arc_m / self.radius_m
            x = self.centre_x + self.radius_m * math.cos(angle)
            y = self.centre_y - self.radius_m * math.sin(angle)
            return Pose(x, y, -0.5 * math.pi - angle)
        beyond_m = on_arc_m - self.arc_m
        return Pose(self.centre_x - beyond_m, self.centre_y - self.radius_m, -math.pi)

    def project(self, x: float, y: float) -> tuple[float, float]:
        """The nearest point of the path: its arc length and the offset to its right, metres."""
        if y >= self.centre_y:
            return self.start_y - y, x - self.start_x
        if x <= self.centre_x:
            offset_m = (self.centre_y - self.radius_m) - y
            return self.straight_m + self.arc_m + (self.centre_x - x), offset_m
        dx, dy = x - self.centre_x, self.centre_y - y
        angle = math.atan2(dy, dx)
        return self.straight_m + angle * self.radius_m, math.hypot(dx, dy) - self.radius_m

    def curvature(self, s_m: float) -> float:
        """Signed curvature at ``s_m``, 1/m; negative is a left turn (headings are clockwise)."""
        return -1.0 / self.radius_m if 0.0 < s_m - self.straight_m <= self.arc_m else 0.0

    def lanes(self, end_m: float, width_m: float) -> list[StraightLane | CircularLane]:
        """The same path as highway-env lanes, ending at arc length ``end_m``."""
        straight_end = (self.start_x, self.centre_y)
        arc = CircularLane(
            (self.centre_x, self.centre_y),
            self.radius_m,
            0.0,
            -0.5 * math.pi,
            clockwise=False,
            width=width_m,
        )
        exit_start = (self.centre_x, self.centre_y - self.radius_m)
        exit_m = max(end_m - self.straight_m - self.arc_m, 0.1)
        exit_end = (exit_start[0] - exit_m, exit_start[1])
        return [
            StraightLane((self.start_x, self.start_y), straight_end, width=width_m),
            arc,
            StraightLane(exit_start, exit_end, width=width_m),
        ]
