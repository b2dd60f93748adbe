"""``python -m bridge record``: a listener of its own that writes the wire to an MCAP file."""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import Any

from bridge.arguments import add_connect, add_span, add_tls
from bridge.feed import ANY_VEHICLE, QUEUE_MESSAGES, Feed, open_feed
from bridge.recording.flushed_file import check_new
from bridge.recording.writer import RecordingWriter
from bridge.signals import sigterm_as_interrupt
from edge_runtime.cli import ArgumentParser, examples, seconds
from edge_runtime.tls import tls_for
from edge_runtime.transport import check_endpoint
from edge_runtime.util import counted
from edge_runtime.wire import check_vehicle_id

POLL_S = 0.1
FLUSH_S = 0.5
"""A kill loses at most this much, and what waits in the queue."""
NOT_WRITTEN = 1
"""Exit status where the disk did not take the recording to its end."""

EXAMPLE = examples(
    "python -m bridge record --out drive.mcap",
    "python -m bridge record --out car-a.mcap --vehicle-id car-a --wait-s 60 --duration-s 300",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--out", metavar="F.mcap", required=True, help="the recording; it must not exist yet"
    )
    add_connect(parser)
    add_tls(parser)
    parser.add_argument(
        "--vehicle-id", metavar="ID", help="record this vehicle only (otherwise all)"
    )
    add_span(parser)
    parser.add_argument(
        "--linger-s",
        metavar="SECONDS",
        type=seconds,
        default=2.0,
        help="how long to go on without any simulator: it may come back, in seconds",
    )


def run(arguments: Any) -> int:
    """Run the command until the simulators go, the time is over, or somebody interrupts."""
    tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
    vehicle_id = arguments.vehicle_id
    vehicle_id = ANY_VEHICLE if vehicle_id is None else check_vehicle_id(vehicle_id)
    path = Path(arguments.out)
    check_new(path)
    with (
        sigterm_as_interrupt(),
        open_feed(arguments.connect, vehicle_id, arguments.wait_s, tls) as feed,
    ):
        writer = RecordingWriter(path)
        try:
            print(f"recording {path}", flush=True)
            # Being interrupted is the ordinary way to end a recording.
            with contextlib.suppress(KeyboardInterrupt):
                _listen(feed, writer, arguments)
            writer.finish(feed.dropped)
        except OSError as error:
            print(
                f"error: recording {path} stopped: {error.strerror}; it holds what was written"
                f" before: python -m bridge repair {path}",
                file=sys.stderr,
            )
            return NOT_WRITTEN
        finally:
            writer.close()
    if feed.dropped:
        dropped = counted(feed.dropped, "message")
        print(f"{dropped} came faster than they could be written", file=sys.stderr)
    print(f"wrote {path}: {counted(writer.messages, 'message')}")
    return 0


def _listen(feed: Feed, writer: RecordingWriter, arguments: Any) -> None:
    now_s = time.monotonic()
    end_s = None if arguments.duration_s is None else now_s + arguments.duration_s
    flush_s, seen_s = now_s + FLUSH_S, now_s
    while end_s is None or now_s < end_s:
        heard = feed.next(POLL_S)
        if heard is not None:
            # Under a flood the copies for viewers are the first to go.
            writer.write(heard, with_view=feed.waiting < QUEUE_MESSAGES // 2)
        now_s = time.monotonic()
        if now_s >= flush_s:
            writer.flush()
            flush_s = now_s + FLUSH_S
        if not feed.simulator_gone.is_set():
            seen_s = now_s
        # An edge runtime behind a router goes on sending health: that is no drive to wait for.
        elif now_s - seen_s >= arguments.linger_s and not feed.waiting:
            return
