"""Where what is shown goes, as options of a command. rerun is loaded when the sink is asked for."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from edge_runtime.util import UserError

if TYPE_CHECKING:
    from viewing.sinks import Sink


def add_sink(parser: argparse.ArgumentParser) -> None:
    """``--spawn``, ``--serve`` or ``--save F.rrd``."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--spawn", action="store_true", help="open a rerun window (the default)")
    where.add_argument(
        "--serve", action="store_true", help="serve a web page on this machine's loopback only"
    )
    where.add_argument("--save", metavar="F.rrd", help="write a recording instead of showing it")


def chosen_sink(arguments: argparse.Namespace) -> Sink:
    """The one of `add_sink` that was chosen. UserError: a file that rerun would not open."""
    from viewing.sinks import SERVE, SPAWN, SUFFIX, Sink

    if arguments.save is None:
        return Sink(SERVE if arguments.serve else SPAWN)
    if not arguments.save.endswith(SUFFIX):
        raise UserError(f"--save {arguments.save}: rerun opens only what is called F{SUFFIX}")
    return Sink("save", arguments.save)
