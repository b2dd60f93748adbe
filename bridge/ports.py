"""The bridge's ends on Zenoh, options that commands share, `bridge router`, `record`, `view`.

A listener that falls behind loses messages and never holds up the vehicle.
"""

from __future__ import annotations

import contextlib
import math
import queue
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import zenoh

from bridge.environments import picture_of, say_once, scene_of
from bridge.messages import DECODERS, SHADOW, TOKEN_TOPICS, Heard, Scene, encode_scene
from bridge.network import SHORT_GRAMMAR, parse_spec
from bridge.recording import Recording, RecordingWriter, choose_vehicle, heard_of, new_recording
from bridge.rerun import FOXGLOVE_PORT, SERVE, SPAWN
from edge_runtime import cli, transport
from edge_runtime import tls as access
from edge_runtime.files import check_writable
from edge_runtime.manifest import Manifest
from edge_runtime.sense import add_arguments as add_source
from edge_runtime.tls import TlsFiles
from edge_runtime.util import UserError, counted
from edge_runtime.wire import DEFAULT_VEHICLE_ID, MAX_STATE_BYTES, Health, check_vehicle_id, key

ANY_VEHICLE = "*"
POLL_S = 0.1  # How soon a listener notices that the simulator has gone
NOT_WRITTEN = 1  # Exit status if the disk was full before the recording's end
LINGER_S = 2.0  # A simulator that stalls for longer than Zenoh's lease, 1 s, comes back
TOKEN_S = 1.0  # Least time for a simulator's token to arrive, however short a wait was given
QUEUE_MESSAGES = 2000  # About a minute of real time, all topics together
QUERY_S = 1.0


def scene_payload(environment: Any, stamps: Scene) -> bytes:
    """Encode the scene, or else the environment's picture, if it can be drawn."""
    try:
        if (scene := scene_of(environment)) is not None:
            return encode_scene(scene, stamps)
        stamps = msgspec.structs.replace(stamps, picture=picture_of(environment))
    except Exception as error:  # Foreign code; the drive goes on
        say_once(f"the environment cannot be shown: {type(error).__name__}")
    return encode_scene({}, stamps)


class EdgeStatus(Health, frozen=True, kw_only=True):
    """The edge runtime's answer to the status query."""

    manifest: Manifest

    def rejected_since(self, before: EdgeStatus) -> Counter[str]:
        """Return the states rejected in between, by reason; a restarted runtime began at zero."""
        is_same = self.policy_id == before.policy_id and self.uptime_s >= before.uptime_s
        return Counter(self.rejected) - Counter(before.rejected if is_same else {})


class SimulatorPort(transport.SimulatorEnd):
    """A simulator's end that also publishes scenes and queries the edge runtime."""

    def publish_scene(self, environment: Any, stamps: Scene) -> None:
        """Send the scene, or else the environment's picture, if anybody is listening."""
        listeners: Any = self.scenes.matching_status
        if listeners.matching:
            self.scenes.put(scene_payload(environment, stamps))

    def wait_for_edge(self, limit_s: float, start: str) -> EdgeStatus:
        """Wait for an edge runtime; UserError that names what to ``start``, after ``limit_s``."""
        give_up_s = time.monotonic() + limit_s
        while (status := self.edge_status()) is None:
            if time.monotonic() >= give_up_s:
                raise UserError(f"no edge runtime after {limit_s:g} s; start one: {start}")
            time.sleep(transport.RETRY_S)
        return status

    def edge_status(self) -> EdgeStatus | None:
        """Query the edge runtime's status; None without a readable answer."""
        for reply in self._zenoh.get(key(self.vehicle_id, "status"), timeout=QUERY_S):
            with contextlib.suppress(msgspec.MsgspecError, ValueError, RecursionError):
                if reply.ok is not None:
                    return msgspec.json.decode(reply.ok.payload.to_bytes(), type=EdgeStatus)
        return None


open_port = partial(transport.open_simulator, SimulatorPort)


class WireListener:
    """Queues messages in order of arrival, and keeps track of the simulators' tokens."""

    def __init__(self) -> None:
        self.simulator_seen = threading.Event()
        self.dropped = 0
        self.end_s = math.inf  # Unix time at which its certificate ends
        self.queue: queue.Queue[Heard] = queue.Queue(QUEUE_MESSAGES)
        self.stopped = threading.Event()
        """Ends `until_gone` after its next message; may be set in a signal's handler."""
        self._simulators: set[str] = set()
        self._zero_ns = time.time_ns() - time.monotonic_ns()

    def next(self, timeout_s: float) -> Heard | None:
        with contextlib.suppress(queue.Empty):
            return self.queue.get(timeout=timeout_s)
        return None

    def until_gone(self, linger_s: float = LINGER_S) -> Iterator[Heard | None]:
        """Yield messages, and None while none comes, until no simulator was there for ``linger_s``.

        Silence is no end: an edge runtime behind a router goes on sending without a simulator.
        """
        seen_s = time.monotonic()
        while time.time() < self.end_s and not self.stopped.is_set():
            yield self.next(POLL_S)
            now_s = time.monotonic()
            if self._simulators:
                seen_s = now_s
            elif now_s - seen_s >= linger_s and self.queue.empty():
                return

    def hear(self, sample: zenoh.Sample) -> None:
        """Queue a message; of an oversized one only the size, to bound the memory."""
        size = len(sample.payload)
        self._put(sample, sample.payload.to_bytes() if size <= MAX_STATE_BYTES else b"", size)

    def watch(self, sample: zenoh.Sample) -> None:
        key, here = str(sample.key_expr), sample.kind != zenoh.SampleKind.DELETE
        if key.endswith("/simulator") and "*" not in key:
            if here:
                self._simulators.add(key)
                self.simulator_seen.set()
            else:
                self._simulators.discard(key)
        self._put(sample, bytes([here]), size=1)

    def _put(self, sample: zenoh.Sample, payload: bytes, size: int) -> None:
        key = str(sample.key_expr)
        if "*" in key:
            return  # It was put to a wildcard of many vehicles
        topic, arrived_ns = key.rpartition("/")[2], self._zero_ns + time.monotonic_ns()
        try:
            self.queue.put_nowait(Heard(key, topic, payload, arrived_ns, size))
        except queue.Full:
            self.dropped += 1


@contextlib.contextmanager
def open_listener(
    connect: str, vehicle_id: str, wait_s: float = 0.0, tls: TlsFiles | None = None
) -> Iterator[WireListener]:
    """Listen to one vehicle, or to ANY_VEHICLE.

    UserError if no simulator of it is at ``connect`` within ``wait_s``, or without the right.
    """
    if tls is not None:
        own = [access.common_name(access.SHADOW, vehicle_id)] if vehicle_id != ANY_VEHICLE else []
        access.check_name(tls.name, access.VIEWER, *own)
    give_up_s = time.monotonic() + wait_s
    with contextlib.ExitStack() as stack:
        session = stack.enter_context(closing(transport.connect_client(connect, wait_s, tls)))
        listener, keys = WireListener(), f"phil/{vehicle_id}"
        if tls is not None:
            listener.end_s = tls.expires.timestamp()
        # On Zenoh's own thread: one thread for each topic would lose the messages' order.
        hear = zenoh.handlers.Callback(listener.hear, indirect=False)
        for topic in DECODERS.keys() - {SHADOW}:
            stack.enter_context(session.declare_subscriber(f"{keys}/{topic}", hear))
        declare = session.liveliness().declare_subscriber
        for topic in TOKEN_TOPICS:
            stack.enter_context(declare(f"{keys}/{topic}", listener.watch, history=True))
        # Without a first token, the listener would never see a simulator go.
        if not listener.simulator_seen.wait(max(TOKEN_S, give_up_s - time.monotonic())):
            where = f"vehicle {vehicle_id} at {connect}"
            raise UserError(f"no simulator of {where}; start one, or name another --vehicle-id")
        yield listener
        if tls is not None:
            tls.require_valid(time.time())


@contextlib.contextmanager
def open_source(arguments: Any) -> Iterator[Iterator[Heard | None]]:
    """Yield one vehicle's messages: from the file ``arguments.recording``, or from the wire until
    its simulator goes; None while none comes.
    """
    if arguments.recording:
        recording = Recording(Path(arguments.recording))
        yield heard_of(recording, choose_vehicle(recording, arguments.vehicle_id))
        recording.say_trouble()
        return
    where, vehicle_id = arguments.connect, arguments.vehicle_id or DEFAULT_VEHICLE_ID
    tls = transport.tls_for(arguments.tls, where)
    with open_listener(where, vehicle_id, arguments.wait_s, tls) as listener:
        yield listener.until_gone()
        _say_dropped(listener)


def _say_dropped(listener: WireListener) -> None:
    if listener.dropped:
        dropped = counted(listener.dropped, "message")
        print(f"dropped {dropped}: they came too fast", file=sys.stderr)


ENDPOINT = {"metavar": "PROTOCOL/HOST:PORT", "type": transport.check_endpoint}
_SECONDS = {"metavar": "SECONDS", "type": cli.seconds}
_ID = {"metavar": "ID", "type": check_vehicle_id, "default": DEFAULT_VEHICLE_ID}
_TLS = "folder of this party's certificate, from `deploy certs`; turns TLS on (tls/HOST:PORT)"
_NETWORK = "simulated network, for example " + SHORT_GRAMMAR.replace("%", "%%")
OPTIONS: dict[str, dict[str, Any]] = {
    "--listen": {**ENDPOINT, "help": "endpoint on which edge runtimes and viewers connect"},
    "--connect": {
        **ENDPOINT,
        "default": transport.DEFAULT_ENDPOINT,
        "help": "endpoint of the simulator or router",
    },
    "--tls": {"metavar": "DIR", "type": "path", "help": _TLS},
    "--vehicle-id": {**_ID, "help": "id of the vehicle"},
    "--wait-s": {**_SECONDS, "default": 10.0, "help": "seconds to wait for a simulator"},
    "--wait-edge-s": {**_SECONDS, "default": 30.0, "help": "seconds to wait for an edge runtime"},
    "--latency": {"metavar": "SPEC", "type": parse_spec, "default": "none", "help": _NETWORK},
    "--seed": {"metavar": "N", "type": cli.not_negative, "default": 0, "help": "random seed"},
    "--out": {"metavar": "R.json", "type": check_writable, "help": "write the report to this file"},
}
"""Options of several commands; their types raise UserError for a bad value."""


def add_options(parser: Any, *names: str, **changes: Any) -> None:
    """Declare options of the table, with ``changes`` such as another help or default."""
    for name in names:
        parser.add_argument(name, **{**OPTIONS[name], **changes})


def wait_to_be_told(tls: TlsFiles | None = None) -> NoReturn:
    """Sleep until KeyboardInterrupt (main thread only); UserError when ``tls`` has expired.

    Polls, because a signal that one of Zenoh's threads gets does not wake a waiting main thread.
    """
    while True:
        time.sleep(transport.RETRY_S)
        if tls is not None:
            tls.require_valid(time.time())


@cli.command(
    "bridge.ports:run_router",
    "python -m bridge router --listen tls/0.0.0.0:7447 --tls certs/router",
)
def router(parser: Any) -> None:
    listen = f"endpoint for all others; may be repeated (default: {transport.DEFAULT_ENDPOINT})"
    vehicle = "with --tls: a vehicle whose parties have rights here; may be repeated"
    vehicle += f" (default: {DEFAULT_VEHICLE_ID})"
    add_options(parser, "--tls")
    add_options(parser, "--listen", action="append", help=listen)
    add_options(parser, "--connect", default=None, help="endpoint of another router to join")
    add_options(parser, "--vehicle-id", action="append", default=None, help=vehicle)


def run_router(arguments: Any) -> int:
    """Route until SIGTERM or ^C; without ``--tls`` everybody has all rights."""
    listens, connect = arguments.listen or [transport.DEFAULT_ENDPOINT], arguments.connect
    tls, rules = transport.tls_for(arguments.tls, *listens, connect), None
    if tls is not None:
        access.check_name(tls.name, access.ROUTER)
        rules = access.rules_for_listener(arguments.vehicle_id or [DEFAULT_VEHICLE_ID])
    with (
        contextlib.suppress(KeyboardInterrupt),
        cli.sigterm_as_interrupt(),
        closing(transport.open_session(listens, connect, "router", tls, rules)),
    ):
        print(f"ready {','.join(listens)}", flush=True)
        wait_to_be_told(tls)
    return 0


@cli.command(
    "bridge.ports:run_record",
    "python -m bridge record --out car-a.mcap --vehicle-id car-a --wait-s 60",
)
def record(parser: Any) -> None:
    add, one = parser.add_argument, "record only this vehicle (default: all)"
    linger = "seconds to wait for a simulator that has left to come back"
    out = "recording to write; the file must not exist yet"
    add("--out", metavar="F.mcap", type=new_recording, required=True, help=out)
    add_options(parser, "--connect", "--tls", "--wait-s")
    add_options(parser, "--vehicle-id", default=None, help=one)
    add("--linger-s", metavar="SECONDS", type=cli.seconds, default=LINGER_S, help=linger)


def run_record(arguments: Any) -> int:
    tls = transport.tls_for(arguments.tls, arguments.connect)
    path, vehicle_id = Path(arguments.out), arguments.vehicle_id or ANY_VEHICLE
    with (
        cli.sigterm_as_interrupt(),
        open_listener(arguments.connect, vehicle_id, arguments.wait_s, tls) as listener,
        closing(RecordingWriter(path)) as writer,
    ):
        print(f"recording {path}", flush=True)
        try:
            # A signal is the usual end of a recording: it must not cut a message in two.
            with cli.quit_on_signals(listener.stopped.set):
                _listen(listener, writer, arguments.linger_s)
                writer.finish()
        except OSError as error:
            stopped = f"error: recording {path} stopped: {error.strerror}"
            print(f"{stopped}; it holds what was written before", file=sys.stderr)
            return NOT_WRITTEN
    _say_dropped(listener)
    print(f"wrote {path}: {counted(writer.messages, 'message')}")
    return 0


def _listen(listener: WireListener, writer: RecordingWriter, linger_s: float) -> None:
    for heard in filter(None, listener.until_gone(linger_s)):
        # In a flood the copies for viewers are dropped first.
        writer.write(heard, with_view=listener.queue.qsize() < QUEUE_MESSAGES // 2)


@cli.command(
    "bridge.rerun.draw:run",
    "python -m bridge view --serve",
    "python -m bridge view --save drive.rrd --wait-s 60",
    "python -m bridge view drive.mcap --save drive.rrd",
    "python -m bridge view --foxglove",
)
def view(parser: Any) -> None:
    text = "show this recording of bridge record, instead of listening"
    parser.add_argument("recording", nargs="?", metavar="F.mcap", help=text)
    add_view(parser, " (the default)")


sense = cli.command(
    "edge_runtime.sense:run",
    "python -m bridge sense --source my_camera:Camera --policy my.onnx --vehicle-id hunter01",
)(add_source)


def add_view(parser: Any, default: str = "") -> None:
    add = parser.add_mutually_exclusive_group().add_argument
    kind: Any = {"dest": "sink", "action": "store_const"}
    add("--spawn", **kind, const=SPAWN, help=f"open a rerun window{default}")
    add("--serve", **kind, const=SERVE, help="serve a web page on this machine's loopback only")
    add("--save", dest="sink", metavar="F.rrd", help="write a recording instead of showing it")
    text = f"serve Foxglove, on this machine's loopback only (default port: {FOXGLOVE_PORT})"
    number: Any = {"type": cli.whole_number(1, 65535), "const": FOXGLOVE_PORT}
    add("--foxglove", nargs="?", metavar="PORT", help=text, **number)
    text = "with --serve: port of the page; N + 1 is for its data (default: two free ports)"
    parser.add_argument("--port", metavar="N", type=cli.whole_number(1, 65534), help=text)
    add_options(parser, "--connect", "--tls", "--wait-s")
    text = f"the vehicle (default: {DEFAULT_VEHICLE_ID}; in a recording: the only one)"
    add_options(parser, "--vehicle-id", default=None, help=text)
