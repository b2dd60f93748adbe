"""The vehicles that `--vehicle` knows."""

from __future__ import annotations

from typing import Callable, Dict, NamedTuple, Optional, Tuple

import msgspec

from edge_runtime.errors import UserError
from edge_runtime.vehicles.hunter.bus import DEFAULT_BUS, parse_bus
from edge_runtime.vehicles.hunter.set_point import limits_of
from edge_runtime.vehicles.hunter.specs import SPECS, HunterSpec
from edge_runtime.vehicles.interface import ActionLimit, Vehicle
from edge_runtime.vehicles.mock import MockParameters, MockVehicle
from edge_runtime.vehicles.ros2.settings import Ros2Settings
from edge_runtime.vehicles.settings import HunterSettings, SimilaritySettings
from edge_runtime.vehicles.similarity import CARS, ScenarioCar, Similarity, car_of, similarity_to

NONE = "none"


class VehicleSetup(NamedTuple):
    """What a driver is made from: the policy's scenario, and the settings of all vehicles."""

    scenario: str = ""
    bus: str = DEFAULT_BUS
    hunter: HunterSettings = HunterSettings()
    similarity: SimilaritySettings = SimilaritySettings()
    ros2: Ros2Settings = Ros2Settings()


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
    # Imported here: its thread and its bus are for those who have one.
    from edge_runtime.vehicles.hunter.vehicle import HunterVehicle

    spec, similarity = _robot("hunter", setup)
    return HunterVehicle(parse_bus(setup.bus), spec, setup.hunter.profile, similarity)


def _ros2(setup: VehicleSetup) -> Vehicle:
    from edge_runtime.vehicles.ros2.vehicle import Ros2Vehicle  # As above; and it needs pycdr2.

    spec, similarity = _robot("ros2", setup)
    return Ros2Vehicle(setup.ros2, spec, similarity)


_MAKERS: Dict[str, Callable[[VehicleSetup], Vehicle]] = {
    "mock": _mock,
    "hunter": _hunter,
    "ros2": _ros2,
}
VEHICLE_NAMES = (NONE, *_MAKERS)


def make_vehicle(name: str, setup: Optional[VehicleSetup] = None) -> Optional[Vehicle]:
    """The driver of that name; None for "none". Nothing is sent before it is enabled.

    Raises UserError for any other name, for a scenario that the vehicle cannot follow, and where
    what it hangs on cannot be opened.
    """
    if name == NONE:
        return None
    _check_known(name)
    return _MAKERS[name](setup or VehicleSetup())


def vehicle_limits(name: str, setup: VehicleSetup) -> Dict[str, ActionLimit]:
    """What the vehicle of that name lets each action be, without opening anything; "none": {}.

    Raises UserError for any other name, and for a scenario that the vehicle cannot follow.
    """
    if name == NONE:
        return {}
    _check_known(name)
    if name == MockVehicle.name:
        return MockVehicle.limits
    return limits_of(*_robot(name, setup))


def _check_known(name: str) -> None:
    if name not in _MAKERS:
        raise UserError(f"vehicle {name!r} is not known; choose from {', '.join(VEHICLE_NAMES)}")


def make_similarity(setup: VehicleSetup, name: str, max_speed_mps: float) -> Similarity:
    """From the policy's car to a vehicle of this name and top speed. Raises UserError."""
    settings = setup.similarity
    if settings.car is not None:
        car = ScenarioCar(**msgspec.structs.asdict(settings.car))
    else:
        car = car_of(setup.scenario, name)
    return similarity_to(car, max_speed_mps, settings.scale)
