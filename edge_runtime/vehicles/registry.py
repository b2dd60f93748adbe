"""The vehicles that `--vehicle` knows."""

from __future__ import annotations

from typing import Callable, Dict, NamedTuple, Optional

import msgspec

from edge_runtime.errors import UserError
from edge_runtime.vehicles.hunter.bus import DEFAULT_BUS, parse_bus
from edge_runtime.vehicles.hunter.specs import SPECS
from edge_runtime.vehicles.interface import Vehicle
from edge_runtime.vehicles.mock import MockVehicle
from edge_runtime.vehicles.settings import HunterSettings, SimilaritySettings
from edge_runtime.vehicles.similarity import ScenarioCar, Similarity, car_of, similarity_to

NONE = "none"


class VehicleSetup(NamedTuple):
    """What a driver is made from: the policy's scenario, and the settings of all vehicles."""

    scenario: str = ""
    bus: str = DEFAULT_BUS
    hunter: HunterSettings = HunterSettings()
    similarity: SimilaritySettings = SimilaritySettings()


def _mock(setup: VehicleSetup) -> Vehicle:
    return MockVehicle()


def _hunter(setup: VehicleSetup) -> Vehicle:
    # Imported here: its thread and its bus are for those who have one.
    from edge_runtime.vehicles.hunter.vehicle import HunterVehicle

    spec = SPECS[setup.hunter.model]
    similarity = make_similarity(setup, "hunter", spec.max_speed_mps)
    return HunterVehicle(parse_bus(setup.bus), spec, setup.hunter.profile, similarity)


_MAKERS: Dict[str, Callable[[VehicleSetup], Vehicle]] = {"mock": _mock, "hunter": _hunter}
VEHICLE_NAMES = (NONE, *_MAKERS)


def make_vehicle(name: str, setup: Optional[VehicleSetup] = None) -> Optional[Vehicle]:
    """The driver of that name; None for "none". Nothing is sent before it is enabled.

    Raises UserError for any other name, for a scenario that the vehicle cannot follow, and where
    what it hangs on cannot be opened.
    """
    if name == NONE:
        return None
    if name not in _MAKERS:
        raise UserError(f"vehicle {name!r} is not known; choose from {', '.join(VEHICLE_NAMES)}")
    return _MAKERS[name](setup or VehicleSetup())


def make_similarity(setup: VehicleSetup, name: str, max_speed_mps: float) -> Similarity:
    """From the policy's car to a vehicle of this name and top speed. Raises UserError."""
    settings = setup.similarity
    if settings.car is not None:
        car = ScenarioCar(**msgspec.structs.asdict(settings.car))
    else:
        car = car_of(setup.scenario, name)
    return similarity_to(car, max_speed_mps, settings.scale)
