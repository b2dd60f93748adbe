"""The vehicles that `--vehicle` knows. What one of them needs is imported for that one only."""

from __future__ import annotations

from typing import Dict, Optional

import msgspec

from edge_runtime.config import (
    DEFAULT_BUS,
    NONE,
    VEHICLE_NAMES,
    HunterSettings,
    Ros2Settings,
    SimilaritySettings,
    VehicleSetup,
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


def make_vehicle(name: str, setup: Optional[VehicleSetup] = None) -> Vehicle:
    """The driver of that name. Nothing is sent before it is enabled.

    Raises UserError for any other name, for a scenario that the vehicle cannot follow, and where
    what it hangs on cannot be opened.
    """
    check_choice("vehicle", name, VEHICLE_NAMES[1:])
    setup = setup or VehicleSetup()
    if name == "mock":
        return _mock(setup)
    similarity = _similarity(name, setup)
    if name == "hunter":
        from edge_runtime.vehicles.hunter.bus import HunterVehicle, parse_bus

        return HunterVehicle(parse_bus(setup.bus), similarity, setup.hunter.profile)
    from edge_runtime.vehicles.ros2.vehicle import Ros2Vehicle

    return Ros2Vehicle(setup.ros2, similarity)


def vehicle_limits(name: str, setup: VehicleSetup) -> Dict[str, ActionLimit]:
    """What the vehicle of that name lets each action be, without opening anything; "none": {}.

    Raises UserError for any other name, and for a scenario that the vehicle cannot follow.
    """
    check_choice("vehicle", name, VEHICLE_NAMES)
    if name == NONE:
        return {}
    if name == "mock":
        return MockVehicle.limits
    return _similarity(name, setup).limits()


def _mock(setup: VehicleSetup) -> Vehicle:
    """As quick as the policy's car, where that is known."""
    car = setup.similarity.car or CARS.get(setup.scenario)
    if car is None:
        return MockVehicle()
    limits = MockParameters(
        throttle_mps2=car.throttle_mps2,
        brake_mps2=car.brake_mps2,
        max_speed_mps=car.max_speed_mps,
    )
    return MockVehicle(limits)


def _similarity(name: str, setup: VehicleSetup) -> Similarity:
    """From the policy's car to the chassis of the vehicle of that name. Raises UserError."""
    settings = setup.similarity
    if settings.car is not None:
        car = ScenarioCar(**msgspec.structs.asdict(settings.car))
    else:
        car = car_of(setup.scenario, name)
    model = setup.ros2.model if name == "ros2" else setup.hunter.model
    return similarity_to(car, SPECS[model], settings.scale)


def check_setup(setup: VehicleSetup) -> None:
    """Raise UserError for settings that are not valid, whichever vehicle is chosen.

    The defaults are valid (a test), and load nothing.
    """
    if (setup.bus, setup.hunter) != (DEFAULT_BUS, HunterSettings()):
        from edge_runtime.vehicles.hunter import bus, protocol

        bus.parse_bus(setup.bus)
        check_choice("hunter.model", setup.hunter.model, tuple(SPECS))
        check_choice("hunter.profile", setup.hunter.profile, tuple(protocol.PROFILES))
    _check_similarity(setup.similarity)
    if setup.ros2 != Ros2Settings():
        from edge_runtime.vehicles.ros2.names import check_settings

        check_settings(setup.ros2)


def _check_similarity(settings: SimilaritySettings) -> None:
    numbers = {} if settings.car is None else msgspec.structs.asdict(settings.car)
    if settings.scale is not None:
        numbers["scale"] = settings.scale
    for name, value in numbers.items():
        fits, words = 0.0 < value < float("inf"), "above 0"
        if name == "full_steering_rad":  # to the right, the full angle is below 0
            fits = 0.0 < abs(value) < 1.5
            words = "above 0 and below 1.5 rad, or below 0 and above -1.5"
        if not fits:
            raise UserError(f"similarity: {name} {value} is not valid: it must be {words}")
