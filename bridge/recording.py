"""Reads MCAP recordings: whole ones, ones that a kill or a full disk has cut off, and damaged ones.

`Recording` walks any MCAP file record by record, and over the places in it that are broken. A chunk
has a checksum, so one that is read is as it was written; of the rest, the header and the index of
each chunk included, the checksum at the end of the data says so. Behind a broken record the next
one is where the record's length says; where no record begins there, the length is broken, too, and
the next whole chunk is looked for byte by byte.

Anybody may have made the file. What a chunk announces is looked at before it is unpacked, and
reading is limited by the length of the file.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from bridge.messages import Heard
from edge_runtime.util import UserError, counted, open_regular

WIRE_ENCODING = "msgpack"
METADATA = "phil"
MAX_RECORD_BYTES = 64 << 20
"""A torn length must not ask for more memory than any record of ours needs."""
MAX_CHUNK_BYTES = 8 << 20  # Unpacked; ours hold little more than 1 MiB
MAX_WORK = 200
"""Bytes read for each byte of the file, above one chunk."""
RECORD_BYTES = 256
"""What a record in a chunk counts as: taking it apart costs as much, however empty it is."""
TORN = (
    McapError, struct.error, zstandard.ZstdError, ValueError, KeyError, RuntimeError, OverflowError,
    MemoryError,
)  # fmt: skip
"""What the libraries raise for bytes that are no MCAP."""
LANDMARK = re.compile(
    rb"\x06(?=.{4}\x00{4}.{28}\x04\x00{3}zstd)"  # a chunk as we write it
    rb"|\x0c(?=.{4}\x00{4}\x04\x00{3}phil)"  # our metadata
    rb"|\x0f(?=\x04\x00{7})"  # the end of the data
    rb"|\x02(?=\x14\x00{7})",  # the footer
    re.DOTALL,
)
"""First bytes of records that can be recognised without knowing where the one before ends."""
LANDMARK_BYTES = 45
BLOCK_BYTES = 1 << 16
_HEAD = struct.Struct("<BQ")
_CRC_BYTES = 4


class Stored(NamedTuple):
    """One message of a recording."""

    channel: Channel
    schema: Schema | None
    message: Message


@dataclass
class Condition:
    """What is missing of a recording, known when all of it has been read."""

    cut_off: bool = False
    """The file ends without its index, between two records or within one: its writer was killed."""
    damaged_places: int = 0  # Broken parts before the end; all that is whole between them is read
    damaged_bytes: int = 0
    torn_bytes: int = 0  # Of the record within which the file stops
    nameless_messages: int = 0  # Whole ones whose topic stood in a broken part alone
    is_altered: bool = False  # The checksum over the data is wrong, though nothing in it is broken
    has_checksums: bool = False
    """Over all of the data and over the index: nothing could change without being noticed."""

    @property
    def is_damaged(self) -> bool:
        """Whether more is amiss than a kill leaves behind."""
        return self.damaged_places > 0 or self.nameless_messages > 0 or self.is_altered

    def missing(self) -> str:
        """Say what could not be read; empty where all of the file could."""
        places = counted(self.damaged_places, "damaged place")
        messages = counted(self.nameless_messages, "message")
        parts = {
            f"{places} of {counted(self.damaged_bytes, 'byte')}": self.damaged_places,
            "bytes that changed outside of its chunks": self.is_altered,
            f"{messages} whose topic was in a damaged place": self.nameless_messages,
            f"a torn end of {counted(self.torn_bytes, 'byte')}": self.torn_bytes,
        }
        return ", ".join(part for part, is_so in parts.items() if is_so)

    def trouble(self) -> str:
        """Say what is wrong with the file, as a verb with its object; empty: nothing."""
        if self.is_damaged:
            return f"is damaged ({self.missing()})"
        return "was cut off" if self.cut_off else ""


class Recording(Condition):
    """One MCAP file; its condition is known when ``messages`` or ``records`` came to the end.

    One pass at a time: a new one ends the one before.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.metadata: dict[str, str] = {}

    def messages(self) -> Iterator[Stored]:
        """Yield the messages as they stand in the file, which is the order of their arrival.

        UserError as ``records``.
        """
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}

        def learn(record: McapRecord) -> None:
            # The first definition of an id counts: it is from a chunk, which has a checksum.
            if isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                channels.setdefault(record.id, record)

        has_looked = False
        for record in self.records():
            learn(record)
            if isinstance(record, Metadata):
                self.metadata |= record.metadata
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if not has_looked and (channel is None or channel.schema_id not in (0, *schemas)):
                    # The chunk that named it is broken; the index at the end repeats all names.
                    has_looked = True
                    for other in Recording(self.path).records():
                        learn(other)
                    channel = channels.get(record.channel_id)
                if channel is None:
                    self.nameless_messages += 1
                else:
                    yield Stored(channel, schemas.get(channel.schema_id), record)

    def records(self) -> Iterator[McapRecord]:
        """Yield every record that can be read, a chunk as what it holds.

        UserError for a file that is not there, cannot be read, is no MCAP at all, or takes more
        reading than its size accounts for.
        """
        vars(self).update(vars(Condition()), metadata={})
        self._has_ended, self._read_bytes = False, 0
        try:
            with open_regular(self.path) as self._stream:
                self._size = self._stream.seek(0, os.SEEK_END)
                last = self._size - MAGIC_SIZE
                ends = (self._bytes(0, MAGIC_SIZE), self._bytes(last, MAGIC_SIZE))
                if MCAP0_MAGIC not in ends or last <= 0:
                    raise UserError(f"{self.path} is no MCAP recording")
                yield from self._walk()
        except OSError as error:
            raise UserError(f"recording {self.path} cannot be read: {error.strerror}") from None

    def _walk(self) -> Iterator[McapRecord]:
        at = MAGIC_SIZE
        while at < self._size and not self._has_ended:
            found = self._read(at)
            if found is None:
                at = self._pass_over(at)
                continue
            parts, end = found
            for part in parts[:1]:  # DataEnd and Footer never stand inside a chunk.
                self._note_end(part, at)
            at = end
            self.cut_off = at >= self._size and not self._has_ended
            yield from parts

    def _note_end(self, record: McapRecord, at: int) -> None:
        """Note the end of the data, with its checksum, and that of the file."""
        if isinstance(record, DataEnd):
            wanted = record.data_section_crc
            self.has_checksums = wanted != 0
            # In a damaged place, the difference is known already.
            if wanted and not self.damaged_places:
                self.is_altered = self._crc32(0, at) != wanted
        if isinstance(record, Footer):
            self.has_checksums &= record.summary_crc != 0
            self._has_ended = True

    def _pass_over(self, at: int) -> int:
        """Count what is broken there; return where the next record begins, or the file's end."""
        end = self._end(at)
        if end is not None and end < self._size and self._read(end) is not None:
            next_at = end
        else:
            next_at = self._scan(at + 1)
        if end is None and next_at == self._size and self._is_begun(at):
            self.cut_off, self.torn_bytes = True, self._size - at
        else:
            self.damaged_places += 1
            self.damaged_bytes += next_at - at
        return next_at

    def _scan(self, at: int) -> int:
        while at < self._size:
            block = self._bytes(at, BLOCK_BYTES + LANDMARK_BYTES)
            for match in LANDMARK.finditer(block):
                if self._read(at + match.start()) is not None:
                    return at + match.start()
            at += BLOCK_BYTES
        return self._size

    def _read(self, at: int) -> tuple[list[McapRecord], int] | None:
        """The record there, a chunk as what it holds, and its end; None: it is not whole."""
        end = self._end(at)
        if end is None:
            return None
        data = self._bytes(at, end - at)
        try:
            record = next(StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records)
            # The library reads on over lengths inside of a record that do not fit.
            if _written(record) != data:
                return None
            parts = self._unpack(record) if isinstance(record, Chunk) else [record]
        except TORN:
            return None
        if isinstance(record, Footer) and not self._has_its_index(record, at):
            return None
        return parts, end

    def _end(self, at: int) -> int | None:
        """Where the record that begins there ends by its length; None: not within the file."""
        head = self._bytes(at, _HEAD.size)
        if len(head) < _HEAD.size:
            return None
        opcode, length = _HEAD.unpack(head)
        # The closing magic belongs to the footer: one without the other is no end.
        end: int = at + _HEAD.size + length + (MAGIC_SIZE if opcode == Opcode.FOOTER else 0)
        return end if length <= MAX_RECORD_BYTES and end <= self._size else None

    def _is_begun(self, at: int) -> bool:
        """Whether the file ends within a record of a likely length."""
        head = self._bytes(at, _HEAD.size)
        return len(head) < _HEAD.size or int(_HEAD.unpack(head)[1]) <= MAX_RECORD_BYTES

    def _has_its_index(self, footer: Footer, at: int) -> bool:
        """Whether the footer's checksum is that of the index before it."""
        index_crc = self._crc32(footer.summary_start or at, at)
        crc = zlib.crc32(_written(footer)[: -MAGIC_SIZE - _CRC_BYTES], index_crc)
        return footer.summary_crc in (0, crc)

    def _unpack(self, chunk: Chunk) -> list[McapRecord]:
        """What a chunk holds; one of the TORN where it does not hold what it announces."""
        size = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
        # -1: the data do not say. They are then unpacked up to what the chunk says.
        if size not in (-1, chunk.uncompressed_size) or chunk.uncompressed_size > MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
        parts = breakup_chunk(chunk, validate_crc=True)
        self._read_bytes += RECORD_BYTES * len(parts)
        return parts

    def _crc32(self, start: int, end: int) -> int:
        crc = 0
        for at in range(start, end, BLOCK_BYTES):
            crc = zlib.crc32(self._bytes(at, min(BLOCK_BYTES, end - at)), crc)
        return crc

    def _bytes(self, at: int, count: int) -> bytes:
        """Those bytes, fewer at the file's end; UserError for more reading than damage explains."""
        self._stream.seek(max(0, at))
        data = self._stream.read(max(0, min(count, self._size - at)))
        self._read_bytes += len(data)
        if self._read_bytes > MAX_CHUNK_BYTES + MAX_WORK * self._size:
            raise UserError(
                f"recording {self.path} is refused: reading it takes more than"
                f" {MAX_WORK} times its size"
            )
        return data


def _written(record: McapRecord) -> bytes:
    """The record as the library writes it; a footer with the magic that must follow."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end() + (MCAP0_MAGIC if isinstance(record, Footer) else b"")


def choose_vehicle(recording: Recording, vehicle_id: str | None) -> str:
    """The vehicle of that id, or the only one; UserError where it is not in the recording."""
    there = {vehicle for vehicle, _ in map(_wire_topic, recording.messages()) if vehicle}
    names = ", ".join(sorted(there)) or "none"
    if vehicle_id is not None and vehicle_id not in there:
        raise UserError(f"{recording.path} holds no vehicle {vehicle_id} (vehicles in it: {names})")
    if vehicle_id is None and len(there) != 1:
        raise UserError(f"{recording.path} holds vehicles {names}; name one with --vehicle-id")
    return vehicle_id or there.pop()


def heard_of(recording: Recording, vehicle_id: str) -> Iterator[Heard]:
    """The wire's messages of one vehicle as a listener would have heard them, in their order.

    The recording may be cut off or damaged, and says so afterwards.
    """
    for stored in recording.messages():
        vehicle, topic = _wire_topic(stored)
        if vehicle == vehicle_id:
            message, key = stored.message, stored.channel.topic
            yield Heard(key, topic, message.data, message.log_time, len(message.data))


def _wire_topic(stored: Stored) -> tuple[str, str]:
    """The vehicle and the topic of a wire message; empty for a copy for viewers."""
    parts = stored.channel.topic.split("/")
    if stored.channel.message_encoding != WIRE_ENCODING or len(parts) != 3:
        return "", ""
    return parts[1], parts[2]
