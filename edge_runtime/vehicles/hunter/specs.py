"""The Hunter's limits and geometry, a row for each model.

Speed, angle, wheelbase and track: the makers' data sheets. The steering rate is in none of them:
it is how fast this runtime lets the request change, and the chassis may be slower.
"""

from __future__ import annotations

from typing import Dict, NamedTuple


class HunterSpec(NamedTuple):
    """Angles are those of the inner front wheel, whose angle the chassis is told."""

    max_speed_mps: float
    max_inner_steering_rad: float
    wheelbase_m: float
    track_m: float
    max_steering_rate_radps: float


SPECS: Dict[str, HunterSpec] = {
    "2.0": HunterSpec(1.5, 0.576, 0.650, 0.605, 1.0),
    # The track is given as 0.46 to 0.52 m, by position of the measurement: measure it.
    "se": HunterSpec(4.8, 0.400, 0.550, 0.490, 1.0),
}
