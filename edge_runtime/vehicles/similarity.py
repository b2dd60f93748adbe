"""From the scenario's car to a small robot and back: one factor for lengths, time as it is.

A robot that covers `scale` of the car's way in the same time has `scale` of its speed and of its
acceleration, and 1/`scale` of its path's curvature; so the policy's pictures stay true, and its
control period too. Steering is converted by equal path, through each vehicle's own geometry.
"""

from __future__ import annotations

import math
from typing import Dict, NamedTuple, Optional

from edge_runtime.errors import UserError


class ScenarioCar(NamedTuple):
    """The car that a policy was trained on.

    `full_steering_rad` is the front-wheel angle at action +1, positive to the left.
    `wheelbase_m` is the length that highway-env's bicycle model turns by.
    """

    throttle_mps2: float
    brake_mps2: float
    max_speed_mps: float
    full_steering_rad: float
    wheelbase_m: float


# The numbers of trainer/scenarios, which holds them equal by a test. Congestion's throttle is its
# IDM's: no action of its policy reaches it; its action +1 turns right. No action of the left turn
# steers: the angle there is where its path tracker ends.
CARS: Dict[str, ScenarioCar] = {
    "left_turn": ScenarioCar(3.0, 4.0, 6.0, math.pi / 4, 5.0),
    "congestion": ScenarioCar(3.0, 4.0, 6.0, -0.15, 5.0),
}


def car_of(scenario: str, vehicle: str) -> ScenarioCar:
    """The car of a manifest's scenario. Raises UserError for one that this runtime cannot know."""
    if scenario not in CARS:
        raise UserError(
            f"the {vehicle} cannot follow a policy of the scenario {scenario!r}: which car it was"
            f" trained on is known for {', '.join(sorted(CARS))};"
            " set [similarity.car] in --config, or use --vehicle none"
        )
    return CARS[scenario]


class Similarity(NamedTuple):
    """`scale`: metres of the vehicle for one metre of the scenario; the same for speeds."""

    car: ScenarioCar
    scale: float

    def vehicle_mps(self, scenario_mps: float) -> float:
        """A speed (or an acceleration) of the scenario, at the vehicle."""
        return scenario_mps * self.scale

    def scenario_mps(self, vehicle_mps: float) -> float:
        """A speed (or an acceleration) of the vehicle, in the scenario."""
        return vehicle_mps / self.scale

    def vehicle_curvature(self, steering: float) -> float:
        """Path curvature (1/m, positive to the left) that a steering action in -1 to 1 asks for.

        highway-env's bicycle turns about its centre: slip b = atan(tan(angle) / 2), and a heading
        rate of v sin(b) / (wheelbase / 2).
        """
        slip_rad = math.atan(0.5 * math.tan(steering * self.car.full_steering_rad))
        return math.sin(slip_rad) / (0.5 * self.car.wheelbase_m) / self.scale

    def steering(self, vehicle_curvature: float) -> float:
        """The steering action whose path is the vehicle's; not clamped. Inverse of the above."""
        sine = 0.5 * self.car.wheelbase_m * vehicle_curvature * self.scale
        slip_rad = math.asin(min(max(sine, -1.0), 1.0))
        return math.atan(2.0 * math.tan(slip_rad)) / self.car.full_steering_rad


def similarity_to(
    car: ScenarioCar, max_speed_mps: float, scale: Optional[float] = None
) -> Similarity:
    """The similarity of a vehicle; by default its top speed is the car's top speed."""
    return Similarity(car, max_speed_mps / car.max_speed_mps if scale is None else scale)
