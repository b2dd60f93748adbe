"""The settings of `run`: a TOML file, and the flags of the command line that win over it.

`config.example.toml` documents each key.
"""

from __future__ import annotations

import argparse
import contextlib
from typing import Any, Dict, List, Optional, Sequence, Tuple, Type

import msgspec

from edge_runtime import log
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint, check_fits
from edge_runtime.util import PathLike, UserError, read_toml
from edge_runtime.wire import DEFAULT_VEHICLE_ID, check_vehicle_id

NONE = "none"
VEHICLE_NAMES = (NONE, "mock", "hunter", "ros2")
DEFAULT_BUS = "socketcan:can0"
MAX_PRIORITY = 99  # of SCHED_FIFO


class HunterSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which chassis it is: a row of mapping.SPECS, and one of hunter/protocol.PROFILES."""

    model: str = "2.0"
    profile: str = "v2"


class CarSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The car of a scenario that is not this repository's; the fields of mapping.ScenarioCar."""

    throttle_mps2: float
    brake_mps2: float
    max_speed_mps: float
    full_steering_rad: float
    wheelbase_m: float


class SimilaritySettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`scale`: metres of the vehicle for one of the scenario; None: top speed is top speed."""

    scale: Optional[float] = None
    car: Optional[CarSettings] = None


class Ros2Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`config.example.toml` documents each key. A topic that is empty is not published."""

    model: str = "2.0"
    listen: Optional[str] = None
    connect: Optional[str] = None
    namespace: str = "/"
    twist_topic: str = "cmd_vel"
    twist_angular: str = "yaw_rate"
    ackermann_topic: str = ""
    odometry_topic: str = "odom"
    odometry_angular: str = "yaw_rate"


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings of `run`. Relative paths start at the working directory."""

    policy: Optional[str] = None
    connect: str = DEFAULT_ENDPOINT
    tls: Optional[str] = None
    vehicle_id: str = DEFAULT_VEHICLE_ID
    vehicle: str = NONE
    public_key: Optional[str] = None
    allow_unsigned: bool = False
    armed_at_start: bool = True
    hold: Optional[str] = None
    log_level: str = "info"
    log_format: str = "text"
    realtime_priority: int = 0
    cpus: List[int] = msgspec.field(default_factory=list)
    lock_memory: bool = False
    bus: str = DEFAULT_BUS
    hunter: HunterSettings = msgspec.field(default_factory=HunterSettings)
    similarity: SimilaritySettings = msgspec.field(default_factory=SimilaritySettings)
    ros2: Ros2Settings = msgspec.field(default_factory=Ros2Settings)


# The settings that are flags as well: metavar and help.
_FLAGS: Dict[str, Tuple[str, str]] = {
    "policy": ("POLICY.onnx", "the policy file"),
    "connect": ("PROTOCOL/HOST:PORT", "where the simulator listens"),
    "tls": ("DIR", "this party's ca.pem, cert.pem, key.pem (deploy certs); endpoint tls/..."),
    "vehicle_id": ("ID", "the vehicle's part of the Zenoh keys"),
    "vehicle": ("|".join(VEHICLE_NAMES), "the vehicle to move besides"),
    "bus": ("INTERFACE:CHANNEL", "with --vehicle hunter: its CAN bus, as python-can names it"),
    "log_level": ("|".join(log.LEVELS), "least level that goes to stderr"),
    "log_format": ("|".join(log.FORMATS), "a line of words, or a JSON object a line"),
}


def add_flags(parser: argparse.ArgumentParser, *names: str) -> None:
    """The flags of these settings, or of all. One that is not given is None: the file has it."""
    for name in names or _FLAGS:
        metavar, text = _FLAGS[name]
        default = getattr(Config(), name)
        shown = f"{text} (default: {default})" if default else text
        parser.add_argument(f"--{name.replace('_', '-')}", metavar=metavar, help=shown)


def add_trust(parser: argparse.ArgumentParser) -> None:
    """The flags that say which policy may drive."""
    from edge_runtime.cli import add_public_key  # Here: only a command line needs it.

    add_public_key(parser)
    text = "also take a policy whose origin cannot be verified"
    parser.add_argument("--allow-unsigned", action="store_true", default=None, help=text)


_TABLES: Dict[str, Type[msgspec.Struct]] = {
    "": Config,
    "hunter": HunterSettings,
    "similarity": SimilaritySettings,
    "similarity.car": CarSettings,
    "ros2": Ros2Settings,
}


def load_config(path: Optional[PathLike], flags: Dict[str, Any]) -> Config:
    """The file's settings with the given flags (those that are not None) in their place.

    Raises UserError for a file that is no TOML, an unknown key, and a value out of range; where
    the value stands in the file, the error names it.
    """
    given = {name: value for name, value in flags.items() if value is not None}
    from_file = Config()
    if path is not None:
        try:
            from_file = msgspec.convert(read_toml(path, "config file"), Config)
        except msgspec.ValidationError as error:
            raise UserError(f"config file {path}: {_explain(str(error))}") from None
    config = msgspec.structs.replace(from_file, **given)
    try:
        _check(config)
    except UserError as error:
        if path is None or _is_valid(from_file):
            raise  # the flag is wrong, not the file
        raise UserError(f"config file {path}: {error}") from None
    # `--bus` on the command line needs a vehicle; in the file it may be set while that is off.
    if "bus" in given and config.vehicle != "hunter":
        raise UserError(f"--bus needs --vehicle hunter; the vehicle is {config.vehicle}")
    return config


def _explain(text: str) -> str:
    """The sentence of msgspec with the key in front, and for an unknown key the known ones."""
    sentence, _, place = text.partition(" - at ")
    table = place.strip("`").replace("$.", "")
    if "unknown field" in text:
        sentence += f"; known are {', '.join(_TABLES[table].__struct_fields__)}"
    return f"{table}: {sentence}" if table else sentence


def _is_valid(config: Config) -> bool:
    with contextlib.suppress(UserError):
        _check(msgspec.structs.replace(config, policy=config.policy or "any"))
        return True
    return False


def _check(config: Config) -> None:
    if not config.policy:
        raise UserError("no policy to drive: name it with --policy, or as policy in --config")
    check_fits(check_endpoint(config.connect), config.tls is not None)
    check_vehicle_id(config.vehicle_id)
    check_choice("vehicle", config.vehicle, VEHICLE_NAMES)
    of_vehicles = ("bus", "hunter", "similarity", "ros2")
    if any(getattr(config, name) != getattr(Config(), name) for name in of_vehicles):
        from edge_runtime.vehicles import check_settings  # The defaults need no check.

        check_settings(config)
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
