"""The vehicles that `--vehicle` knows. What one of them needs is imported for that one only."""

from __future__ import annotations

from typing import Callable, Dict, Optional, Tuple

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
    HunterSpec,
    ScenarioCar,
    Similarity,
    car_of,
    limits_of,
    similarity_to,
)
from edge_runtime.vehicles.mock import MockParameters, MockVehicle


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


def _robot(name: str, setup: VehicleSetup) -> Tuple[HunterSpec, Similarity]:
    """The chassis behind a driver, and how it stands to the policy's car. Raises UserError."""
    model = setup.ros2.model if name == "ros2" else setup.hunter.model
    spec = SPECS[model]
    return spec, make_similarity(setup, name, spec.max_speed_mps)


def _hunter(setup: VehicleSetup) -> Vehicle:
    from edge_runtime.vehicles.hunter.bus import HunterVehicle, parse_bus

    spec, similarity = _robot("hunter", setup)
    return HunterVehicle(parse_bus(setup.bus), spec, setup.hunter.profile, similarity)


def _ros2(setup: VehicleSetup) -> Vehicle:
    from edge_runtime.vehicles.ros2.vehicle import Ros2Vehicle

    spec, similarity = _robot("ros2", setup)
    return Ros2Vehicle(setup.ros2, spec, similarity)


_MAKERS: Dict[str, Callable[[VehicleSetup], Vehicle]] = {
    "mock": _mock,
    "hunter": _hunter,
    "ros2": _ros2,
}


def make_vehicle(name: str, setup: Optional[VehicleSetup] = None) -> Optional[Vehicle]:
    """The driver of that name; None for "none". Nothing is sent before it is enabled.

    Raises UserError for any other name, for a scenario that the vehicle cannot follow, and where
    what it hangs on cannot be opened.
    """
    check_choice("vehicle", name, VEHICLE_NAMES)
    if name == NONE:
        return None
    return _MAKERS[name](setup or VehicleSetup())


def vehicle_limits(name: str, setup: VehicleSetup) -> Dict[str, ActionLimit]:
    """What the vehicle of that name lets each action be, without opening anything; "none": {}.

    Raises UserError for any other name, and for a scenario that the vehicle cannot follow.
    """
    check_choice("vehicle", name, VEHICLE_NAMES)
    if name == NONE:
        return {}
    if name == MockVehicle.name:
        return MockVehicle.limits
    return limits_of(*_robot(name, setup))


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
        # To the right, the full angle is below 0.
        size = abs(value) if name == "full_steering_rad" else value
        if not 0.0 < size < float("inf") or (name == "full_steering_rad" and size >= 1.5):
            raise UserError(f"similarity: {name} {value} is not valid: it must be {_range(name)}")


def _range(name: str) -> str:
    angle = name == "full_steering_rad"
    return "above 0 and below 1.5 rad, or below 0 and above -1.5" if angle else "above 0"


def make_similarity(setup: VehicleSetup, name: str, max_speed_mps: float) -> Similarity:
    """From the policy's car to a vehicle of this name and top speed. Raises UserError."""
    settings = setup.similarity
    if settings.car is not None:
        car = ScenarioCar(**msgspec.structs.asdict(settings.car))
    else:
        car = car_of(setup.scenario, name)
    return similarity_to(car, max_speed_mps, settings.scale)
