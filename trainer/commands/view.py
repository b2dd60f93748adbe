"""Show recorded sittings in rerun: the road, both actions, who drove, and what the policy saw."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from bridge.rerun.sinks import add_sink, chosen_sink
from edge_runtime.cli import examples
from edge_runtime.util import counted
from trainer.person.recording import find_recordings, read_steps

EXAMPLE = examples(
    "python -m trainer view runs/drives --serve",
    "python -m trainer view runs/mine/sittings/sitting-0001.mcap --save sitting.rrd",
)
LOOK_S = 0.2
"""The kernel may hand a signal to any thread, which does not wake this one from a longer sleep."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "recordings",
        metavar="RECORDING",
        nargs="+",
        help="sitting-NNNN.mcap, a directory of such, or a run that a person guided",
    )
    add_sink(parser)


def run(arguments: argparse.Namespace) -> int:
    """Draw all of it; a page is served until somebody interrupts. Returns the exit status."""
    from bridge.rerun.sinks import SERVE, check_sink
    from trainer.viewer.command import show_sittings

    paths = find_recordings([Path(place) for place in arguments.recordings])
    sink = chosen_sink(arguments)
    check_sink(sink)
    for path in paths:  # Before a window opens, or a file takes another's place.
        next(read_steps(path), None)
    with show_sittings(paths, sink) as shown:
        road = f"; {shown.without_road} without their road" if shown.without_road else ""
        print(
            f"{counted(shown.episodes, 'episode')}, {counted(shown.steps, 'step')}, "
            f"{shown.human_steps} of them the person's{road}",
            flush=True,
        )
        try:
            while sink.kind == SERVE:
                time.sleep(LOOK_S)
        except KeyboardInterrupt:
            pass
    return 0
