"""From a policy's actions to the units of a small robot, and back for its feedback. Pure.

A robot that covers `scale` of the scenario car's way in the same time has `scale` of its speed and
of its acceleration, and 1/`scale` of its path's curvature; so the policy's pictures stay true, and
its control period too. Steering is converted by equal path, through each vehicle's own geometry.
Angles are positive to the left.

    pedal     -> acceleration of the scenario's car -> the robot's -> integrated: its speed
    steering  -> curvature of the car's path -> the robot's -> centre angle -> inner wheel
"""

from __future__ import annotations

import math
from typing import Dict, NamedTuple, Optional

from edge_runtime.controller import ActionLimit
from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S

# The set-point runs ahead of the speed by what full acceleration gives in this time, and no
# further: a vehicle that was held up must not leap when it comes free (anti-windup).
LEAD_S = 0.5
_LONGEST_STEP_S = CONTROL_PERIOD_S  # after a pause of the process the pedal was not held for it
# A pedal is integrated to a speed, so that any leap of it is a ramp.
_PEDAL_SLEW_PER_S = math.inf


class HunterSpec(NamedTuple):
    """A model's limits and geometry. Angles are those of the inner front wheel, as it is told.

    Speed, angle, wheelbase and track: the maker's data sheets. The steering rate is in none of
    them: it is how fast this runtime lets the request change, and the chassis may be slower.
    """

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


class Wish(NamedTuple):
    """A command: the pedal, or the speed of the scenario's car; the steering stays where None."""

    pedal: Optional[float]
    scenario_speed_mps: Optional[float]
    steering: Optional[float]


def wish_of(action: Dict[str, float], scenario_speed_mps: Optional[float]) -> Wish:
    """The command of an action, within -1 to 1.

    Raises ValueError for what is not finite, and for what leaves out how fast to drive.
    """
    wish = Wish(action.get("pedal"), scenario_speed_mps, action.get("steering"))
    if not all(math.isfinite(value) for value in wish if value is not None):
        raise ValueError(f"a command that is not finite: {action}, {scenario_speed_mps} m/s")
    if not action or (wish.pedal is None and scenario_speed_mps is None):
        raise ValueError(f"a command that lacks an action: {action}, {scenario_speed_mps} m/s")
    return Wish(_within(wish.pedal), scenario_speed_mps, _within(wish.steering))


def _within(action: Optional[float]) -> Optional[float]:
    """A pedal of 1e308 times a step of 0 s is no number."""
    return None if action is None else min(max(action, -1.0), 1.0)


class SetPoint:
    """`speed_mps` and `inner_rad` are within the model's limits at all times."""

    def __init__(self, spec: HunterSpec, similarity: Similarity) -> None:
        self.speed_mps = 0.0
        self.inner_rad = 0.0
        self._spec, self._similarity = spec, similarity

    def stand(self) -> None:
        """Speed 0 at once, the angle held."""
        self.speed_mps = 0.0

    def follow(self, wish: Wish, step_s: float, measured_mps: float) -> None:
        """One step of time towards what is wished for."""
        spec, similarity = self._spec, self._similarity
        step_s = min(max(step_s, 0.0), _LONGEST_STEP_S)
        if wish.pedal is not None:
            self.speed_mps = pedal_to_speed(
                self.speed_mps, wish.pedal, step_s, measured_mps, spec.max_speed_mps, similarity
            )
        else:
            self.speed_mps = follow_speed(
                self.speed_mps,
                wish.scenario_speed_mps or 0.0,
                step_s,
                spec.max_speed_mps,
                similarity,
            )
        if wish.steering is not None:
            self._turn(inner_of(wish.steering, spec, similarity), step_s)

    def _turn(self, wanted_rad: float, step_s: float) -> None:
        most_rad = self._spec.max_steering_rate_radps * step_s
        change_rad = min(max(wanted_rad - self.inner_rad, -most_rad), most_rad)
        self.inner_rad += change_rad


def inner_of(steering: float, spec: HunterSpec, similarity: Similarity) -> float:
    """The inner wheel's angle for a steering in -1 to 1: all the steps of the"""
    centre_rad = steering_to_centre(steering, spec.wheelbase_m, similarity)
    return centre_to_inner(centre_rad, spec.wheelbase_m, spec.track_m, spec.max_inner_steering_rad)


def limits_of(spec: HunterSpec, similarity: Similarity) -> Dict[str, ActionLimit]:
    """Ranges and slew rates of the actions: the steering's is that of the wheels."""
    full_rad = abs(inner_of(1.0, spec, similarity))
    return {
        "pedal": ActionLimit(-1.0, 1.0, _PEDAL_SLEW_PER_S),
        "steering": ActionLimit(-1.0, 1.0, spec.max_steering_rate_radps / full_rad),
    }


def steering_of(inner_rad: float, spec: HunterSpec, similarity: Similarity) -> float:
    """The steering in -1 to 1 for an inner wheel's angle, as the feedback says it."""
    centre_rad = inner_to_centre(inner_rad, spec.wheelbase_m, spec.track_m)
    return centre_to_steering(centre_rad, spec.wheelbase_m, similarity)


def _clamp(value: float, most: float) -> float:
    return min(max(value, -most), most)
