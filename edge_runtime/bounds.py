"""An operator's limits for a vehicle: speed, steering, distance until the next re-arm. Pure."""

from __future__ import annotations

import math
from typing import NamedTuple

from edge_runtime.controller import Limits
from edge_runtime.util import UserError

STEERING = "steering"


class Bounds(NamedTuple):
    """The settings of these names in [vehicle]; inf: no limit."""

    max_speed_mps: float = math.inf
    max_steering_rad: float = math.inf
    leash_m: float = math.inf


NO_BOUNDS = Bounds()


class Model(NamedTuple):
    """A vehicle's physical limits, as its driver knows them (inf: unknown).

    `full_steering_rad` is the angle at the ends of `limits["steering"]`. Angles are those of the
    wheel that the driver commands: a Hunter's inner one.
    """

    max_speed_mps: float = math.inf
    max_steering_rad: float = math.inf
    full_steering_rad: float = math.inf


def check_bounds(bounds: Bounds, model: Model, vehicle: str) -> None:
    """Raise UserError for a cap above the model's limit, or one that the driver cannot hold."""
    for name in ("max_speed_mps", "max_steering_rad"):
        cap, limit = getattr(bounds, name), getattr(model, name)
        if limit < cap < math.inf:
            raise UserError(f"[vehicle] {name} {cap:g} is above the limit of {vehicle}: {limit:g}")
    if bounds.max_steering_rad < math.inf and not 0.0 < model.full_steering_rad < math.inf:
        words = f"[vehicle] max_steering_rad: the driver {vehicle} does not know its angle"
        raise UserError(f"{words}; leave it out, or set the driver's `model`")


def narrowed(limits: Limits, bounds: Bounds, model: Model) -> Limits:
    """Cut the steering's range to the operator's cap.

    The angle grows at least in proportion to the action: no action within exceeds the cap.
    """
    if STEERING not in limits or not bounds.max_steering_rad < model.full_steering_rad:
        return limits
    row, share = limits[STEERING], bounds.max_steering_rad / model.full_steering_rad
    return {**limits, STEERING: row._replace(low=row.low * share, high=row.high * share)}


class Leash:
    """The distance driven since the last re-arm, by the reported speeds; both directions count."""

    def __init__(self, length_m: float) -> None:
        self._length_m, self._gone_m = length_m, 0.0
        self._noted_s, self._speed_mps = math.inf, 0.0

    @property
    def left_m(self) -> float:
        return max(self._length_m - self._gone_m, 0.0)

    def begin(self) -> None:
        self._gone_m = 0.0

    def note(self, speed_mps: float, now_s: float) -> None:
        """Add the distance since the last report, at the faster of the two speeds."""
        if not math.isfinite(speed_mps):
            return  # a fault by itself; the next report covers this interval, too
        faster_mps = max(abs(speed_mps), self._speed_mps)
        self._gone_m += faster_mps * max(now_s - self._noted_s, 0.0)
        self._noted_s, self._speed_mps = now_s, abs(speed_mps)

    def is_used(self, ahead_s: float) -> bool:
        """Return whether the leash is used up, or will be within `ahead_s`."""
        return self.left_m <= self._speed_mps * ahead_s and self._length_m < math.inf
