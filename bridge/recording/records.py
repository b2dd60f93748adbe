"""Walks an MCAP file record by record, and over the places in it that are broken.

A chunk has a checksum, so one that is read is as it was written. Behind a broken record the next
one is where the record's length says; where no record begins there, the length is broken, too,
and the next whole chunk is looked for byte by byte.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import IO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, McapRecord, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

MAX_RECORD_BYTES = 64 << 20
"""A torn length must not ask for more memory than any chunk of ours needs."""
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
"""How what can be found by itself begins."""
LANDMARK_BYTES = 45
SCAN_BYTES = 1 << 20
_HEAD = struct.Struct("<BQ")
_CRC_BYTES = 4


class Records:
    """The records of a file of ``size`` bytes; what is missing is known after ``walk``."""

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self._stream = stream
        self._size = size
        self.is_complete = False
        """The end was there."""
        self.is_cut_off = False
        """The file stops between two records, or within one: its writer was killed."""
        self.damaged_places = 0
        self.damaged_bytes = 0
        self.torn_bytes = 0
        """Of the record within which the file stops."""

    def is_mcap(self) -> bool:
        """Whether it begins or ends like an MCAP file, and has more than that."""
        ends = (self._bytes(0, MAGIC_SIZE), self._bytes(self._size - MAGIC_SIZE, MAGIC_SIZE))
        return MCAP0_MAGIC in ends and self._size > MAGIC_SIZE

    def walk(self) -> Iterator[McapRecord]:
        """Yield every record that can be read, a chunk as what it holds."""
        at = MAGIC_SIZE
        while at < self._size and not self.is_complete:
            found = self._read(at)
            if found is None:
                at = self._pass_over(at)
                continue
            parts, at = found
            self.is_complete = any(isinstance(part, Footer) for part in parts)
            self.is_cut_off = at >= self._size and not self.is_complete
            yield from parts

    def names(self) -> Iterator[McapRecord]:
        """Yield every schema and channel of the file; the index repeats them all at its end."""
        for record in Records(self._stream, self._size).walk():
            if isinstance(record, Schema | Channel):
                yield record

    def _pass_over(self, at: int) -> int:
        """Count what is broken there; return where the next record begins, or the file's end."""
        end = self._end(at)
        if end is not None and end < self._size and self._read(end) is not None:
            next_at = end
        else:
            next_at = self._scan(at + 1)
        if end is None and next_at == self._size and self._is_begun(at):
            self.is_cut_off, self.torn_bytes = True, self._size - at
        else:
            self.damaged_places += 1
            self.damaged_bytes += next_at - at
        return next_at

    def _scan(self, at: int) -> int:
        while at < self._size:
            block = self._bytes(at, SCAN_BYTES + LANDMARK_BYTES)
            for match in LANDMARK.finditer(block):
                if self._read(at + match.start()) is not None:
                    return at + match.start()
            at += SCAN_BYTES
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
            parts = breakup_chunk(record, True) if isinstance(record, Chunk) else [record]
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
        start = footer.summary_start or at
        index = self._bytes(start, at - start)
        crc = zlib.crc32(_written(footer)[: -MAGIC_SIZE - _CRC_BYTES], zlib.crc32(index))
        return footer.summary_crc in (0, crc)

    def _bytes(self, at: int, count: int) -> bytes:
        """Those bytes, fewer at the file's end."""
        self._stream.seek(max(0, at))
        return self._stream.read(max(0, min(count, self._size - at)))


def _written(record: McapRecord) -> bytes:
    """The record as the library writes it; a footer with the magic that must follow."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end() + (MCAP0_MAGIC if isinstance(record, Footer) else b"")
