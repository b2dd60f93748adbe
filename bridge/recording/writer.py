"""What is heard, written as MCAP: the exact payloads for replay, and copies that viewers can draw.

| topic | encoding |
|---|---|
| ``phil/<id>/<topic>``, the keys of the wire | ``msgpack``: the payload as it was |
| ``phil/<id>/alive``, ``phil/<id>/simulator`` | ``json``: {"here": true}, or false |
| ``view/<id>/frames`` | ``foxglove.RawImage``: frame t-1 above frame t |
| ``view/<id>/<topic>``, of every topic of the wire | protobuf ``phil.State`` and so on |
| ``view/<id>/events`` | ``foxglove.Log``: tokens, unreadable and oversized messages |
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from bridge.feed import TOKEN_TOPICS, Heard
from bridge.messages import MESSAGES
from bridge.recording import protobuf
from bridge.recording.flushed_file import FlushedFile
from edge_runtime import __version__, wire

CHUNK_BYTES = 1 << 20
WIRE_ENCODING = "msgpack"
METADATA = "phil"
INFO, WARNING = 2, 3
"""Levels of foxglove.Log."""


class RecordingWriter:
    """Writes one recording; used by one thread. OSError from any call where the disk is full."""

    def __init__(self, path: Path) -> None:
        """Make the file; UserError where it exists already."""
        self.messages = 0
        self._file = FlushedFile(path)
        # Writer tells streams apart by their methods; its annotation names file types only.
        stream: Any = self._file
        self._mcap = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD, enable_data_crcs=True)
        self._mcap.start(profile="", library=f"phil-hil {__version__}")
        self._mcap.flush()  # Before anybody is told of the file, it is an MCAP file.
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, tuple[protobuf.Schema, int]] = {}
        self._counts: dict[str, int] = {}

    def write(self, heard: Heard, with_view: bool = True) -> None:
        """Add one message; ``with_view`` False leaves out the copy for viewers."""
        self.messages += 1
        vehicle_id = heard.key.split("/")[1]
        if heard.topic in TOKEN_TOPICS:
            here = heard.payload == b"\x01"
            text = b'{"here": true}' if here else b'{"here": false}'
            self._add(heard.key, "json", heard.arrived_ns, text)
            word = "is here" if here else "has gone"
            who = "edge runtime" if heard.topic == "alive" else "simulator"
            self._event(vehicle_id, heard.arrived_ns, INFO, f"{who} {word}")
            return
        if heard.size > len(heard.payload):
            text_of = f"{heard.topic} of {heard.size} bytes, not kept"
            self._event(vehicle_id, heard.arrived_ns, WARNING, text_of)
            return
        self._add(heard.key, WIRE_ENCODING, heard.arrived_ns, heard.payload)
        if with_view:
            self._view(vehicle_id, heard)

    def flush(self) -> None:
        """End the chunk: from here on a kill does not lose what has been written."""
        self._mcap.flush()

    def finish(self, dropped: int) -> None:
        """Write the index; ``dropped`` is how many messages came too fast to be written."""
        counts = {"messages": str(self.messages), "dropped": str(dropped)}
        self._mcap.flush()
        self._mcap.add_metadata(METADATA, counts)
        self._mcap.finish()
        self._file.flush()

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _view(self, vehicle_id: str, heard: Heard) -> None:
        kind, read = MESSAGES[heard.topic]
        message = read(heard.payload)
        if message is None or isinstance(message, wire.Rejection):
            why = message.detail if message else "not a scene"
            self._event(vehicle_id, heard.arrived_ns, WARNING, f"unreadable {heard.topic}: {why}")
            return
        schema, _ = self._schema(kind.__name__, lambda: protobuf.schema_of(kind))
        try:
            copy = protobuf.fill(schema.make(), message)
        except ValueError as error:  # The wire carries integers that protobuf's do not hold.
            text = f"{heard.topic} not drawn: {error}"
            self._event(vehicle_id, heard.arrived_ns, WARNING, text)
            return
        self._add_view(f"view/{vehicle_id}/{heard.topic}", schema.name, heard.arrived_ns, copy)
        if isinstance(message, wire.State):
            self._frames(vehicle_id, heard.arrived_ns, message)

    def _frames(self, vehicle_id: str, now_ns: int, state: wire.State) -> None:
        """Both frames lie one after the other: in memory that is one picture, twice as high."""
        schema, _ = self._schema("RawImage", protobuf.raw_image)
        count, height, width = wire.FRAMES_SHAPE
        image = schema.make(
            width=width,
            height=count * height,
            encoding="mono8",
            step=width,
            data=state.frames,
            frame_id=vehicle_id,
        )
        _stamp(image, now_ns)
        self._add_view(f"view/{vehicle_id}/frames", schema.name, now_ns, image)

    def _event(self, vehicle_id: str, now_ns: int, level: int, text: str) -> None:
        schema, _ = self._schema("Log", protobuf.log)
        entry = schema.make(level=level, message=text, name=vehicle_id)
        _stamp(entry, now_ns)
        self._add_view(f"view/{vehicle_id}/events", schema.name, now_ns, entry)

    def _add_view(self, topic: str, schema: str, now_ns: int, message: Any) -> None:
        _, schema_id = self._schemas[schema.rpartition(".")[2]]
        self._add(topic, "protobuf", now_ns, message.SerializeToString(), schema_id)

    def _add(self, topic: str, encoding: str, now_ns: int, data: bytes, schema_id: int = 0) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._mcap.register_channel(topic, encoding, schema_id)
        sequence = self._counts[topic] = self._counts.get(topic, 0) + 1
        self._mcap.add_message(self._channels[topic], now_ns, data, now_ns, sequence)

    def _schema(
        self, name: str, make: Callable[[], protobuf.Schema]
    ) -> tuple[protobuf.Schema, int]:
        if name not in self._schemas:
            schema = make()
            schema_id = self._mcap.register_schema(schema.name, "protobuf", schema.descriptors)
            self._schemas[name] = (schema, schema_id)
        return self._schemas[name]


def _stamp(message: Any, now_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(now_ns, 10**9)
