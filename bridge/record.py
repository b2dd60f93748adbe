"""``python -m bridge record``: write an MCAP file of the wire.

The file holds the exact payloads for replay, and copies that viewers can draw:

| topic | encoding |
|---|---|
| ``phil/<id>/<topic>``, the keys of the wire | ``msgpack``: the payload as it was |
| ``phil/<id>/alive``, ``phil/<id>/simulator`` | ``json``: {"here": true}, or false |
| ``view/<id>/frames`` | ``foxglove.RawImage`` of each picture array: frame t-1 above frame t |
| ``view/<id>/<topic>``, of every topic of the wire | ``phil.State`` and so on |
| ``view/<id>/events`` | ``foxglove.Log``: tokens, unreadable and oversized messages |

The copies are JSON with a JSON Schema of the structs: Foxglove reads any, and knows
``foxglove.RawImage`` and ``foxglove.Log`` by name. rerun reads none; `bridge view` is for it.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec
from mcap.writer import CompressionType, Writer

from bridge.messages import TOKEN_TOPICS, Heard, Scene, decode, images_of
from bridge.ports import (
    ANY_VEHICLE,
    LINGER_S,
    QUEUE_MESSAGES,
    WireListener,
    add_options,
    open_listener,
)
from bridge.recording import METADATA, WIRE_ENCODING
from edge_runtime import __version__, wire
from edge_runtime.cli import Subcommand, examples, quit_on_signals, seconds, sigterm_as_interrupt
from edge_runtime.files import check_writable, make_directory
from edge_runtime.manifest import Layout
from edge_runtime.transport import tls_for
from edge_runtime.util import UserError, counted

FLUSH_S = 0.5  # A kill loses at most this much, and what waits in the queue
NOT_WRITTEN = 1  # Exit status where the disk did not take the recording to its end
CHUNK_BYTES = 1 << 20
NOT_COPIED = {"observation", "picture", "task", "plan", "roads", "lane_lines", "path", "goal"}
"""Fields that no viewer plots."""
ENCODING, SCHEMA_ENCODING = "json", "jsonschema"
INFO, WARNING = 2, 3  # Of ``foxglove.Log.level``


def new_recording(path: str) -> str:
    """Return the absolute path; UserError where no recording could be begun there."""
    check_writable(path)
    if Path(path).exists():
        raise UserError(f"{path} exists; choose another name: no recording is lost")
    return str(Path(path).absolute())


def _add_record_arguments(parser: Any) -> None:
    add, one = parser.add_argument, "record this vehicle only (otherwise all)"
    linger = "longest wait for a simulator that has gone to come back, in s"
    out = "the recording, which must not exist yet"
    add("--out", metavar="F.mcap", type=new_recording, required=True, help=out)
    add_options(parser, "--connect", "--tls", "--wait-s", "--duration-s")
    add_options(parser, "--vehicle-id", default=None, help=one)
    add("--linger-s", metavar="SECONDS", type=seconds, default=LINGER_S, help=linger)


def _run_record(arguments: Any) -> int:
    """Record until the simulators go, the time is over, or somebody interrupts."""
    tls = tls_for(arguments.tls, arguments.connect)
    path, vehicle_id = Path(arguments.out), arguments.vehicle_id or ANY_VEHICLE
    with (
        sigterm_as_interrupt(),
        open_listener(arguments.connect, vehicle_id, arguments.wait_s, tls) as listener,
        contextlib.closing(RecordingWriter(path)) as writer,
    ):
        try:
            print(f"recording {path}", flush=True)
            ended = threading.Event()

            def end() -> bool:
                ended.set()
                return True

            # A signal is the ordinary way to end a recording: it must not cut a message in two.
            with quit_on_signals(end):
                _listen(listener, writer, arguments, ended)
                writer.finish(listener.dropped)
        except OSError as error:
            stopped = f"error: recording {path} stopped: {error.strerror}"
            print(f"{stopped}; it holds what was written before", file=sys.stderr)
            return NOT_WRITTEN
    if listener.dropped:
        dropped = counted(listener.dropped, "message")
        print(f"{dropped} came faster than they could be written", file=sys.stderr)
    print(f"wrote {path}: {counted(writer.messages, 'message')}")
    return 0


def _listen(
    listener: WireListener, writer: RecordingWriter, arguments: Any, ended: threading.Event
) -> None:
    flush_s = time.monotonic() + FLUSH_S
    for heard in listener.until_gone(arguments.duration_s, arguments.linger_s):
        if heard is not None:
            # Under a flood the copies for viewers are the first to go.
            writer.write(heard, with_view=listener.queue.qsize() < QUEUE_MESSAGES // 2)
        if time.monotonic() >= flush_s:
            writer.flush()
            flush_s = time.monotonic() + FLUSH_S
        if ended.is_set():
            return


class ViewerCopies:
    """Makes copies that viewers can draw, and hands each to ``add``. Not thread-safe."""

    def __init__(self, add: Callable[[str, Schema, int, bytes], None]) -> None:
        self._add = add
        self._layouts: dict[str, Layout | None] = {}  # By the vehicle, as its scenes say

    def write(self, heard: Heard) -> None:
        """Copy a message, or log an event about it."""
        if heard.topic in TOKEN_TOPICS:
            who = "edge runtime" if heard.topic == "alive" else "simulator"
            what = "is here" if heard.payload == b"\x01" else "has gone"
            self._event(heard, INFO, f"{who} {what}")
            return
        if heard.size > len(heard.payload):
            self._event(heard, WARNING, f"{heard.topic} of {heard.size} bytes, not kept")
            return
        message, vehicle = decode(heard), _vehicle_id(heard)
        if isinstance(message, wire.Rejection):
            self._event(heard, WARNING, f"unreadable {heard.topic}: {message.detail}")
            return
        self._copy(heard, heard.topic, message)
        if isinstance(message, Scene):
            self._layouts[vehicle] = Layout(message.task) if message.task else None
        elif isinstance(message, wire.State) and (layout := self._layouts.get(vehicle)) is not None:
            self._copy_images(heard, message, layout)

    def _copy_images(self, heard: Heard, state: wire.State, layout: Layout) -> None:
        if layout.refusal(state.observation) is not None:
            return
        for name, array in layout.arrays(state.observation).items():
            if (images := images_of(array)) is None:
                continue
            # They lie one after the other: in memory that is one picture, so many times as high.
            count, height, width, colours = images.shape
            encoding = "rgb8" if colours == 3 else "mono8"
            size = (width, count * height, encoding, width * colours)
            image = RawImage(_stamp(heard.arrived_ns), *size, images.tobytes(), _vehicle_id(heard))
            self._copy(heard, name, image)

    def _event(self, heard: Heard, level: int, text: str) -> None:
        self._copy(heard, "events", Log(_stamp(heard.arrived_ns), level, text, _vehicle_id(heard)))

    def _copy(self, heard: Heard, name: str, values: msgspec.Struct) -> None:
        """Add what viewers can draw, to the vehicle's topic of that name."""
        fields = msgspec.structs.asdict(values).items()
        unknown = (None, msgspec.UNSET)
        drawn = {n: v for n, v in fields if n not in NOT_COPIED and v not in unknown}
        topic, data = f"view/{_vehicle_id(heard)}/{name}", msgspec.json.encode(drawn)
        self._add(topic, describe(type(values)), heard.arrived_ns, data)


class RecordingWriter:
    """Writes one recording. Not thread-safe; any call raises OSError where the disk is full."""

    def __init__(self, path: Path) -> None:
        self.messages = 0
        self._copies = ViewerCopies(self._add_copy)
        self._file, self._mcap = new_recording_at(path)
        # Each is registered once; with its schema, as a picture may have the name of a message.
        self._channel = functools.cache(self._mcap.register_channel)
        self._schema = functools.cache(self._mcap.register_schema)

    def write(self, heard: Heard, with_view: bool = True) -> None:
        """Add one message; ``with_view`` False leaves out the copy for viewers."""
        self.messages += 1
        is_kept = heard.size == len(heard.payload)
        if heard.topic in TOKEN_TOPICS:
            text = b'{"here": true}' if heard.payload == b"\x01" else b'{"here": false}'
            self._add(heard.key, ENCODING, heard.arrived_ns, text)
        elif is_kept:
            self._add(heard.key, WIRE_ENCODING, heard.arrived_ns, heard.payload)
        if with_view or heard.topic in TOKEN_TOPICS or not is_kept:
            self._copies.write(heard)

    def flush(self) -> None:
        """End the chunk: a kill does not lose what was written before."""
        self._mcap.flush()

    def finish(self, dropped: int) -> None:
        """Write the index; ``dropped`` is how many messages came too fast to be written."""
        self._mcap.flush()
        counts = {"messages": str(self.messages), "dropped": str(dropped)}
        self._mcap.add_metadata(METADATA, counts)
        self._mcap.finish()
        self._file.close()

    def close(self) -> None:
        """Close the file, finished or not."""
        close_torn(self._file)

    def _add_copy(self, topic: str, schema: Schema, now_ns: int, data: bytes) -> None:
        schema_id = self._schema(schema.name, SCHEMA_ENCODING, schema.data)
        self._add(topic, ENCODING, now_ns, data, schema_id)

    def _add(self, topic: str, encoding: str, now_ns: int, data: bytes, schema_id: int = 0) -> None:
        channel_id = self._channel(topic, encoding, schema_id)
        self._mcap.add_message(channel_id, now_ns, data, now_ns)


def _vehicle_id(heard: Heard) -> str:
    return heard.key.split("/")[1]


def new_recording_at(path: Path) -> tuple[BinaryIO, Writer]:
    """Begin a new MCAP file, in chunks with checksums; UserError, and no file, on a full disk."""
    make_directory(path.parent)
    stream = path.open("xb")
    try:
        writer = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library=f"phil-hil {__version__}")
        writer.flush()  # Before anybody is told of the file, it is an MCAP file.
    except OSError as error:
        close_torn(stream)
        path.unlink()
        raise UserError(f"cannot write {path}: {error.strerror}") from None
    return stream, writer


def close_torn(stream: BinaryIO) -> None:
    """Close a file whose last bytes the disk may not take."""
    with contextlib.suppress(OSError):
        stream.close()


class Stamp(msgspec.Struct):
    """Time since 1970."""

    sec: int
    nsec: int


class RawImage(msgspec.Struct):
    """``foxglove.RawImage``."""

    timestamp: Stamp
    width: int
    height: int
    encoding: str
    step: int
    data: bytes
    frame_id: str


class Log(msgspec.Struct):
    """``foxglove.Log``, of which we fill time, level, text and sender."""

    timestamp: Stamp
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


def _stamp(time_ns: int) -> Stamp:
    return Stamp(*divmod(time_ns, 10**9))


class Schema(NamedTuple):
    """A message type: its full name, and its JSON Schema."""

    name: str
    data: bytes


@functools.cache
def describe(kind: type[msgspec.Struct]) -> Schema:
    """Return the schema of the fields that are copied for viewers; None is never copied."""
    _, parts = msgspec.json.schema_components([kind], ref_template="#/$defs/{name}")
    fields = parts.pop(kind.__name__)["properties"].items()
    copied = {n: field.get("anyOf", [field])[0] for n, field in fields if n not in NOT_COPIED}
    schema = {"type": "object", "properties": copied, "$defs": parts}  # As Foxglove wants it
    package = "foxglove" if kind in (RawImage, Log) else "phil"
    return Schema(f"{package}.{kind.__name__}", msgspec.json.encode(schema))


RECORD_EXAMPLE = examples(
    "python -m bridge record --out drive.mcap",
    "python -m bridge record --out car-a.mcap --vehicle-id car-a --wait-s 60 --duration-s 300",
)
RECORD = Subcommand(RECORD_EXAMPLE, _add_record_arguments, _run_record)
