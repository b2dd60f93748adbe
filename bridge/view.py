"""``python -m bridge view``: a listener of its own that shows the wire in rerun."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import rerun as rr

from bridge.arguments import add_connect, add_span, add_tls, add_vehicle_id
from bridge.feed import Feed, Heard, open_feed
from bridge.scene import decode_scene
from bridge.signals import sigterm_as_interrupt
from bridge.viewer import sinks
from bridge.viewer.wire_log import WireLog
from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.files import check_writable
from edge_runtime.tls import TlsFiles, tls_for
from edge_runtime.transport import check_endpoint

POLL_S = 0.1

DECODERS: dict[str, Callable[[bytes], Any]] = {
    "state": wire.decode_state,
    "command": wire.decode_command,
    "feedback": wire.decode_feedback,
    "health": wire.decode_health,
    "scene": decode_scene,
}

EXAMPLE = examples(
    "python -m bridge view --serve",
    "python -m bridge view --save drive.rrd --wait-s 60",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--spawn", action="store_true", help="open a rerun window (the default)")
    where.add_argument(
        "--serve", action="store_true", help="serve a web page on this machine's loopback only"
    )
    where.add_argument("--save", metavar="F.rrd", help="write a recording instead of showing it")
    add_connect(parser)
    add_tls(parser)
    add_vehicle_id(parser, "the vehicle to watch")
    add_span(parser)


def view(arguments: Any) -> int:
    """Run the command until the simulator goes, the time is over, or somebody interrupts."""
    wire.check_vehicle_id(arguments.vehicle_id)
    tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
    _check_sink(arguments)
    dropped = _watch(arguments, tls)
    if dropped:
        print(f"{dropped} messages came faster than they could be drawn", file=sys.stderr)
    if arguments.save is not None:
        print(f"wrote {arguments.save}")
    return 0


def _watch(arguments: Any, tls: TlsFiles | None) -> int:
    """Draw until there is a reason to stop; return how many messages had to be dropped."""
    with (
        sigterm_as_interrupt(),
        open_feed(arguments.connect, arguments.vehicle_id, arguments.wait_s, tls) as feed,
        _sink(arguments) as recording,
        # Being interrupted is the ordinary way to end a view: what was drawn is kept.
        contextlib.suppress(KeyboardInterrupt),
    ):
        _show(feed, WireLog(recording), arguments.duration_s)
    return feed.dropped


def _check_sink(arguments: Any) -> None:
    """Say at once, not after waiting for the simulator, that nothing could be shown."""
    if arguments.save is not None:
        check_writable(arguments.save)
    elif arguments.serve:
        sinks.check_ports()
    else:
        sinks.check_display()


def _sink(arguments: Any) -> AbstractContextManager[rr.RecordingStream]:
    if arguments.save is not None:
        return sinks.save_to(arguments.save)
    return sinks.serve_page() if arguments.serve else sinks.spawn_window()


def _show(feed: Feed, log: WireLog, duration_s: float | None) -> None:
    """Draw messages until the simulator has gone and the queue is empty, or the time is over."""
    end_s = None if duration_s is None else time.monotonic() + duration_s
    while end_s is None or time.monotonic() < end_s:
        heard = feed.next(POLL_S)
        if heard is not None:
            _write(log, heard)
        elif feed.simulator_gone.is_set():
            return


def _write(log: WireLog, heard: Heard) -> None:
    decode = DECODERS.get(heard.topic)
    if decode is None:
        return  # A token: it shows as silence.
    message = decode(heard.payload)
    if message is None or isinstance(message, wire.Rejection):
        log.write_unreadable(heard.topic, message.detail if message else "not a scene")
    else:
        getattr(log, f"write_{heard.topic}")(message, heard.arrived_ns)
