"""What a mock Hunter is made of: one row for each model, and where each number comes from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from edge_runtime.util import UserError

ASSUMED = "assumed"
_MANUAL = "AgileX user manual (HARDWARE_FACTS.md)"


@dataclass(frozen=True)
class Parameters:
    """Geometry, actuators and battery of one model; SOURCES says how far to trust each number."""

    max_speed_mps: float
    max_inner_rad: float
    """Of the inner front wheel."""
    wheelbase_m: float
    track_m: float
    command_timeout_s: float = 0.5
    dead_time_s: float = 0.03
    """From a command on the bus to the first movement of an actuator."""
    speed_time_constant_s: float = 0.1
    acceleration_mps2: float = 2.0
    braking_mps2: float = 3.0
    """Of the speed controller, and of the brake: the chassis stops a moving car with either."""
    steering_rate_radps: float = 1.0
    """Of the inner wheel."""
    motor_revolutions_per_m: float = 20.0
    """Of path of a rear wheel."""
    steer_revolutions_per_rad: float = 20.0
    """Of the steering motor, for each radian of the inner wheel."""
    pulses_per_revolution: float = 100.0
    """Of a motor's encoder."""
    full_v: float = 28.0
    empty_v: float = 21.0
    undervoltage_v: float = 22.0
    capacity_as: float = 30 * 3600.0
    resistance_ohm: float = 0.02
    idle_a: float = 2.0
    drive_a_per_mps: float = 4.0
    drive_a_per_mps2: float = 10.0


MODELS: dict[str, Parameters] = {
    "hunter-2.0": Parameters(
        max_speed_mps=1.5, max_inner_rad=0.576, wheelbase_m=0.650, track_m=0.605
    ),
    # The SE's manual leaves its track between 0.46 and 0.52 m: the middle is assumed.
    "hunter-se": Parameters(
        max_speed_mps=4.8, max_inner_rad=0.400, wheelbase_m=0.55, track_m=0.49,
        acceleration_mps2=3.0, braking_mps2=4.0,
    ),
}  # fmt: skip

_FROM_THE_MANUAL = (
    "max_speed_mps", "max_inner_rad", "wheelbase_m", "track_m", "command_timeout_s",
)  # fmt: skip
SOURCES: dict[str, str] = {
    field.name: _MANUAL if field.name in _FROM_THE_MANUAL else ASSUMED
    for field in fields(Parameters)
}
"""The manual says nothing of how fast the actuators are: measure them on the vehicle, and pass
them with ``--set``."""


def make_parameters(model: str, changes: Mapping[str, float] | None = None) -> Parameters:
    """A model's row with some numbers replaced.

    Raises:
        UserError: an unknown model or name, or a number that is not positive (a dead time may
            be 0).
    """
    if model not in MODELS:
        raise UserError(f"no model {model!r}; choose from {', '.join(MODELS)}")
    for name, value in (changes or {}).items():
        if name not in SOURCES:
            raise UserError(f"no parameter {name!r}; choose from {', '.join(SOURCES)}")
        if not (value > 0.0 or (name == "dead_time_s" and value == 0.0)) or value == float("inf"):
            raise UserError(f"parameter {name} must be above 0, not {value}")
    return replace(MODELS[model], **(changes or {}))


def read_changes(texts: list[str]) -> dict[str, float]:
    """Read the values of `--set NAME=VALUE`; UserError for one that is none."""
    changes = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            changes[name] = float(value)
        except ValueError:
            raise UserError(f"--set {text!r} is not valid: use NAME=VALUE") from None
    return changes
