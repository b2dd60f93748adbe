"""From a policy's actions to the units of a small robot, and back for its feedback. Pure.

The robot drives the scenario car's path shrunk by `scale`, in the same time: speed and acceleration
are times `scale`, curvature is divided by it, and the policy's pictures and control period stay
valid. Steering is converted by equal path, through each vehicle's own geometry. Angles are positive
to the left.

    pedal     -> acceleration of the scenario's car -> the robot's -> integrated: its speed
    steering  -> curvature of the car's path -> the robot's -> centre angle -> inner wheel
"""

from __future__ import annotations

import math
from typing import Dict, NamedTuple, Optional

import msgspec

from edge_runtime.bounds import Bounds, Model
from edge_runtime.config import check_choice
from edge_runtime.controller import ActionLimit
from edge_runtime.manifest import Car, Manifest
from edge_runtime.util import UserError

# The set-point leads the measured speed by at most full acceleration for this time: a vehicle that
# was held up must not leap when it comes free (anti-windup).
LEAD_S = 0.5
RUNAWAY = 0.2  # of top speed, twice plausibility.DEVIATION: the set-point stays this far below
_LONGEST_STEP_S = 0.1  # the pedal was not held throughout a pause of the process


def clamp(value: float, most: float) -> float:
    return min(max(value, -most), most)


class HunterSpec(NamedTuple):
    """A model's limits and geometry. Angles are those of the inner front wheel, as commanded.

    Speed, angle, wheelbase and track: the maker's data sheets. The steering rate is in none of
    them: it is how fast this runtime lets the request change, and the chassis may be slower.
    """

    max_speed_mps: float
    max_inner_steering_rad: float
    wheelbase_m: float
    track_m: float
    max_steering_rate_radps: float

    def inner_rad(self, centre_rad: float) -> float:
        """Return the inner wheel's angle for a centre angle (Ackermann), within its limit."""
        most_rad = self.centre_rad(self.max_inner_steering_rad)
        return self._turned(min(abs(centre_rad), most_rad), centre_rad, -0.5 * self.track_m)

    def centre_rad(self, inner_rad: float) -> float:
        """Return the centre angle for an inner wheel's angle: the inverse of `inner_rad`."""
        return self._turned(abs(inner_rad), inner_rad, 0.5 * self.track_m)

    def _turned(self, angle_rad: float, sign: float, wider_m: float) -> float:
        """Return the angle of a wheel whose turning circle's radius is `wider_m` larger."""
        slope = math.tan(angle_rad)
        turned_rad = math.atan2(self.wheelbase_m * slope, self.wheelbase_m + wider_m * slope)
        return math.copysign(turned_rad, sign)


SPECS: Dict[str, HunterSpec] = {
    "2.0": HunterSpec(1.5, 0.576, 0.650, 0.605, 1.0),
    # The track is given as 0.46 to 0.52 m, by position of the measurement: measure it. The angle
    # is given as 0.400 or 0.384 rad.
    "se": HunterSpec(4.8, 0.384, 0.550, 0.490, 1.0),
}


class Similarity(NamedTuple):
    """A robot in place of the scenario's car. `scale`: its metres for a metre of the scenario."""

    car: Car
    spec: HunterSpec
    scale: float

    def acceleration_mps2(self, pedal: float) -> float:
        """Return the robot's acceleration for a pedal in -1 to 1: throttle above 0, brake below."""
        full_mps2 = self.car.throttle_mps2 if pedal > 0 else self.car.brake_mps2
        return pedal * full_mps2 * self.scale

    def pedal(self, acceleration_mps2: float) -> float:
        """Return the pedal that gives the robot this acceleration, within -1 to 1."""
        full_mps2 = self.car.throttle_mps2 if acceleration_mps2 > 0 else self.car.brake_mps2
        return clamp(acceleration_mps2 / self.scale / full_mps2, 1.0)

    def centre_rad(self, steering: float) -> float:
        """Return the centre angle for a steering: the robot is a bicycle about its rear axle."""
        return math.atan(self.spec.wheelbase_m * (self.car.curvature(steering) / self.scale))

    def steering(self, centre_rad: float) -> float:
        """Return the steering whose path the robot drives, within -1 to 1."""
        curvature = math.tan(centre_rad) / self.spec.wheelbase_m
        return clamp(self.car.steering(curvature * self.scale), 1.0)

    @property
    def reach(self) -> float:
        """The most steering that the robot's wheels allow."""
        return abs(self.steering(self.spec.centre_rad(self.spec.max_inner_steering_rad)))

    @property
    def full_rad(self) -> float:
        """The inner wheel's angle at the most steering."""
        return abs(self.spec.inner_rad(self.centre_rad(self.reach)))

    def model(self) -> Model:
        return Model(self.spec.max_speed_mps, self.spec.max_inner_steering_rad, self.full_rad)

    def limits(self) -> Dict[str, ActionLimit]:
        """Return ranges and slew rates. A pedal is integrated: any leap of it is a ramp."""
        reach, full_rad = self.reach, self.full_rad
        rate_per_s = self.spec.max_steering_rate_radps * reach / full_rad
        return {
            "pedal": ActionLimit(-1.0, 1.0, math.inf),
            "steering": ActionLimit(-reach, reach, rate_per_s),
        }


def similarity_to(car: Car, spec: HunterSpec, scale: Optional[float] = None) -> Similarity:
    """Return the similarity of a robot; by default the two top speeds correspond."""
    return Similarity(car, spec, spec.max_speed_mps / car.max_speed_mps if scale is None else scale)


class RobotSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of every vehicle that takes a speed and an angle; `car` overrides the manifest's.

    `scale`: metres of the vehicle for a metre of the scenario; None: the top speeds correspond.
    """

    model: str = "2.0"
    scale: Optional[float] = None
    car: Optional[Car] = None

    def similarity(self, vehicle: str, manifest: Manifest) -> Similarity:
        """Return the similarity to the policy's car. Raises UserError for bad settings."""
        table = f"[vehicle.{vehicle}]"
        check_choice(f"{table} model", self.model, tuple(SPECS))
        car = self.car or manifest.car
        if car is None:
            raise UserError(
                f"the manifest of {manifest.task!r} does not say which car it was trained on: set"
                f" car in {table} of --config"
            )
        similarity = similarity_to(car, SPECS[self.model], self.scale)
        numbers = {**msgspec.structs.asdict(car), "scale": similarity.scale}
        full_rad = numbers.pop("full_steering_rad")  # below 0 where it turns to the right
        if not (0.0 < abs(full_rad) < 1.5 and all(0.0 < n < math.inf for n in numbers.values())):
            raise UserError(
                f"{table}: scale or car is not valid: numbers above 0, and full_steering_rad below"
                f" 1.5 to either side, not {numbers} and {full_rad}"
            )
        return similarity


class Wish(NamedTuple):
    """A command: the pedal, or the speed of the scenario's car; the steering stays where None."""

    pedal: Optional[float]
    scenario_speed_mps: Optional[float]
    steering: Optional[float]


def wish_of(action: Dict[str, float], scenario_speed_mps: Optional[float]) -> Wish:
    """Read an action, clamped to -1 to 1; ValueError if not finite, or without pedal and speed."""
    if not all(map(math.isfinite, [*action.values(), scenario_speed_mps or 0.0])):
        raise ValueError(f"a command that is not finite: {action}, {scenario_speed_mps} m/s")
    if not action or ("pedal" not in action and scenario_speed_mps is None):
        raise ValueError(f"a command that lacks an action: {action}, {scenario_speed_mps} m/s")
    # A pedal of 1e308 times a step of 0 s is no number.
    within = {name: clamp(value, 1.0) for name, value in action.items()}
    return Wish(within.get("pedal"), scenario_speed_mps, within.get("steering"))


class SetPoint:
    """Speed and inner wheel's angle that are asked of the vehicle now, within its limits."""

    def __init__(self, similarity: Similarity) -> None:
        self.speed_mps = 0.0
        self.inner_rad = 0.0
        self.spec = similarity.spec  # the model's limits, or the operator's below them
        self._similarity = similarity

    def take_bounds(self, bounds: Bounds) -> None:
        spec = self.spec
        self.spec = spec._replace(
            max_speed_mps=min(spec.max_speed_mps, bounds.max_speed_mps),
            max_inner_steering_rad=min(spec.max_inner_steering_rad, bounds.max_steering_rad),
        )

    def follow(self, wish: Wish, step_s: float, measured_mps: float) -> None:
        """Go on towards a command that was in force for `step_s`."""
        similarity, spec = self._similarity, self.spec
        step_s = min(max(step_s, 0.0), _LONGEST_STEP_S)
        if wish.pedal is not None:
            lead_mps = similarity.acceleration_mps2(1.0) * LEAD_S
            speed_mps = self.speed_mps + similarity.acceleration_mps2(wish.pedal) * step_s
            speed_mps = min(speed_mps, measured_mps + lead_mps)
            if wish.pedal > 0:  # no floor while braking: a weak brake is asked for more
                behind_mps = max(lead_mps, RUNAWAY * spec.max_speed_mps)
                speed_mps = max(speed_mps, measured_mps - behind_mps)
        else:  # the scenario has the pedals
            gap_mps = (wish.scenario_speed_mps or 0.0) * similarity.scale - self.speed_mps
            least_mps, most_mps = (similarity.acceleration_mps2(p) * step_s for p in (-1.0, 1.0))
            speed_mps = self.speed_mps + min(max(gap_mps, least_mps), most_mps)
        self.speed_mps = min(max(speed_mps, 0.0), spec.max_speed_mps)
        if wish.steering is not None:
            wanted_rad = spec.inner_rad(similarity.centre_rad(wish.steering))
            most_rad = spec.max_steering_rate_radps * step_s
            self.inner_rad += clamp(wanted_rad - self.inner_rad, most_rad)
