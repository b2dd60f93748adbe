"""The settings of `run`: a TOML file, and the flags of the command line that win over it.

`config.example.toml` documents each key.
"""

from __future__ import annotations

from typing import Any, Dict, Optional

import msgspec

from edge_runtime import log
from edge_runtime.errors import UserError
from edge_runtime.files import PathLike, read_bytes
from edge_runtime.tls import check_fits
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint
from edge_runtime.vehicles.registry import NONE, VEHICLE_NAMES
from edge_runtime.wire import check_vehicle_id


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings of `run`. Relative paths start at the working directory."""

    policy: Optional[str] = None
    connect: str = DEFAULT_ENDPOINT
    tls: Optional[str] = None
    vehicle_id: str = "hunter01"
    vehicle: str = NONE
    public_key: Optional[str] = None
    allow_unsigned: bool = False
    log_level: str = "info"


def load_config(path: Optional[PathLike], flags: Dict[str, Any]) -> Config:
    """The file's settings with the given flags (those that are not None) in their place.

    Raises UserError for a file that is no TOML, an unknown key, and a value out of range.
    """
    config = Config() if path is None else _read(path)
    given = {name: value for name, value in flags.items() if value is not None}
    config = msgspec.structs.replace(config, **given)
    _check(config)
    return config


def _read(path: PathLike) -> Config:
    data = read_bytes(path, "config file")
    try:
        return msgspec.toml.decode(data, type=Config)
    except (msgspec.MsgspecError, ValueError) as error:
        raise UserError(f"config file {path}: {error}") from None


def _check(config: Config) -> None:
    if not config.policy:
        raise UserError("no policy to drive: name it with --policy, or as policy in --config")
    check_fits(check_endpoint(config.connect), config.tls is not None)
    check_vehicle_id(config.vehicle_id)
    if config.vehicle not in VEHICLE_NAMES:
        raise UserError(
            f"vehicle {config.vehicle!r} is not known; choose from {', '.join(VEHICLE_NAMES)}"
        )
    if config.log_level not in log.LEVELS:
        raise UserError(
            f"log_level {config.log_level!r} is not known; choose from {', '.join(log.LEVELS)}"
        )
