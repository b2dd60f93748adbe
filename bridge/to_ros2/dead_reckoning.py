"""Where a vehicle has come to, by its own word on speed and steering. Pure, time is passed in.

Nothing corrects it: wheel slip and scale errors add up, which the variance says in its way.
"""

from __future__ import annotations

import math

LONGEST_GAP_S = 0.5
"""After a longer silence nobody knows how fast it was meanwhile: only so much is made up."""
ERROR_PER_METRE = 0.1
"""Guessed, not measured: a standard deviation of 10 % of the way, and 0.1 rad a metre."""


class DeadReckoning:
    """A pose in the frame in which the vehicle was first heard of: x ahead, y to its left."""

    def __init__(self) -> None:
        self.x_m, self.y_m, self.yaw_rad, self.way_m = 0.0, 0.0, 0.0, 0.0
        self._time_ns: int | None = None
        self._speed_mps, self._curvature = 0.0, 0.0

    @property
    def variance(self) -> float:
        """Return the variance of x, y (m2) and yaw (rad2)."""
        return (ERROR_PER_METRE * self.way_m) ** 2

    def advance(self, speed_mps: float, curvature: float, time_ns: int) -> None:
        """Go on to ``time_ns`` along arcs of the mean of the last two reports.

        ``curvature`` in 1/m, positive to the left. A clock that goes back moves nothing.
        """
        if self._time_ns is not None and time_ns > self._time_ns:
            step_s = min((time_ns - self._time_ns) * 1e-9, LONGEST_GAP_S)
            self._move(
                0.5 * (speed_mps + self._speed_mps) * step_s,
                0.5 * (curvature + self._curvature),
            )
        self._time_ns = time_ns
        self._speed_mps, self._curvature = speed_mps, curvature

    def _move(self, way_m: float, curvature: float) -> None:
        turn_rad = way_m * curvature
        heading_rad = self.yaw_rad + 0.5 * turn_rad
        # The chord of the arc: sin(x) / x is 1 where it goes straight.
        half = 0.5 * turn_rad
        chord_m = way_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        self.x_m += chord_m * math.cos(heading_rad)
        self.y_m += chord_m * math.sin(heading_rad)
        self.yaw_rad = math.remainder(self.yaw_rad + turn_rad, math.tau)
        self.way_m += abs(way_m)
