"""The settings of `run`: a TOML file, and the flags of the command line that win over it.

`config.example.toml` documents each key.
"""

from __future__ import annotations

import argparse
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple, Type, TypeVar

import msgspec

from edge_runtime import log
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint, check_fits
from edge_runtime.util import PathLike, UserError, read_toml
from edge_runtime.wire import DEFAULT_VEHICLE_ID, check_vehicle_id

NONE = "none"
BUILT_IN = {
    "mock": "edge_runtime.vehicles.mock:MockVehicle",
    "hunter": "edge_runtime.vehicles.hunter:HunterVehicle",
    "ros2": "edge_runtime.vehicles.ros2:Ros2Vehicle",
}
"""The vehicles of this package, by name; those of others are entry points."""
MAX_PRIORITY = 99  # of SCHED_FIFO
_S = TypeVar("_S", bound=msgspec.Struct)


class RideThrough(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[ride_through]: for so long the last plan is played where nothing newer comes; 0: off."""

    max_s: float = 0.0


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings of `run`. Relative paths start at the working directory.

    `vehicle_settings` are the tables [vehicle.NAME], by name; what they hold is the driver's.
    """

    policy: Optional[str] = None
    connect: str = DEFAULT_ENDPOINT
    tls: Optional[str] = None
    vehicle_id: str = DEFAULT_VEHICLE_ID
    vehicle: str = NONE
    public_key: Optional[str] = None
    allow_unsigned: bool = False
    armed_at_start: bool = True
    hold: Optional[str] = None
    ride_through: RideThrough = RideThrough()
    log_level: str = "info"
    log_format: str = "text"
    realtime_priority: int = 0
    cpus: List[int] = msgspec.field(default_factory=list)
    lock_memory: bool = False
    vehicle_settings: Dict[str, Dict[str, Any]] = msgspec.field(default_factory=dict)


# The settings that are flags as well: metavar and help.
_FLAGS: Dict[str, Tuple[str, str]] = {
    "policy": ("POLICY.onnx", "the policy file"),
    "connect": ("PROTOCOL/HOST:PORT", "where the simulator listens"),
    "tls": ("DIR", "this party's ca.pem, cert.pem, key.pem (deploy certs); endpoint tls/..."),
    "vehicle_id": ("ID", "the vehicle's part of the Zenoh keys"),
    "vehicle": (f"{'|'.join((NONE, *BUILT_IN))}|NAME|MODULE:CLASS", "the vehicle to move, if any"),
    "bus": ("INTERFACE:CHANNEL", "with --vehicle hunter: its CAN bus, as python-can names it"),
    "log_level": ("|".join(log.LEVELS), "lowest level that is logged to stderr"),
    "log_format": ("|".join(log.FORMATS), "each event as a line of text, or as a JSON object"),
}


def add_flags(parser: argparse.ArgumentParser, *names: str) -> None:
    """The flags of these settings, or of all. One that is not given is None: the file has it."""
    for name in names or _FLAGS:
        metavar, text = _FLAGS[name]
        kind = "path" if name in ("policy", "tls") else str
        default = getattr(Config(), name, None)
        shown = f"{text} (default: {default})" if default else text
        parser.add_argument(f"--{name.replace('_', '-')}", metavar=metavar, type=kind, help=shown)


def add_trust(parser: argparse.ArgumentParser) -> None:
    """The flags that say which policy may drive."""
    from edge_runtime.cli import add_public_key  # Here: only a command line needs it.

    add_public_key(parser)
    text = "also take a policy whose origin cannot be verified"
    parser.add_argument("--allow-unsigned", action="store_true", default=None, help=text)


def load_config(path: Optional[PathLike], flags: Dict[str, Any], opens_link: bool = True) -> Config:
    """The file's settings with the given flags (those that are not None) in their place.

    Raises UserError for a file that is no TOML, an unknown key, and a value out of range; where
    one value of the file is wrong, the error names it. The vehicle's driver checks its own table.
    Where no link is opened, no flag could mend one that is incomplete.
    """
    given = {name: value for name, value in flags.items() if value is not None}
    from_file = Config()
    if path is not None:
        tables = read_toml(path, "config file")
        try:
            from_file = convert(_split_vehicle(tables), Config)
            _check(from_file)
        except UserError as error:
            raise UserError(f"config file {path}: {error}") from None
    bus = given.pop("bus", None)
    config = convert({**msgspec.structs.asdict(from_file), **given}, Config)
    _check(config)
    if not config.policy:
        raise UserError("no policy to drive: name it with --policy, or as policy in --config")
    if opens_link:
        check_fits(config.connect, config.tls is not None)
    if bus is None:
        return config
    if config.vehicle != "hunter":
        raise UserError(f"--bus needs --vehicle hunter; the vehicle is {config.vehicle}")
    tables = {**config.vehicle_settings}
    tables["hunter"] = {**tables.get("hunter", {}), "bus": bus}
    return msgspec.structs.replace(config, vehicle_settings=tables)


def _split_vehicle(tables: Dict[str, Any]) -> Dict[str, Any]:
    """`vehicle` is a driver, or a table: `driver`, and a table of settings for each vehicle."""
    given = tables.get("vehicle")
    if "vehicle_settings" in tables:
        raise UserError("vehicle_settings is no setting; write [vehicle.NAME]")
    if not isinstance(given, dict):
        return tables
    for name, table in given.items():
        if name != "driver" and not isinstance(table, dict):
            raise UserError(f"vehicle: {name} is no table, and not `driver`; write [vehicle.NAME]")
    driver = given.pop("driver", NONE)
    return {**tables, "vehicle": driver, "vehicle_settings": given}


def convert(settings: Mapping[str, Any], kind: Type[_S], table: str = "") -> _S:
    """A table's settings as a struct. Raises UserError that names the key, and the known ones."""
    try:
        return msgspec.convert(settings, kind)
    except msgspec.ValidationError as error:
        sentence, _, place = str(error).partition(" - at ")
        inner = place.strip("`").replace("$.", "").replace("$", "")
        if "unknown field" in sentence and not inner:
            sentence += f"; known are {', '.join(kind.__struct_fields__)}"
        where = ".".join(filter(None, (table, inner)))
        raise UserError(f"{where}: {sentence}" if where else sentence) from None


def _check(config: Config) -> None:
    check_endpoint(config.connect)
    check_vehicle_id(config.vehicle_id)
    check_choice("log_level", config.log_level, log.LEVELS)
    check_choice("log_format", config.log_format, log.FORMATS)
    priority = config.realtime_priority
    if not 0 <= priority <= MAX_PRIORITY:
        words = f"use 1 to {MAX_PRIORITY}, or 0 for none"
        raise UserError(f"realtime_priority {priority} is not valid: {words}")
    if any(cpu < 0 for cpu in config.cpus) or len(set(config.cpus)) < len(config.cpus):
        raise UserError(f"cpus {config.cpus} is not valid: list each processor once, like [2, 3]")


def check_choice(key: str, value: str, known: Sequence[str]) -> None:
    """Raise UserError for a value that is not known."""
    if value not in known:
        raise UserError(f"{key} {value!r} is not known; choose from {', '.join(known)}")
