"""A simulated vehicle: dead time, rate limit and first-order lag before the wheels obey.

It integrates its motion up to the time it is asked about, and needs no thread.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, ClassVar, Deque, Dict, Mapping, Optional, Tuple

import msgspec

from edge_runtime.bounds import Model
from edge_runtime.config import convert
from edge_runtime.controller import ActionLimit, Limits
from edge_runtime.manifest import Manifest
from edge_runtime.util import UserError
from edge_runtime.vehicles.base import Vehicle, VehicleReport
from edge_runtime.vehicles.mapping import clamp

_INTEGRATION_STEP_S = 0.005
_LONGEST_GAP_S = 10.0  # without a command it then stands, whatever it did before


class MockParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Actuators (rates in full pedal or steering per second), and a body. [vehicle.mock]."""

    dead_time_s: float = 0.02
    time_constant_s: float = 0.05
    slew_per_s: float = 40.0
    throttle_mps2: float = 3.0  # at full pedal
    brake_mps2: float = 4.0
    max_speed_mps: float = 6.0


class MockVehicle(Vehicle):
    """Obeys pedal and steering; brakes by itself when no command came for 2 T."""

    name: ClassVar[str] = "mock"
    # No slew limit: in lock-step, states follow one another faster than the mock's time, and every
    # action must pass unchanged. The actuators' rate and lag act on it later.
    limits: Dict[str, ActionLimit] = dict.fromkeys(("pedal", "steering"), ActionLimit(-1.0, 1.0))

    def __init__(
        self, parameters: Optional[MockParameters] = None, full_steering_rad: float = math.inf
    ) -> None:
        self._parameters = parameters or MockParameters()
        top_mps = self._parameters.max_speed_mps
        self.model_limits = Model(top_mps, full_steering_rad, full_steering_rad)
        self._pedal, self._steering, self._speed_mps = -1.0, 0.0, 0.0
        self._now_s, self._commanded_s = math.inf, -math.inf  # its time begins with the first call
        self._on_the_way: Deque[Tuple[float, Tuple[float, float]]] = deque()
        self._target = (-1.0, 0.0)
        self._latched = True  # until it is enabled

    @classmethod
    def open(cls, settings: Mapping[str, Any], manifest: Manifest) -> Vehicle:
        """Make a mock with the body of the policy's car, unless the settings say otherwise."""
        car = msgspec.structs.asdict(manifest.car) if manifest.car else {}
        known = {name: car[name] for name in MockParameters.__struct_fields__ if name in car}
        parameters = convert({**known, **settings}, MockParameters, "vehicle.mock")
        for key, value in msgspec.structs.asdict(parameters).items():
            if not (0.0 < value < math.inf or (key, value) == ("dead_time_s", 0.0)):
                raise UserError(f"[vehicle.mock]: {key} {value} is not valid: it must be above 0")
        return cls(parameters, abs(manifest.car.full_steering_rad) if manifest.car else math.inf)

    @classmethod
    def limits_of(cls, settings: Mapping[str, Any], manifest: Manifest) -> Tuple[Limits, Model]:
        made = cls.open(settings, manifest)  # it opens nothing
        return made.limits, made.model_limits

    def enable(self, now_s: float) -> None:
        """Release the latch; the brake is on until the first command."""
        self._integrate(now_s)
        self._latched = False

    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """Take an action; a missing one is zero: no pedal, wheels straight."""
        if not action.keys() & self.limits.keys():
            raise ValueError(f"a command that lacks an action: {action}")
        if not all(map(math.isfinite, action.values())):
            raise ValueError(f"a command that is not finite: {action}")
        self._integrate(now_s)
        if not self._latched:
            self._commanded_s = now_s
            target = (clamp(action.get("pedal", 0.0), 1.0), clamp(action.get("steering", 0.0), 1.0))
            self._on_the_way.append((now_s + self._parameters.dead_time_s, target))

    def brake(self, now_s: float, latch: bool = True) -> None:
        """Brake at once, without the dead time of a command."""
        self._integrate(now_s)
        self._latched = self._latched or latch
        self._on_the_way.clear()
        self._commanded_s = now_s
        self._target = (-1.0, self._target[1])

    def feedback(self, now_s: float) -> VehicleReport:
        self._integrate(now_s)
        action = {"pedal": self._pedal, "steering": self._steering}
        return VehicleReport(action, self._speed_mps, self._is_left_alone(now_s), faults=[])

    def close(self) -> None:
        self._latched = True
        self._on_the_way.clear()
        self._target = (-1.0, self._target[1])

    def _is_left_alone(self, now_s: float) -> bool:
        return now_s - self._commanded_s > 2 * self.control_period_s

    def _integrate(self, until_s: float) -> None:
        car = self._parameters
        self._now_s = max(min(self._now_s, until_s), until_s - _LONGEST_GAP_S)
        while until_s - self._now_s > 1e-9:
            step_s = min(_INTEGRATION_STEP_S, until_s - self._now_s)
            self._now_s += step_s
            while self._on_the_way and self._on_the_way[0][0] <= self._now_s:
                _, self._target = self._on_the_way.popleft()
            if self._is_left_alone(self._now_s):
                self._target = (-1.0, self._target[1])
            self._pedal = self._follow(self._pedal, self._target[0], step_s)
            self._steering = self._follow(self._steering, self._target[1], step_s)
            full_mps2 = car.throttle_mps2 if self._pedal > 0.0 else car.brake_mps2
            speed_mps = self._speed_mps + self._pedal * full_mps2 * step_s
            most_mps = min(car.max_speed_mps, self.allowed.max_speed_mps)
            self._speed_mps = min(max(speed_mps, 0.0), most_mps)

    def _follow(self, position: float, target: float, step_s: float) -> float:
        """Lag towards the target by the time constant, no faster than the actuator's rate."""
        change = (target - position) * (1.0 - math.exp(-step_s / self._parameters.time_constant_s))
        return position + clamp(change, self._parameters.slew_per_s * step_s)
