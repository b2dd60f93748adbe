"""The settings of `run`: a TOML file, and the flags of the command line that win over it.

`config.example.toml` documents each key.
"""

from __future__ import annotations

import argparse
import math
from typing import Any, Dict, Mapping, Optional, Sequence, Tuple, Type, TypeVar

import msgspec

from edge_runtime import log
from edge_runtime.bounds import Bounds
from edge_runtime.cli import add_public_key
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint, check_fits
from edge_runtime.util import PathLike, UserError, read_toml
from edge_runtime.wire import DEFAULT_VEHICLE_ID, check_vehicle_id

NONE = "none"
EACH_EPISODE, ONCE = REARM = "each_episode", "once"
_RULES = ("max_speed_mps", "max_steering_rad", "leash_m", "rearm")  # of [vehicle], for any driver
BUILT_IN = {
    "mock": "edge_runtime.vehicles.mock:MockVehicle",
    "hunter": "edge_runtime.vehicles.hunter:HunterVehicle",
    "ros2": "edge_runtime.vehicles.ros2:Ros2Vehicle",
}
"""The vehicles of this package, by name; those of others are entry points."""
_S = TypeVar("_S", bound=msgspec.Struct)


class RideThrough(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[ride_through]: how long the last plan is followed while no newer command comes; 0: off."""

    max_s: float = 0.0


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings of `run`. Relative paths start at the working directory.

    The last five come from [vehicle]: bounds (None: no limit), which episodes need a re-arm, and
    the tables [vehicle.NAME] by name, which each driver checks.
    """

    policy: Optional[str] = None
    connect: str = DEFAULT_ENDPOINT
    tls: Optional[str] = None
    vehicle_id: str = DEFAULT_VEHICLE_ID
    vehicle: str = NONE
    public_key: Optional[str] = None
    allow_unsigned: bool = False
    armed_at_start: bool = True
    ride_through: RideThrough = RideThrough()
    log_level: str = "info"
    max_speed_mps: Optional[float] = None
    max_steering_rad: Optional[float] = None
    leash_m: Optional[float] = None
    rearm: str = EACH_EPISODE
    vehicle_settings: Dict[str, Dict[str, Any]] = msgspec.field(default_factory=dict)

    @property
    def is_armed_at_start(self) -> bool:
        """Whether a vehicle may drive at once: never with a leash, which only a re-arm renews."""
        return self.armed_at_start and self.leash_m is None

    @property
    def bounds(self) -> Bounds:
        settings = {name: getattr(self, name) for name in Bounds._fields}
        return Bounds(**{name: value for name, value in settings.items() if value is not None})


# The settings that are flags as well: metavar and help.
_FLAGS: Dict[str, Tuple[str, str]] = {
    "policy": ("POLICY.onnx", "policy file to drive; its signature is POLICY.onnx.sig beside it"),
    "connect": ("PROTOCOL/HOST:PORT", "simulator or router, for example tcp/10.0.0.2:7447"),
    "tls": ("DIR", "this party's certificate, from `deploy certs`; needs --connect tls/HOST:PORT"),
    "vehicle_id": ("ID", "id of the vehicle; simulator, runtime and operator must use the same"),
    "vehicle": (
        "NAME",
        f"vehicle to move: {', '.join((NONE, *BUILT_IN))}, an installed driver, or your own as"
        " MODULE:CLASS; with none the runtime only answers the simulator",
    ),
    "bus": ("INTERFACE:CHANNEL", "CAN bus of --vehicle hunter, such as socketcan:can0"),
    "log_level": ("LEVEL", f"log events of this level or above: {', '.join(log.LEVELS)}"),
}


def add_flags(parser: Any, *names: str) -> None:
    """Add the flags of these settings to a parser or group; a flag that is not given is None."""
    for name in names:
        metavar, text = _FLAGS[name]
        kind = "path" if name in ("policy", "tls") else str
        default = getattr(Config(), name, None)
        shown = f"{text} (default: {default})" if default else text
        parser.add_argument(f"--{name.replace('_', '-')}", metavar=metavar, type=kind, help=shown)


def add_trust(parser: Any) -> None:
    add_public_key(parser, "; with --allow-unsigned, policy.pub in the policy's folder comes first")
    text = "drive a policy without a signature or a known key; a wrong signature is still refused"
    parser.add_argument("--allow-unsigned", action="store_true", default=None, help=text)


def add_run_flags(parser: argparse.ArgumentParser) -> None:
    policy = parser.add_argument_group("policy")
    add_flags(policy, "policy")
    add_trust(policy)
    add_flags(parser.add_argument_group("simulator"), "connect", "tls", "vehicle_id")
    add_flags(parser.add_argument_group("vehicle"), "vehicle", "bus")
    more = parser.add_argument_group("settings and log")
    text = "settings file (edge_runtime/config.example.toml explains it); options override it"
    more.add_argument("--config", metavar="FILE.toml", help=text)
    add_flags(more, "log_level")


def load_config(path: Optional[PathLike], flags: Dict[str, Any], opens_link: bool = True) -> Config:
    """Load a settings file; flags that are not None override it. Raises UserError.

    With `opens_link` False nothing is connected, so `tls` need not go with `connect`.
    """
    overrides = {name: value for name, value in flags.items() if value is not None}
    bus = overrides.pop("bus", None)
    settings: Dict[str, Any] = {}
    if path is not None:
        tables = read_toml(path, "config file")
        try:
            settings = _split_vehicle(tables)
            _check(convert(settings, Config))
        except UserError as error:
            raise UserError(f"config file {path}: {error}") from None
    config = _check(convert({**settings, **overrides}, Config))
    if not config.policy:
        raise UserError("no policy to drive: name it with --policy, or as policy in --config")
    if opens_link:
        check_fits(config.connect, config.tls is not None)
    if bus is not None:
        if config.vehicle != "hunter":
            raise UserError(f"--bus needs --vehicle hunter; the vehicle is {config.vehicle}")
        config.vehicle_settings.setdefault("hunter", {})["bus"] = bus
    return config


def _split_vehicle(tables: Dict[str, Any]) -> Dict[str, Any]:
    """Flatten the table [vehicle] into a driver, rules, and the settings of each driver."""
    if not isinstance(tables.get("vehicle"), dict):
        return tables
    settings = dict(tables["vehicle"])
    driver = settings.pop("driver", NONE)
    rules = {name: settings.pop(name) for name in _RULES if name in settings}
    for name in (name for name, value in settings.items() if not isinstance(value, dict)):
        known = f"driver, {', '.join(_RULES)} and a table for each driver"
        raise UserError(f"vehicle.{name} is no setting; [vehicle] has {known}")
    return {**tables, **rules, "vehicle": driver, "vehicle_settings": settings}


def convert(settings: Mapping[str, Any], kind: Type[_S], table: str = "") -> _S:
    """Convert a table to a struct. Raises UserError that names the key."""
    try:
        return msgspec.convert(settings, kind)
    except msgspec.ValidationError as error:
        raise UserError(str(error).replace("`$", f"`{table}").replace("`.", "`")) from None


def _check(config: Config) -> Config:
    check_endpoint(config.connect)
    check_vehicle_id(config.vehicle_id)
    check_choice("log_level", config.log_level, log.LEVELS)
    check_choice("vehicle.rearm", config.rearm, REARM)
    for name, value in config.bounds._asdict().items():
        if getattr(config, name) is not None and not 0.0 < value < math.inf:
            raise UserError(f"vehicle.{name} {value:g} is not valid: it must be finite, above 0")
    return config


def check_choice(key: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise UserError(f"{key} {value!r} is not known; choose from {', '.join(known)}")
