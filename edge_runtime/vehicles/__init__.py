"""The door of every vehicle: by name, as an entry point of another package, or as module:Class.

What one of them needs is imported for that one only.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
import math
from importlib import import_module
from importlib.metadata import entry_points
from numbers import Real
from typing import Any, Callable, Iterable, Mapping, Tuple, Type, TypeVar

from edge_runtime.config import BUILT_IN, NONE
from edge_runtime.controller import ActionLimit, Limits
from edge_runtime.manifest import Manifest
from edge_runtime.util import UserError
from edge_runtime.vehicles.base import Vehicle, close_in_time

GROUP = "phil.vehicles"
_Made = TypeVar("_Made")
Tables = Mapping[str, Mapping[str, Any]]  # [vehicle.NAME] of the settings, by name


def make_vehicle(name: str, tables: Tables, manifest: Manifest) -> Vehicle:
    """The driver of that name, open for a policy. Nothing is sent before it is enabled.

    Raises UserError where there is none, for its settings, and where it cannot be opened.
    """
    kind, settings = _find(name, tables)
    vehicle = _call(kind.open, name, settings, manifest)
    check_driver(vehicle)
    return vehicle


def check_driver(vehicle: Any) -> None:
    """Raise UserError for what is no driver, and, closed, for one without proper `limits`."""
    if not isinstance(vehicle, Vehicle):
        raise UserError(f"vehicle {vehicle!r} is no edge_runtime.vehicles.base.Vehicle")
    try:
        if not isinstance(vehicle.name, str):
            raise UserError(f"vehicle {type(vehicle).__name__}: its name must be text")
        _call(lambda: _checked(vehicle.name, vehicle.limits), vehicle.name)
    except UserError:
        close_in_time(vehicle)
        raise


def vehicle_limits(name: str, tables: Tables, manifest: Manifest) -> Limits:
    """What the vehicle of that name lets each action be, without opening anything; "none": {}.

    Raises UserError where there is none, and for its settings.
    """
    if name == NONE:
        return {}
    kind, settings = _find(name, tables)
    return _checked(name, _call(kind.limits_of, name, settings, manifest))


def _checked(name: str, limits: Any) -> Limits:
    """The limits; UserError for what a comparison would let through, or fail on."""
    pairs = limits.items() if isinstance(limits, dict) else [("", None)]
    if not all(isinstance(key, str) and _is_limit(limit) for key, limit in pairs):
        form = "{'pedal': ActionLimit(-1.0, 1.0)} of edge_runtime.controller, low <= high, slew > 0"
        raise UserError(f"vehicle {name}: its limits must be like {form}, not {limits!r}")
    checked: Limits = limits
    return checked


def _is_limit(limit: Any) -> bool:
    if not isinstance(limit, ActionLimit):
        return False
    numbers = (limit.low, limit.high, limit.slew_per_s)
    is_real = all(isinstance(n, Real) and not isinstance(n, bool) for n in numbers)
    return is_real and -math.inf < limit.low <= limit.high < math.inf and limit.slew_per_s > 0.0


def _call(door: Callable[..., _Made], name: str, *arguments: Any) -> _Made:
    try:
        return door(*arguments)
    except UserError:
        raise
    except BaseException as error:  # a stranger's driver raises what its library raises, or exits
        raise UserError(f"vehicle {name} cannot be opened: {_words(error)}") from None


def find_vehicle(name: str) -> Type[Vehicle]:
    """The class of a driver. Raises UserError where it cannot be loaded, or is no Vehicle."""
    place = name if ":" in name else BUILT_IN.get(name)
    if place is None:
        others = {point.name: point.value for point in _others()}
        place = others.get(name)
    if place is None:
        known = ", ".join((NONE, *BUILT_IN, *sorted(others)))
        raise UserError(f"vehicle {name!r} is not known; choose from {known}, or a module:Class")
    module, _, member = place.partition(":")
    try:
        kind = getattr(import_module(module), member)
    except UserError:
        raise
    except BaseException as error:  # whatever a stranger's module raises
        raise UserError(f"vehicle {name!r} cannot be loaded: {_words(error)}") from None
    if not (isinstance(kind, type) and issubclass(kind, Vehicle)):
        raise UserError(f"vehicle {name!r}: {place} is no edge_runtime.vehicles.base.Vehicle")
    if inspect.isabstract(kind):
        lacking = ", ".join(sorted(kind.__abstractmethods__))
        raise UserError(f"vehicle {name!r}: {place} is no whole Vehicle: it lacks {lacking}")
    return kind


def installed_as(own_name: str) -> str:
    """The installed name of the driver that calls itself `own_name`, as a recording has it.

    Where none is installed it is `own_name` itself.
    """
    for point in _others():
        with contextlib.suppress(UserError):
            if find_vehicle(point.value).name == own_name:
                return str(point.name)
    return own_name


def _find(name: str, tables: Tables) -> Tuple[Type[Vehicle], Mapping[str, Any]]:
    """The class, and its table: that of its name here, of a module:Class that of its own name.

    Raises UserError where another looks like it: a misspelt speed cap would stay at its default.
    """
    kind = find_vehicle(name)
    own = kind.name if ":" in name else name
    others = {own, kind.name, *BUILT_IN, *(point.name for point in _others())}
    for table in tables.keys() - others:
        if difflib.get_close_matches(own.lower(), [table.lower()]):
            raise UserError(
                f"[vehicle.{table}] is no table of {name}; did you mean [vehicle.{own}]?"
            )
    return kind, tables.get(own, {})


def _others() -> Iterable[Any]:
    """The entry points of other packages."""
    found: Any = entry_points()
    # Before Python 3.10 a dict of lists; two folders on the path may both name one.
    return found.select(group=GROUP) if hasattr(found, "select") else found.get(GROUP, ())


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
