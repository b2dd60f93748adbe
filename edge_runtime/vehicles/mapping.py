"""The Hunter's limits and geometry, a row for each model.

Speed, angle, wheelbase and track: the makers' data sheets. The steering rate is in none of them:
it is how fast this runtime lets the request change, and the chassis may be slower.
"""

from __future__ import annotations

import math
from typing import Dict, NamedTuple, Optional

from edge_runtime.util import UserError


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


# The set-point runs ahead of the speed by what full acceleration gives in this time, and no
# further: a vehicle that was held up must not leap when it comes free (anti-windup).
LEAD_S = 0.5


def pedal_to_acceleration(pedal: float, similarity: Similarity) -> float:
    """The vehicle's acceleration (m/s2) for a pedal in -1 to 1: throttle above 0, brake below."""
    car = similarity.car
    full_mps2 = car.throttle_mps2 if pedal > 0 else car.brake_mps2
    return similarity.vehicle_mps(pedal * full_mps2)


def acceleration_to_pedal(acceleration_mps2: float, similarity: Similarity) -> float:
    """The pedal that gives the vehicle this acceleration, within -1 to 1."""
    car = similarity.car
    full_mps2 = car.throttle_mps2 if acceleration_mps2 > 0 else car.brake_mps2
    return _clamp(similarity.scenario_mps(acceleration_mps2) / full_mps2, 1.0)


def pedal_to_speed(
    set_point_mps: float,
    pedal: float,
    step_s: float,
    measured_mps: float,
    max_speed_mps: float,
    similarity: Similarity,
) -> float:
    """The speed to ask for after the pedal was held for `step_s`, in 0 to `max_speed_mps`.

    Downwards only the throttle is bounded by the measured speed: a brake that does not bite is
    asked for all the more.
    """
    acceleration_mps2 = pedal_to_acceleration(pedal, similarity)
    speed_mps = set_point_mps + acceleration_mps2 * step_s
    lead_mps = pedal_to_acceleration(1.0, similarity) * LEAD_S
    speed_mps = min(speed_mps, measured_mps + lead_mps)
    if pedal > 0:
        speed_mps = max(speed_mps, measured_mps - lead_mps)
    return min(max(speed_mps, 0.0), max_speed_mps)


def follow_speed(
    set_point_mps: float,
    scenario_speed_mps: float,
    step_s: float,
    max_speed_mps: float,
    similarity: Similarity,
) -> float:
    """The speed to ask for where the scenario has the pedals: its car's, as fast as that could."""
    most_mps = pedal_to_acceleration(1.0, similarity) * step_s
    least_mps = pedal_to_acceleration(-1.0, similarity) * step_s
    wanted_mps = similarity.vehicle_mps(scenario_speed_mps)
    change_mps = min(max(wanted_mps - set_point_mps, least_mps), most_mps)
    return min(max(set_point_mps + change_mps, 0.0), max_speed_mps)


def steering_to_centre(steering: float, wheelbase_m: float, similarity: Similarity) -> float:
    """The angle (rad) of a wheel in the middle of the front axle, for a steering in -1 to 1.

    The vehicle is a bicycle that turns about its rear axle: tan(angle) = wheelbase x curvature.
    """
    return math.atan(wheelbase_m * similarity.vehicle_curvature(steering))


def centre_to_steering(centre_rad: float, wheelbase_m: float, similarity: Similarity) -> float:
    """The steering whose path the vehicle drives, within -1 to 1."""
    return _clamp(similarity.steering(math.tan(centre_rad) / wheelbase_m), 1.0)


def centre_to_inner(
    centre_rad: float, wheelbase_m: float, track_m: float, max_inner_rad: float
) -> float:
    """The inner front wheel's angle (Ackermann), no more than it can be turned.

    The inner wheel's circle is half a track narrower: tan(inner) = wheelbase / (radius - track/2)
    with the radius wheelbase / tan(centre) of the rear axle's middle.
    """
    slope = math.tan(min(abs(centre_rad), inner_to_centre(max_inner_rad, wheelbase_m, track_m)))
    inner_rad = math.atan2(wheelbase_m * slope, wheelbase_m - 0.5 * track_m * slope)
    return math.copysign(inner_rad, centre_rad)


def inner_to_centre(inner_rad: float, wheelbase_m: float, track_m: float) -> float:
    """The centre angle of an inner wheel's angle; the inverse of the above."""
    slope = math.tan(abs(inner_rad))
    centre_rad = math.atan2(wheelbase_m * slope, wheelbase_m + 0.5 * track_m * slope)
    return math.copysign(centre_rad, inner_rad)


def _clamp(value: float, most: float) -> float:
    return min(max(value, -most), most)
