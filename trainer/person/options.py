"""The person's options of ``drive`` and ``train``."""

from __future__ import annotations

import argparse
from pathlib import Path

from edge_runtime.cli import positive_number, whole_number
from edge_runtime.util import UserError
from trainer.person.registry import PersonOptions

PERSON = "person"
"""``RunConfig.human`` of every device: a run may go on with another one."""
DEFAULTS = PersonOptions()


def add_person(parser: argparse.ArgumentParser) -> None:
    """Declare them."""
    group = parser.add_argument_group("a person at the wheel (--human keyboard and so on)")
    group.add_argument(
        "--profile",
        metavar="F.toml",
        help="what the axes and buttons of --human gamepad or wheel mean (default: as shipped)",
    )
    group.add_argument(
        "--host", default=DEFAULTS.host, help="where --human web listens: this machine only"
    )
    group.add_argument(
        "--port",
        type=whole_number(0, 65535),
        default=DEFAULTS.port,
        help="of --human web; 0: any that is free",
    )
    group.add_argument(
        "--speed",
        type=positive_number,
        default=1.0,
        metavar="X",
        help="simulated seconds in one of yours: 0.5 is slow motion",
    )


def person_options(arguments: argparse.Namespace) -> PersonOptions:
    """What the command line says about the device.

    Raises:
        UserError: an option that the device has no use for.
    """
    _refuse(arguments, "profile", arguments.human in ("gamepad", "wheel"))
    _refuse(arguments, "host", arguments.human == "web")
    _refuse(arguments, "port", arguments.human == "web")
    profile = None if arguments.profile is None else Path(arguments.profile)
    return PersonOptions(arguments.scenario, profile, arguments.host, arguments.port)


def check_no_person(arguments: argparse.Namespace) -> None:
    """Refuse a person's options where there is none; raises UserError."""
    for name in ("profile", "host", "port", "speed"):
        _refuse(arguments, name, False)


def _refuse(arguments: argparse.Namespace, name: str, useful: bool) -> None:
    given = getattr(arguments, name) != {"speed": 1.0}.get(name, getattr(DEFAULTS, name, None))
    if given and not useful:
        raise UserError(f"--{name} means nothing with --human {arguments.human}")
