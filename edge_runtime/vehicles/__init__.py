"""Vehicle drivers, and those that `--vehicle` knows by name.

What one of them needs is imported for that one only.
"""

from __future__ import annotations

from typing import Dict

import msgspec

from edge_runtime.config import (
    DEFAULT_BUS,
    NONE,
    VEHICLE_NAMES,
    Config,
    HunterSettings,
    Ros2Settings,
    check_choice,
)
from edge_runtime.controller import ActionLimit
from edge_runtime.util import UserError
from edge_runtime.vehicles.base import Vehicle
from edge_runtime.vehicles.mapping import (
    CARS,
    SPECS,
    ScenarioCar,
    Similarity,
    car_of,
    similarity_to,
)
from edge_runtime.vehicles.mock import MockParameters, MockVehicle


def make_vehicle(name: str, config: Config, scenario: str) -> Vehicle:
    """The driver of that name for a policy of that scenario. Nothing is sent before it is enabled.

    Raises UserError for any other name, for a scenario that the vehicle cannot follow, and where
    what it hangs on cannot be opened.
    """
    check_choice("vehicle", name, VEHICLE_NAMES[1:])
    if name == "mock":
        return _mock(config, scenario)
    similarity = _similarity(name, config, scenario)
    if name == "hunter":
        from edge_runtime.vehicles.hunter import HunterVehicle, parse_bus

        return HunterVehicle(parse_bus(config.bus), similarity, config.hunter.profile)
    from edge_runtime.vehicles.ros2 import Ros2Vehicle

    return Ros2Vehicle(config.ros2, similarity)


def vehicle_limits(name: str, config: Config, scenario: str) -> Dict[str, ActionLimit]:
    """What the vehicle of that name lets each action be, without opening anything; "none": {}.

    Raises UserError for any other name, and for a scenario that the vehicle cannot follow.
    """
    check_choice("vehicle", name, VEHICLE_NAMES)
    if name == NONE:
        return {}
    if name == "mock":
        return MockVehicle.limits
    return _similarity(name, config, scenario).limits()


def _mock(config: Config, scenario: str) -> Vehicle:
    """As quick as the policy's car, where that is known."""
    car = config.similarity.car or CARS.get(scenario)
    if car is None:
        return MockVehicle()
    return MockVehicle(
        MockParameters(
            throttle_mps2=car.throttle_mps2,
            brake_mps2=car.brake_mps2,
            max_speed_mps=car.max_speed_mps,
        )
    )


def _similarity(name: str, config: Config, scenario: str) -> Similarity:
    """From the policy's car to the chassis of the vehicle of that name. Raises UserError."""
    given = config.similarity.car
    car = ScenarioCar(**msgspec.structs.asdict(given)) if given else car_of(scenario, name)
    model = config.ros2.model if name == "ros2" else config.hunter.model
    return similarity_to(car, SPECS[model], config.similarity.scale)


def check_settings(config: Config) -> None:
    """Raise UserError for settings that are not valid, whichever vehicle is chosen.

    The defaults are valid (a test), and load nothing.
    """
    if (config.bus, config.hunter) != (DEFAULT_BUS, HunterSettings()):
        from edge_runtime.vehicles.hunter import parse_bus, protocol

        parse_bus(config.bus)
        check_choice("hunter.model", config.hunter.model, tuple(SPECS))
        check_choice("hunter.profile", config.hunter.profile, tuple(protocol.PROFILES))
    if config.ros2 != Ros2Settings():
        from edge_runtime.vehicles import ros2

        ros2.check_settings(config.ros2)
    car, scale = config.similarity.car, config.similarity.scale
    numbers = {} if car is None else msgspec.structs.asdict(car)
    if scale is not None:
        numbers["scale"] = scale
    for name, value in numbers.items():
        fits, words = 0.0 < value < float("inf"), "above 0"
        if name == "full_steering_rad":  # to the right, the full angle is below 0
            fits = 0.0 < abs(value) < 1.5
            words = "above 0 and below 1.5 rad, or below 0 and above -1.5"
        if not fits:
            raise UserError(f"similarity: {name} {value} is not valid: it must be {words}")
