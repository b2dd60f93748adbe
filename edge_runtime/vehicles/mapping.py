"""From a policy's actions to the units of a vehicle that takes a speed and a steering angle.

One function for each step, and its inverse for the feedback. Pure; angles are positive to the
left, and similarity.py has the scenario's half of the way.

    pedal     -> acceleration of the scenario's car -> the vehicle's -> integrated: its speed
    steering  -> curvature of the car's path -> the vehicle's -> centre angle -> inner wheel
"""

from __future__ import annotations

import math

from edge_runtime.vehicles.similarity import Similarity

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
