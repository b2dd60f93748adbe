"""The vehicles that `--vehicle` knows."""

from __future__ import annotations

from typing import Callable, Dict, Optional

from edge_runtime.errors import UserError
from edge_runtime.vehicles.interface import Vehicle
from edge_runtime.vehicles.mock import MockVehicle

NONE = "none"


def _hunter() -> Vehicle:
    raise UserError("the driver for the hunter is not built yet; use --vehicle mock or none")


_MAKERS: Dict[str, Callable[[], Vehicle]] = {"mock": MockVehicle, "hunter": _hunter}
VEHICLE_NAMES = (NONE, *_MAKERS)


def make_vehicle(name: str) -> Optional[Vehicle]:
    """The driver of that name; None for "none". Raises UserError for any other name."""
    if name == NONE:
        return None
    if name not in _MAKERS:
        raise UserError(f"vehicle {name!r} is not known; choose from {', '.join(VEHICLE_NAMES)}")
    return _MAKERS[name]()
