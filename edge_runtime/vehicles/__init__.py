"""Find and open a vehicle's driver: by name, as another package's entry point, or as module:Class.

Only the chosen driver's module is imported.
"""

from __future__ import annotations

import contextlib
import difflib
import math
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Callable, Iterable, Mapping, Tuple, Type, TypeVar

from edge_runtime.bounds import NO_BOUNDS, Bounds, check_bounds, narrowed
from edge_runtime.config import BUILT_IN, NONE
from edge_runtime.controller import Limits
from edge_runtime.manifest import Manifest
from edge_runtime.util import UserError
from edge_runtime.vehicles.base import Vehicle, close_in_time

GROUP = "phil.vehicles"
_Made = TypeVar("_Made")
Tables = Mapping[str, Mapping[str, Any]]  # [vehicle.NAME] of the settings, by name


def make_vehicle(name: str, tables: Tables, manifest: Manifest) -> Vehicle:
    """Open the named driver for a policy, without sending anything; UserError where that fails."""
    kind, settings = _find(name, tables)
    vehicle = _call(name, kind.open, settings, manifest)
    check_driver(vehicle)
    return vehicle


def check_driver(vehicle: Any) -> None:
    """Raise UserError for what is no driver; for one with invalid `limits`, close it and raise."""
    if not isinstance(vehicle, Vehicle):
        raise UserError(f"vehicle {vehicle!r} is no edge_runtime.vehicles.base.Vehicle")
    try:
        _call(vehicle.name, lambda: _checked(vehicle.name, vehicle.limits))
    except UserError:
        close_in_time(vehicle)
        raise


def vehicle_limits(
    name: str, tables: Tables, manifest: Manifest, bounds: Bounds = NO_BOUNDS
) -> Limits:
    """Return the limits of a vehicle within the bounds, opening nothing; of "none": {}."""
    if name == NONE:
        return {}
    kind, settings = _find(name, tables)
    limits, model = _call(name, kind.limits_of, settings, manifest)
    check_bounds(bounds, model, name)
    return narrowed(_checked(name, limits), bounds, model)


def _checked(name: str, limits: Any) -> Limits:
    """Return the limits if they are a table of finite, ordered ranges, else raise UserError."""
    with contextlib.suppress(AttributeError, TypeError):
        rows = limits.values()
        within = (-math.inf < row.low <= row.high < math.inf and row.slew_per_s > 0 for row in rows)
        if rows and all(within):
            checked: Limits = limits
            return checked
    form = "{'pedal': ActionLimit(-1.0, 1.0)} of edge_runtime.controller, low <= high, slew > 0"
    raise UserError(f"vehicle {name}: its limits must be like {form}, not {limits!r}")


def _call(what: str, function: Callable[..., _Made], *arguments: Any) -> _Made:
    """Call a driver's code, which may raise anything or exit; UserError then."""
    try:
        return function(*arguments)
    except UserError:
        raise
    except BaseException as error:
        words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise UserError(f"vehicle {what} cannot be opened: {words}") from None


def find_vehicle(name: str) -> Type[Vehicle]:
    """Return the class of a driver. Raises UserError if it is no Vehicle, or cannot be loaded."""
    place = name if ":" in name else BUILT_IN.get(name)
    if place is None:
        others = {point.name: point.value for point in _entry_points()}
        if (place := others.get(name)) is None:
            known = ", ".join((NONE, *BUILT_IN, *sorted(others)))
            words = f"vehicle {name!r} is not known; choose from {known}, or a module:Class"
            raise UserError(words)
    module, _, member = place.partition(":")
    kind = _call(name, lambda: getattr(import_module(module), member))
    if not (isinstance(kind, type) and issubclass(kind, Vehicle)):
        raise UserError(f"vehicle {name!r}: {place} is no edge_runtime.vehicles.base.Vehicle")
    return kind


def _find(name: str, tables: Tables) -> Tuple[Type[Vehicle], Mapping[str, Any]]:
    """Return a driver's class and settings; a module:Class has the table of its own `name`.

    Raises UserError for a table with a similar name: a misspelt table would have no effect.
    """
    kind = find_vehicle(name)
    own = kind.name if ":" in name else name
    others = {own, kind.name, *BUILT_IN, *(point.name for point in _entry_points())}
    for table in difflib.get_close_matches(own, tables.keys() - others):
        raise UserError(f"[vehicle.{table}] is no table of {name}; did you mean [vehicle.{own}]?")
    return kind, tables.get(own, {})


def _entry_points() -> Iterable[Any]:
    points: Any = entry_points()
    # A dict of lists before Python 3.10. Two folders on the path may both name a driver.
    return points.select(group=GROUP) if hasattr(points, "select") else points.get(GROUP, ())
