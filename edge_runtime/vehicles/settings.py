"""The settings of vehicles in the TOML file: `[hunter]` and `[similarity]`."""

from __future__ import annotations

from typing import Optional

import msgspec


class HunterSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which chassis it is: a row of hunter/specs.py, and one of hunter/faults.py."""

    model: str = "2.0"
    profile: str = "v2"


class CarSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The car of a scenario that is not this repository's; the fields of similarity.ScenarioCar."""

    throttle_mps2: float
    brake_mps2: float
    max_speed_mps: float
    full_steering_rad: float
    wheelbase_m: float


class SimilaritySettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`scale`: metres of the vehicle for one of the scenario; None: top speed is top speed."""

    scale: Optional[float] = None
    car: Optional[CarSettings] = None
