"""Read MCAP recordings, also those cut off by a kill or a full disk, and damaged ones.

A chunk has a checksum: one that does not match is left out and counted. Where even the length of a
record is broken, reading goes on at the next chunk, which is searched byte by byte.

Anybody may have made the file. The size that a chunk announces is checked before it is unpacked,
and the work of reading is limited by the length of the file.
"""

from __future__ import annotations

import os
import re
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from bridge.messages import DECODERS, Heard, decode
from edge_runtime.util import UserError, counted, open_regular
from edge_runtime.wire import Rejection

WIRE_ENCODING = "msgpack"
METADATA = "phil"
MAX_RECORD_BYTES = 8 << 20
"""Of a record, and of a chunk when it is unpacked; ours hold little more than 5 MiB."""
MAX_WORK = 200
"""Bytes read for each byte of the file, above one record."""
RECORD_BYTES = 256
"""Work that a record in a chunk counts as, however empty it is."""
TORN = (
    McapError, struct.error, zstandard.ZstdError, ValueError, KeyError, RuntimeError, OverflowError,
    MemoryError,
)  # fmt: skip
"""Exceptions of the libraries for bytes that are no MCAP."""
LANDMARK = re.compile(
    rb"\x06(?=.{4}\x00{4}.{28}\x04\x00{3}zstd)"  # a chunk as we write it
    rb"|\x0c(?=.{4}\x00{4}\x04\x00{3}phil)"  # our metadata
    rb"|\x02(?=\x14\x00{7}.{20}\x89MCAP0\r\n)",  # the footer
    re.DOTALL,
)
"""First bytes of records that can be recognised without knowing where the one before ends."""
LANDMARK_BYTES = 45
BLOCK_BYTES = 1 << 16


class Recording:
    """One MCAP file; what is missing of it is known once ``messages`` has come to the end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.invalid_messages = 0  # Of the last pass of `valid_messages`
        self._begin()

    def _begin(self) -> None:
        self.metadata: dict[str, str] = {}
        self.cut_off = False
        """The file ends without its index, between two records or within a record: a kill."""
        self.torn_bytes = 0  # Of the record within which the file stops
        self.damaged_places = 0
        self.damaged_bytes = 0
        self.nameless_messages = 0  # Whole ones whose topic stood in a broken part alone
        self._work_bytes = 0

    @property
    def is_damaged(self) -> bool:
        """Whether more is amiss than a kill leaves behind."""
        return self.damaged_places > 0 or self.nameless_messages > 0

    def trouble(self) -> str:
        """Return what is wrong with the file, as a verb with its object; empty: nothing."""
        if not (self.is_damaged or self.cut_off):
            return ""
        lost = counted(self.damaged_bytes + self.torn_bytes, "byte")
        what = "was cut off"
        if self.is_damaged:
            what = f"has {counted(self.damaged_places, 'damaged place')}"
        return f"{what} ({lost} and {counted(self.nameless_messages, 'message')} lost)"

    def say_trouble(self, taken: str = "") -> None:
        """Print the trouble, if any, in one line on stderr, with how much is taken."""
        if trouble := self.trouble():
            line = f"the recording {self.path} {trouble}; what is whole of it is taken"
            print(line + taken, file=sys.stderr, flush=True)

    def say_missing(self) -> None:
        """Say on stderr what `valid_messages` could not read, and what it left out."""
        self.say_trouble()
        if self.invalid_messages:
            left_out = f"left out: {counted(self.invalid_messages, 'message')} not valid"
            print(f"{self.path}: {left_out}", file=sys.stderr, flush=True)

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages, with their channels, in the order of the file, that of arrival.

        UserError for a file that is not there, cannot be read, is no MCAP at all, or takes more
        reading than its size accounts for.
        """
        channels: dict[int, Channel] = {}
        has_looked = False
        for record in self._records():
            if isinstance(record, Metadata):
                self.metadata |= record.metadata
            elif isinstance(record, Channel):
                # The first of an id counts: it is from a chunk, which has a checksum.
                channels.setdefault(record.id, record)
            elif isinstance(record, Message):
                if record.channel_id not in channels and not has_looked:
                    # The chunk that named it is broken; the index at the end repeats all names.
                    has_looked = True
                    for other in Recording(self.path)._records():
                        if isinstance(other, Channel):
                            channels.setdefault(other.id, other)
                if channel := channels.get(record.channel_id):
                    yield channel, record
                else:
                    self.nameless_messages += 1

    def _records(self) -> Iterator[McapRecord]:
        """Yield every record that can be read, a chunk as what it holds."""
        self._begin()
        try:
            with open_regular(self.path) as stream:
                begins = stream.read(MAGIC_SIZE) == MCAP0_MAGIC
                self._size = stream.seek(0, os.SEEK_END)
                stream.seek(max(0, self._size - MAGIC_SIZE))
                self.cut_off = stream.read(MAGIC_SIZE) != MCAP0_MAGIC
                if self._size <= MAGIC_SIZE or (self.cut_off and not begins):
                    raise UserError(f"{self.path} is no MCAP recording")
                yield from self._walk(stream)
        except OSError as error:
            raise UserError(f"recording {self.path} cannot be read: {error.strerror}") from None

    def _walk(self, stream: BinaryIO) -> Iterator[McapRecord]:
        at = MAGIC_SIZE
        while at < self._size:
            stream.seek(at)
            reader = StreamReader(stream, True, True, record_size_limit=MAX_RECORD_BYTES)
            try:
                for record in reader.records:
                    end = stream.tell()
                    stream.seek(at + 1)
                    said = 9 + int.from_bytes(stream.read(8), "little")
                    stream.seek(end)
                    parts = _parts(record, end - at, said)
                    self._spend(RECORD_BYTES * len(parts))
                    at = end
                    yield from parts
                    if isinstance(record, Footer):
                        self.cut_off = False
                        return
            except TORN:
                if at >= self._size:  # It ends between two records.
                    return
                read_to = stream.tell()
                self._spend(read_to - at + BLOCK_BYTES)
                end = _find_landmark(stream, at + 1)
                if self.cut_off and min(read_to, end) >= self._size:
                    self.torn_bytes = end - at
                else:
                    self.damaged_places += 1
                    self.damaged_bytes += end - at
                at = end

    def _spend(self, count: int) -> None:
        """Count the bytes read; UserError for more than damage explains."""
        self._work_bytes += count
        if self._work_bytes > MAX_RECORD_BYTES + MAX_WORK * self._size:
            what = f"reading it takes more than {MAX_WORK} times its size"
            raise UserError(f"recording {self.path} is refused: {what}")


def _parts(record: McapRecord, size: int, said: int) -> list[McapRecord]:
    """Return a record that took ``size`` bytes and announced ``said``; a chunk as its contents.

    Raises one of TORN if it is not whole.
    """
    builder = RecordBuilder()
    record.write(builder)
    # The library reads on over lengths that do not fit, or skips some.
    if not builder.count == size == said:
        raise ValueError("a record of another length than it says")
    if not isinstance(record, Chunk):
        return [] if isinstance(record, Message) else [record]  # No checksum is over that one.
    size = zstandard.frame_content_size(record.data) if record.compression else len(record.data)
    # -1: the data do not say. They are then unpacked up to what the chunk says.
    if size not in (-1, record.uncompressed_size) or record.uncompressed_size > MAX_RECORD_BYTES:
        raise ValueError(f"a chunk of {record.uncompressed_size} bytes")
    return breakup_chunk(record, validate_crc=True)


def _find_landmark(stream: BinaryIO, at: int) -> int:
    """Return where the next record begins that can be recognised, or the file's end."""
    while True:
        stream.seek(at)
        block = stream.read(BLOCK_BYTES + LANDMARK_BYTES)
        if match := LANDMARK.search(block):
            return at + match.start()
        if len(block) < BLOCK_BYTES + LANDMARK_BYTES:
            return at + len(block)
        at += BLOCK_BYTES


def choose_vehicle(recording: Recording, vehicle_id: str | None) -> str:
    """Return the vehicle of that id, or the only vehicle; UserError where that fails."""
    there = {_wire_topic(channel)[0] for channel, _ in recording.messages()} - {""}
    names = ", ".join(sorted(there)) or "none"
    if vehicle_id is not None and vehicle_id not in there:
        raise UserError(f"{recording.path} holds no vehicle {vehicle_id} (vehicles in it: {names})")
    if vehicle_id is None and len(there) != 1:
        raise UserError(f"{recording.path} holds vehicles {names}; name one with --vehicle-id")
    return vehicle_id or there.pop()


def heard_of(recording: Recording, vehicle_id: str) -> Iterator[Heard]:
    """Yield the wire's messages of one vehicle as a listener would have heard them."""
    for channel, message in recording.messages():
        vehicle, topic = _wire_topic(channel)
        if vehicle == vehicle_id:
            data = message.data
            yield Heard(channel.topic, topic, data, message.log_time, len(data))


def valid_messages(recording: Recording, vehicle_id: str) -> Iterator[tuple[Heard, Any]]:
    """Yield a vehicle's messages, heard and decoded; the invalid are left out and counted."""
    recording.invalid_messages = 0
    for heard in heard_of(recording, vehicle_id):
        if heard.topic in DECODERS:
            message = decode(heard)
            if isinstance(message, Rejection):
                recording.invalid_messages += 1
            else:
                yield heard, message


def _wire_topic(channel: Channel) -> tuple[str, str]:
    """Return vehicle and topic of a wire message; empty for a copy for viewers."""
    parts = channel.topic.split("/")
    if channel.message_encoding != WIRE_ENCODING or len(parts) != 3:
        return "", ""
    return parts[1], parts[2]
