"""Recordings of the wire as MCAP files, read and written.

The topics ``phil/<id>/...`` hold the exact payloads, ``view/<id>/...`` copies for Foxglove in JSON:
messages, pictures (frame t-1 above frame t), the road from above, and ``events`` (tokens,
unreadable and oversized messages).
"""

from __future__ import annotations

import contextlib
import functools
import struct
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader, Summary
from mcap.records import Channel, Chunk, Footer, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from bridge import messages
from bridge import rerun as view
from bridge.messages import DECODERS, SHADOW, TOKEN_TOPICS, Heard, Scene, decode
from edge_runtime import __version__, wire
from edge_runtime.files import check_writable, make_directory
from edge_runtime.manifest import Layout
from edge_runtime.util import UserError, counted, open_regular

WIRE_ENCODING = "msgpack"
ENCODING, SCHEMA_ENCODING = "json", "jsonschema"  # Of the copies for viewers
CHUNK_BYTES = 1 << 20
FLUSH_S = 0.5  # A kill loses at most this much of a recording, and the waiting messages
MAX_RECORD_BYTES = 8 << 20
"""Of a record, and of an unpacked chunk; ours hold little more than 5 MiB."""
TORN = (
    McapError, struct.error, zstandard.ZstdError, ValueError, KeyError, RuntimeError, OverflowError,
    MemoryError,
)  # fmt: skip
"""Exceptions of the libraries for bytes that are no MCAP: the file may come from anybody."""


class Recording:
    """One MCAP file; ``cut_off`` and ``damaged_places`` are known at the end of ``messages``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut_off = False
        """The file has no end of its own: a kill, or damage beyond which nothing can be read."""
        self.damaged_places = 0  # Chunks that do not match their checksums

    def say_trouble(self) -> None:
        trouble = "was cut off" if self.cut_off else ""
        if self.damaged_places:
            trouble = f"has {counted(self.damaged_places, 'damaged place')}"
        if trouble:
            line = f"the recording {self.path} {trouble}; its intact part is used"
            print(line, file=sys.stderr, flush=True)

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages, with their channels, in the order of their arrival.

        A damaged chunk is left out and counted; a torn file is read up to the tear. UserError for
        no MCAP.
        """
        self.cut_off, self.damaged_places, self._whole_chunks = True, 0, 0
        try:
            with open_regular(self.path) as stream:
                if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise UserError(f"{self.path} is no MCAP recording")
                summary = _summary(stream)
                channels = dict(summary.channels)
                stream.seek(len(MCAP0_MAGIC))
                for record in self._records(stream):
                    if isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, Message) and record.channel_id in channels:
                        yield channels[record.channel_id], record
        except OSError as error:
            raise UserError(f"recording {self.path} cannot be read: {error.strerror}") from None
        if summary.statistics is not None:  # Some chunks may not have been recognised as such
            self.damaged_places = max(0, summary.statistics.chunk_count - self._whole_chunks)

    def _records(self, stream: BinaryIO) -> Iterator[McapRecord]:
        """Yield the records in chunks; those outside have no checksum."""
        reader = StreamReader(stream, True, True, record_size_limit=MAX_RECORD_BYTES)
        with contextlib.suppress(*TORN):
            for record in reader.records:
                if isinstance(record, Footer):
                    self.cut_off = False
                if not isinstance(record, Chunk):
                    continue
                try:
                    size = zstandard.frame_content_size(record.data) if record.compression else 0
                    if max(size, record.uncompressed_size) > MAX_RECORD_BYTES:
                        raise ValueError("a chunk larger than any of ours")
                    parts = breakup_chunk(record, validate_crc=True)
                except TORN:
                    self.damaged_places += 1
                else:
                    self._whole_chunks += 1
                    yield from parts


def _summary(stream: BinaryIO) -> Summary:
    """Return the index, which repeats all channels: a chunk that defines one may be damaged."""
    with contextlib.suppress(*TORN, OSError):
        stream.seek(0)
        if summary := SeekingReader(stream, record_size_limit=MAX_RECORD_BYTES).get_summary():
            return summary
    return Summary()


def choose_vehicle(recording: Recording, vehicle_id: str | None) -> str:
    """Return the vehicle of that id, or the only vehicle; UserError where that fails."""
    vehicles = {_wire_topic(channel)[0] for channel, _ in recording.messages()} - {""}
    names = ", ".join(sorted(vehicles)) or "none"
    chosen = vehicles & {vehicle_id} if vehicle_id else vehicles
    if len(chosen) != 1:
        raise UserError(f"{recording.path} holds vehicles {names}; name one with --vehicle-id")
    return chosen.pop()


def heard_of(recording: Recording, vehicle_id: str) -> Iterator[Heard]:
    for channel, message in recording.messages():
        vehicle, topic = _wire_topic(channel)
        if vehicle == vehicle_id:
            yield Heard(channel.topic, topic, message.data, message.log_time, len(message.data))


def valid_messages(recording: Recording, vehicle_id: str) -> Iterator[tuple[Heard, Any]]:
    """Yield a drive's messages, raw and decoded, without invalid ones and a shadow's."""
    for heard in heard_of(recording, vehicle_id):
        if heard.topic in DECODERS and heard.topic != SHADOW:
            message = decode(heard)
            if not isinstance(message, wire.Rejection):
                yield heard, message


def _wire_topic(channel: Channel) -> tuple[str, str]:
    """Return vehicle and topic of a wire message; empty for a copy for viewers."""
    parts = channel.topic.split("/")
    if channel.message_encoding != WIRE_ENCODING or len(parts) != 3:
        return "", ""
    return parts[1], parts[2]


class RecordingWriter:
    """Writes one recording. Not thread-safe; any call raises OSError where the disk is full."""

    def __init__(self, path: Path) -> None:
        self.messages = 0
        self._flush_s = 0.0  # When the chunk ends
        self._copies = ViewerCopies(self._add_copy)
        self._file, self._mcap = new_recording_at(path)
        # Each is registered once, by name and schema: a picture may have a message's name.
        self._channel = functools.cache(self._mcap.register_channel)
        self._schema = functools.cache(self._mcap.register_schema)

    def write(self, heard: Heard, with_view: bool = True) -> None:
        """Add one message; ``with_view`` False leaves out the copy for viewers."""
        self.messages += 1
        if heard.topic in TOKEN_TOPICS:
            text = b'{"here": true}' if heard.payload == b"\x01" else b'{"here": false}'
            self._add(heard.key, ENCODING, heard.arrived_ns, text)
        elif heard.is_whole:
            self._add(heard.key, WIRE_ENCODING, heard.arrived_ns, heard.payload)
        if with_view:
            self._copies.write(heard)
        if time.monotonic() >= self._flush_s:
            self.flush()

    def flush(self) -> None:
        """End the chunk, so that a kill does not lose it."""
        self._mcap.flush()
        self._flush_s = time.monotonic() + FLUSH_S

    def finish(self) -> None:
        self._mcap.finish()
        self._file.close()

    def close(self) -> None:
        """Close the file, finished or not; the disk may not take its last bytes."""
        with contextlib.suppress(OSError):
            self._file.close()

    def _add_copy(self, topic: str, schema: Schema, now_ns: int, data: bytes) -> None:
        name, text = schema
        schema_id = self._schema(name, SCHEMA_ENCODING, text)
        self._add(topic, ENCODING, now_ns, data, schema_id)

    def _add(self, topic: str, encoding: str, now_ns: int, data: bytes, schema_id: int = 0) -> None:
        channel_id = self._channel(topic, encoding, schema_id)
        self._mcap.add_message(channel_id, now_ns, data, now_ns)


def new_recording_at(path: Path) -> tuple[BinaryIO, Writer]:
    """Begin a new MCAP file, in chunks with checksums; UserError, and no file, on a full disk."""
    make_directory(path.parent)
    stream = path.open("xb")
    try:
        writer = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library=f"phil-hil {__version__}")
        writer.flush()  # The file is a valid MCAP file before anybody learns of it.
    except OSError as error:
        with contextlib.suppress(OSError):
            stream.close()
        path.unlink()
        raise UserError(f"cannot write {path}: {error.strerror}") from None
    return stream, writer


@contextlib.contextmanager
def whole_recording(path: str | Path) -> Iterator[RecordingWriter]:
    """Write a whole recording; leave no file where that fails."""
    writer = RecordingWriter(path := Path(new_recording(path)))
    with contextlib.closing(writer):
        try:
            yield writer
            writer.finish()
        except BaseException:
            path.unlink()
            raise


def new_recording(path: str | Path) -> str:
    """Return the absolute path; UserError where no recording could be begun there."""
    check_writable(path)
    if Path(path).exists():
        raise UserError(f"{path} exists; choose another name: no recording is lost")
    return str(Path(path).absolute())


# Foxglove's own message types, with the fields that we fill; it reads the others as empty.
define: Any = msgspec.defstruct
many = list.__class_getitem__
Stamp = define("Time", [("sec", int), ("nsec", int)])
RawImage = define("RawImage", [("timestamp", Stamp), ("width", int), ("height", int),
    ("encoding", str), ("step", int), ("data", bytes), ("frame_id", str)])  # fmt: skip
Log = define("Log", [("timestamp", Stamp), ("level", int), ("message", str), ("name", str)])
Vector = define("Vector3", [(axis, float) for axis in "xyz"])
Paint = define("Color", [(part, float) for part in "rgba"])
Line = define("LinePrimitive", [("thickness", float), ("points", many(Vector)), ("color", Paint)])
Entity = define("SceneEntity", [("timestamp", Stamp), ("frame_id", str), ("id", str),
    ("lines", many(Line))])  # fmt: skip
SceneUpdate = define("SceneUpdate", [("entities", many(Entity))])
FrameTransform = define("FrameTransform", [("timestamp", Stamp), ("parent_frame_id", str),
    ("child_frame_id", str), ("translation", Vector)])  # fmt: skip
FOXGLOVE = (RawImage, Log, SceneUpdate, FrameTransform)
ROAD_FRAME, EGO_FRAME = "road", "ego"  # Metres; x to the right, y up on the map


def draw_road(scene: Scene, now: Any) -> Any:
    strips: list[Any] = [
        *((points, view.ROAD, scene.road_width_m) for points in scene.roads),
        *((points, view.MARKING, 0.12) for points in scene.lane_lines),
        (scene.path, view.PATH, 0.3),
    ]
    if scene.goal is not None:
        x, y = scene.goal
        strips.append(([(x - 0.5, y), (x + 0.5, y)], view.GOAL, 1.0))
    for car in scene.vehicles:
        colour = view.POLICY if car.ego else view.APPLIED
        strips.append((messages.body(car), colour, car.width_m))
        strips.append((messages.windscreen(car), view.GLASS, 0.6))
    lines = []
    for layer, (points, colour, width_m) in enumerate(strips):
        paint = Paint(*(part / 255 for part in colour), 1.0)
        lines.append(Line(width_m, [Vector(x, -y, 0.01 * layer) for x, y in points], paint))
    return SceneUpdate([Entity(now, ROAD_FRAME, ROAD_FRAME, lines)])


Schema = tuple[str, bytes]  # The full name of a message type, and its JSON Schema


NOT_COPIED = {"observation", "picture", "task", "plan", "roads", "lane_lines", "path", "goal"}
"""Fields that no viewer plots."""
INFO, WARNING = 2, 3  # Of ``foxglove.Log.level``


@functools.cache
def describe(kind: Any) -> Schema:
    """Return the schema of the fields that are copied for viewers; None is never copied."""
    name, parts = kind.__name__, msgspec.json.schema_components([kind], ref_template="{name}")[1]

    def plain(part: dict[str, Any]) -> dict[str, Any]:
        """Resolve references and alternatives, which Foxglove's readers do not know."""
        part = part.get("anyOf", [part])[0]
        part = parts[part["$ref"]] if "$ref" in part else part
        schema: dict[str, Any] = {
            key: part[key] for key in ("type", "contentEncoding") if key in part
        }
        if part["type"] == "object":
            fields = part.get("properties", {}).items()
            schema["properties"] = {n: plain(field) for n, field in fields if n not in NOT_COPIED}
        if part["type"] == "array":
            schema["items"] = plain(part["items"])
        return schema

    package = "foxglove" if kind in FOXGLOVE else "phil"
    return f"{package}.{name}", msgspec.json.encode(plain(parts[name]))


class ViewerCopies:
    """Makes copies that viewers can draw, and hands each to ``add``. Not thread-safe."""

    def __init__(self, add: Callable[[str, Schema, int, bytes], None]) -> None:
        self._add = add
        self._layouts: dict[str, Layout | None] = {}  # By the vehicle, as its scenes say

    def write(self, heard: Heard) -> None:
        if heard.topic in TOKEN_TOPICS:
            who = "edge runtime" if heard.topic == "alive" else "simulator"
            what = "is here" if heard.payload == b"\x01" else "has gone"
            self._event(heard, INFO, f"{who} {what}")
            return
        if not heard.is_whole:
            self._event(heard, WARNING, f"{heard.topic} of {heard.size} bytes, not kept")
            return
        message = decode(heard)
        if isinstance(message, wire.Rejection):
            self._event(heard, WARNING, f"unreadable {heard.topic}: {message.detail}")
            return
        self._copy(heard, heard.topic, message)
        if isinstance(message, Scene):
            self._layouts[heard.vehicle_id] = Layout(message.task) if message.task else None
            self._copy_road(heard, message)
        elif isinstance(message, wire.State) and (layout := self._layouts.get(heard.vehicle_id)):
            self._copy_images(heard, message, layout)

    def _copy_road(self, heard: Heard, scene: Scene) -> None:
        now = _stamp(heard)
        if scene.roads or scene.vehicles:
            self._copy(heard, "road", draw_road(scene, now))
        for ego in (car for car in scene.vehicles if car.ego):
            where = Vector(ego.x, -ego.y, 0.0)
            self._copy(heard, "ego", FrameTransform(now, ROAD_FRAME, EGO_FRAME, where))

    def _copy_images(self, heard: Heard, state: wire.State, layout: Layout) -> None:
        if layout.refusal(state.observation) is not None:
            return
        for name, array in layout.arrays(state.observation).items():
            if not messages.is_picture(array):
                continue
            # Consecutive images are, in memory, one picture with `count` times the height.
            images = messages.images_of(array)
            count, height, width, colours = images.shape
            encoding = "rgb8" if colours == 3 else "mono8"
            size = (width, count * height, encoding, width * colours)
            image = RawImage(_stamp(heard), *size, images.tobytes(), heard.vehicle_id)
            self._copy(heard, name, image)

    def _event(self, heard: Heard, level: int, text: str) -> None:
        self._copy(heard, "events", Log(_stamp(heard), level, text, heard.vehicle_id))

    def _copy(self, heard: Heard, name: str, values: msgspec.Struct) -> None:
        fields = msgspec.structs.asdict(values).items()
        unknown = (None, msgspec.UNSET)
        drawn = {n: v for n, v in fields if n not in NOT_COPIED and v not in unknown}
        topic, data = f"view/{heard.vehicle_id}/{name}", msgspec.json.encode(drawn)
        self._add(topic, describe(type(values)), heard.arrived_ns, data)


def _stamp(heard: Heard) -> Any:
    return Stamp(*divmod(heard.arrived_ns, 10**9))
