"""``python -m bridge record``: MCAP files of the wire.

The recorder is a listener of its own. It keeps the exact payloads for replay, and copies that
viewers can draw:

| topic | encoding |
|---|---|
| ``phil/<id>/<topic>``, the keys of the wire | ``msgpack``: the payload as it was |
| ``phil/<id>/alive``, ``phil/<id>/simulator`` | ``json``: {"here": true}, or false |
| ``view/<id>/frames`` | ``foxglove.RawImage``: frame t-1 above frame t; so each picture array |
| ``view/<id>/<topic>``, of every topic of the wire | protobuf ``phil.State`` and so on |
| ``view/<id>/events`` | ``foxglove.Log``: tokens, unreadable and oversized messages |

The copies are protobuf: Foxglove and rerun both read it by the descriptor that the recording
carries along, and know ``foxglove.RawImage`` and ``foxglove.Log`` by name. (rerun 0.41 decodes no
JSON.) The descriptors are made at run time from structs: no compiler, no generated file.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import sys
import threading
import time
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, BinaryIO, NamedTuple

import msgspec
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
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
from edge_runtime.cli import Command, examples, quit_on_signals, seconds, sigterm_as_interrupt
from edge_runtime.files import check_writable, make_directory
from edge_runtime.manifest import Layout, Task
from edge_runtime.tls import tls_for
from edge_runtime.util import UserError, counted

FLUSH_S = 0.5  # A kill loses at most this much, and what waits in the queue
NOT_WRITTEN = 1  # Exit status where the disk did not take the recording to its end
CHUNK_BYTES = 1 << 20
NEVER_OVER = "choose another name: no recording is lost"


def new_recording(path: str) -> str:
    """The path itself; UserError where a recording could not be begun there later."""
    check_writable(path)
    if Path(path).exists():
        raise UserError(f"{path} exists; {NEVER_OVER}")
    return path


def _add_record_arguments(parser: Any) -> None:
    out = "the recording; it must not exist yet"
    parser.add_argument("--out", metavar="F.mcap", type=new_recording, required=True, help=out)
    add_options(parser, "--connect", "--tls", "--wait-s", "--duration-s")
    help_text = "record this vehicle only (otherwise all)"
    add_options(parser, "--vehicle-id", default=None, help=help_text)
    linger = "how long to go on without any simulator: it may come back, in seconds"
    parser.add_argument(
        "--linger-s", metavar="SECONDS", type=seconds, default=LINGER_S, help=linger
    )


def _run_record(arguments: Any) -> int:
    """Run the command until the simulators go, the time is over, or somebody interrupts."""
    tls = tls_for(arguments.tls, arguments.connect)
    path, vehicle_id = Path(arguments.out), arguments.vehicle_id or ANY_VEHICLE
    with (
        sigterm_as_interrupt(),
        open_listener(arguments.connect, vehicle_id, arguments.wait_s, tls) as listener,
        contextlib.closing(RecordingWriter(path)) as writer,
    ):
        try:
            print(f"recording {path}", flush=True)
            # A signal is the ordinary way to end a recording: it must not cut a message in two.
            ended = threading.Event()

            def end() -> bool:
                ended.set()
                return True

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
            writer.write(heard, with_view=listener.waiting < QUEUE_MESSAGES // 2)
        if time.monotonic() >= flush_s:
            writer.flush()
            flush_s = time.monotonic() + FLUSH_S
        if ended.is_set():
            return


class ViewerCopies:
    """Makes copies that viewers can draw, and hands each to ``add``. Used by one thread."""

    def __init__(self, add: Callable[[str, Schema, int, bytes], None]) -> None:
        self._add = add
        self._layouts: dict[str, Layout | None] = {}  # By the vehicle, as its scenes say

    def write(self, heard: Heard) -> None:
        """Copy one message, or tell of it as an event."""
        if heard.topic in TOKEN_TOPICS:
            who = "edge runtime" if heard.topic == "alive" else "simulator"
            what = "is here" if heard.payload == b"\x01" else "has gone"
            self._event(heard, Level.INFO, f"{who} {what}")
        elif heard.size > len(heard.payload):
            self._event(heard, Level.WARNING, f"{heard.topic} of {heard.size} bytes, not kept")
        else:
            self._view(heard)

    def _view(self, heard: Heard) -> None:
        message = decode(heard)
        if isinstance(message, wire.Rejection):
            self._event(heard, Level.WARNING, f"unreadable {heard.topic}: {message.detail}")
            return
        try:
            self._copy(heard, heard.topic, message)
        except ValueError as error:  # The wire carries integers that protobuf's do not hold.
            self._event(heard, Level.WARNING, f"{heard.topic} not drawn: {error}")
            return
        vehicle = _vehicle_id(heard)
        if isinstance(message, Scene):
            self._layouts[vehicle] = Layout(message.task) if message.task else None
        elif isinstance(message, wire.State) and (layout := self._layouts.get(vehicle)) is not None:
            self._copy_images(heard, message, layout)

    def _copy_images(self, heard: Heard, state: wire.State, layout: Layout) -> None:
        if layout.refusal(state.observation) is not None:
            return
        for name, array in layout.arrays(state.observation).items():
            images = images_of(array)
            if images is None:
                continue
            # They lie one after the other: in memory that is one picture, so many times as high.
            count, height, width, colours = images.shape
            encoding = "rgb8" if colours == 3 else "mono8"
            size = (width, count * height, encoding, width * colours)
            data, at = images.tobytes(), _stamp(heard.arrived_ns)
            self._copy(heard, name, RawImage(at, *size, data, _vehicle_id(heard)))

    def _event(self, heard: Heard, level: Level, text: str) -> None:
        self._copy(heard, "events", Log(_stamp(heard.arrived_ns), level, text, _vehicle_id(heard)))

    def _copy(self, heard: Heard, name: str, values: msgspec.Struct) -> None:
        """Add what viewers can draw, to the vehicle's topic of that name."""
        schema = describe(type(values))
        known = schema.make.DESCRIPTOR.fields_by_name
        fields = msgspec.to_builtins(values, builtin_types=(bytes,)).items()
        drawn = {name: value for name, value in fields if name in known}
        data = schema.make(**drawn).SerializeToString()
        self._add(f"view/{_vehicle_id(heard)}/{name}", schema, heard.arrived_ns, data)


class RecordingWriter:
    """Writes one recording; used by one thread. OSError from any call where the disk is full."""

    def __init__(self, path: Path) -> None:
        """Make the file; UserError where it exists already."""
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
            self._add(heard.key, "json", heard.arrived_ns, text)
        elif is_kept:
            self._add(heard.key, WIRE_ENCODING, heard.arrived_ns, heard.payload)
        if with_view or heard.topic in TOKEN_TOPICS or not is_kept:
            self._copies.write(heard)

    def flush(self) -> None:
        """End the chunk: from here on a kill does not lose what has been written."""
        self._mcap.flush()

    def finish(self, dropped: int) -> None:
        """Write the index; ``dropped`` is how many messages came too fast to be written."""
        counts = {"messages": str(self.messages), "dropped": str(dropped)}
        self._mcap.flush()
        self._mcap.add_metadata(METADATA, counts)
        self._mcap.finish()
        self._file.close()

    def close(self) -> None:
        """Close the file, finished or not."""
        close_torn(self._file)

    def _add_copy(self, topic: str, schema: Schema, now_ns: int, data: bytes) -> None:
        schema_id = self._schema(schema.name, "protobuf", schema.descriptors)
        self._add(topic, "protobuf", now_ns, data, schema_id)

    def _add(self, topic: str, encoding: str, now_ns: int, data: bytes, schema_id: int = 0) -> None:
        channel_id = self._channel(topic, encoding, schema_id)
        self._mcap.add_message(channel_id, now_ns, data, now_ns)


def _vehicle_id(heard: Heard) -> str:
    return heard.key.split("/")[1]


def new_recording_at(path: Path) -> tuple[BinaryIO, Writer]:
    """Begin a new MCAP file, in chunks with checksums.

    UserError, and no file, where one exists already, or it cannot be made.
    """
    make_directory(path.parent)
    try:
        stream = path.open("xb")
        try:
            writer = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD, enable_data_crcs=True)
            writer.start(profile="", library=f"phil-hil {__version__}")
            writer.flush()  # Before anybody is told of the file, it is an MCAP file.
        except OSError:
            close_torn(stream)
            path.unlink()
            raise
    except FileExistsError:
        raise UserError(f"{path} exists; {NEVER_OVER}") from None
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from None
    return stream, writer


def close_torn(stream: BinaryIO) -> None:
    """Close a file that may have failed: it tries once more what the disk did not take."""
    with contextlib.suppress(OSError):
        stream.close()


Field: Any = descriptor_pb2.FieldDescriptorProto
TIMESTAMP = "google.protobuf.Timestamp"
Time = Annotated[dict[str, int], TIMESTAMP]  # As `_stamp` makes it
Fixed32 = Annotated[int, Field.TYPE_FIXED32]
Data = Annotated[bytes, Field.TYPE_BYTES]
_SCALARS = {
    str: Field.TYPE_STRING,
    bool: Field.TYPE_BOOL,
    int: Field.TYPE_INT64,
    float: Field.TYPE_DOUBLE,
    Fixed32: Field.TYPE_FIXED32,
    Data: Field.TYPE_BYTES,
}


class RawImage(msgspec.Struct):
    """``foxglove.RawImage``; the order is that of Foxglove's field numbers, as in `Log`."""

    timestamp: Time
    width: Fixed32
    height: Fixed32
    encoding: str
    step: Fixed32
    data: Data
    frame_id: str


class Level(enum.IntEnum):
    """``foxglove.Log.Level``."""

    UNKNOWN, DEBUG, INFO, WARNING, ERROR, FATAL = range(6)


class Log(msgspec.Struct):
    """``foxglove.Log``, of which we fill time, level, text and sender."""

    timestamp: Time
    level: Level
    message: str
    name: str


def _stamp(time_ns: int) -> dict[str, int]:
    """Nanoseconds since 1970 as protobuf's timestamp has them."""
    return dict(zip(("seconds", "nanos"), divmod(time_ns, 10**9), strict=True))


class Schema(NamedTuple):
    """A protobuf message type: its full name, its class, and its serialised FileDescriptorSet."""

    name: str
    make: Any
    descriptors: bytes


@functools.cache
def describe(kind: type[msgspec.Struct]) -> Schema:
    """Mirror a struct as a protobuf message, without plain bytes and what protobuf lacks."""
    package = "foxglove" if kind in (RawImage, Log) else "phil"
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    name = f"{package}.{kind.__name__}"
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{name}.proto", package=package, syntax="proto3", dependency=[stamp.name]
    )
    _add_struct(file.message_type.add(), kind, package)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(stamp)
    pool.Add(file)
    make = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    files = descriptor_pb2.FileDescriptorSet(file=[stamp, file])
    return Schema(name, make, files.SerializeToString())


def _add_struct(message: Any, kind: type[msgspec.Struct], package: str) -> None:
    message.name, path = kind.__name__, f"{package}.{kind.__name__}"
    hints = typing.get_type_hints(kind, include_extras=True)
    for number, (name, hint) in enumerate(hints.items(), start=1):
        inner = typing.get_args(hint)
        if type(None) in inner:
            hint = inner[0]
        field = message.field.add(name=name, number=number, label=Field.LABEL_OPTIONAL)
        origin, inner = typing.get_origin(hint), typing.get_args(hint)
        if origin in (dict, list, Sequence):
            field.label, hint = Field.LABEL_REPEATED, inner[0]
        if origin is dict and inner[1] not in _SCALARS:  # an observation's bytes
            del message.field[-1]
        elif origin is dict:
            field.type = Field.TYPE_MESSAGE
            field.type_name = f".{path}.{_add_map_entry(message, name, inner)}"
        elif hint in _SCALARS:
            field.type = _SCALARS[hint]
        elif hint == Time:
            field.type, field.type_name = Field.TYPE_MESSAGE, f".{TIMESTAMP}"
        elif isinstance(hint, type) and issubclass(hint, msgspec.Struct) and hint is not Task:
            _add_struct(message.nested_type.add(), hint, path)
            field.type, field.type_name = Field.TYPE_MESSAGE, f".{path}.{hint.__name__}"
        elif hint is Level:
            levels = message.enum_type.add(name=hint.__name__)
            for one in hint:
                levels.value.add(name=one.name, number=one.value)
            field.type, field.type_name = Field.TYPE_ENUM, f".{path}.{hint.__name__}"
        else:
            del message.field[-1]


def _add_map_entry(message: Any, name: str, inner: tuple[Any, ...]) -> str:
    """Protobuf's own form of a map: a nested message of key and value."""
    entry_name = "".join(part.title() for part in name.split("_")) + "Entry"
    entry = message.nested_type.add(name=entry_name)
    entry.options.map_entry = True
    for number, (label, kind) in enumerate(zip(("key", "value"), inner, strict=True), start=1):
        entry.field.add(name=label, number=number, label=Field.LABEL_OPTIONAL, type=_SCALARS[kind])
    return entry_name


RECORD_EXAMPLE = examples(
    "python -m bridge record --out drive.mcap",
    "python -m bridge record --out car-a.mcap --vehicle-id car-a --wait-s 60 --duration-s 300",
)
RECORD = Command(RECORD_EXAMPLE, _add_record_arguments, _run_record)
