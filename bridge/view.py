"""``python -m bridge view``: the wire in rerun, as a listener of its own or from a recording."""

from __future__ import annotations

import contextlib
import sys
import time
from itertools import chain
from pathlib import Path
from typing import Any

from bridge.arguments import add_connect, add_span, add_tls
from bridge.feed import Feed, Heard, open_feed
from bridge.messages import MESSAGES
from bridge.recording.reader import Recording
from bridge.signals import sigterm_as_interrupt, wait_to_be_told
from bridge.viewer.blueprint import APPLICATION, make_blueprint
from bridge.viewer.recorded import read_heard
from bridge.viewer.wire_log import WireLog
from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.tls import TlsFiles, tls_for
from edge_runtime.transport import check_endpoint
from edge_runtime.wire import DEFAULT_VEHICLE_ID
from viewing.options import add_sink, chosen_sink
from viewing.pace import PICTURE_INTERVAL_S
from viewing.sinks import SERVE, Sink, check_sink, open_sink
from viewing.viewer import flush

POLL_S = 0.1

EXAMPLE = examples(
    "python -m bridge view --serve",
    "python -m bridge view --save drive.rrd --wait-s 60",
    "python -m bridge view hil_tests/recordings/left_turn.mcap --save left_turn.rrd",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "recording",
        nargs="?",
        metavar="F.mcap",
        help="show what bridge record has written, instead of listening",
    )
    add_sink(parser)
    add_connect(parser)
    add_tls(parser)
    parser.add_argument(
        "--vehicle-id",
        metavar="ID",
        help=f"the vehicle to watch (default: {DEFAULT_VEHICLE_ID}; of a recording: the only one)",
    )
    add_span(parser)


def run(arguments: Any) -> int:
    """Run the command until the simulator goes, the time is over, or somebody interrupts."""
    if arguments.vehicle_id is not None:
        wire.check_vehicle_id(arguments.vehicle_id)
    sink = chosen_sink(arguments)
    if arguments.recording is not None:
        check_sink(sink)
        _show_recording(arguments, sink)
    else:
        tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
        check_sink(sink)
        dropped = _watch(arguments, sink, tls)
        if dropped:
            print(f"{dropped} messages came faster than they could be drawn", file=sys.stderr)
    if sink.path:
        print(f"wrote {sink.path}")
    return 0


def _show_recording(arguments: Any, sink: Sink) -> None:
    """Draw all of it; a page is served until somebody interrupts."""
    file = Recording(Path(arguments.recording))
    heard = read_heard(file, arguments.vehicle_id)
    first = next(heard, None)  # Says what is wrong with the file before anything is opened.
    with (
        sigterm_as_interrupt(),
        open_sink(sink, APPLICATION, make_blueprint(None)) as recording,
        contextlib.suppress(KeyboardInterrupt),
    ):
        log = WireLog(recording)
        for each in chain([first] if first else [], heard):
            _write(log, each)
        if file.trouble():
            text = f"the recording {file.trouble()}; what is whole of it is shown"
            print(text, file=sys.stderr, flush=True)
        if sink.kind == SERVE:
            flush(recording)
            print("all of it is there; ^C ends", flush=True)
            wait_to_be_told()


def _watch(arguments: Any, sink: Sink, tls: TlsFiles | None) -> int:
    """Draw until there is a reason to stop; return how many messages had to be dropped."""
    vehicle_id = arguments.vehicle_id or DEFAULT_VEHICLE_ID
    with (
        sigterm_as_interrupt(),
        open_feed(arguments.connect, vehicle_id, arguments.wait_s, tls) as feed,
        open_sink(sink, APPLICATION, make_blueprint(None)) as recording,
        # Being interrupted is the ordinary way to end a view: what was drawn is kept.
        contextlib.suppress(KeyboardInterrupt),
    ):
        log = WireLog(recording, PICTURE_INTERVAL_S if sink.is_live else 0.0)
        _show(feed, log, arguments.duration_s)
    return feed.dropped


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
    row = MESSAGES.get(heard.topic)
    if row is None:
        return  # A token: it shows as silence.
    message = row.decode(heard.payload)
    if message is None or isinstance(message, wire.Rejection):
        log.write_unreadable(heard.topic, message.detail if message else "not a scene")
    else:
        getattr(log, f"write_{heard.topic}")(message, heard.arrived_ns)
