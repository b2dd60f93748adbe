"""Walks an MCAP file record by record, and over the places in it that are broken.

A chunk has a checksum, so one that is read is as it was written; of the rest, the header and the
index of each chunk included, the checksum at the end of the data says so. Behind a broken record
the next one is where the record's length says; where no record begins there, the length is broken,
too, and the next whole chunk is looked for byte by byte.

Anybody may have made the file. What a chunk announces is looked at before it is unpacked, and the
whole work is limited by the length of the file.
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
from mcap.records import Channel, Chunk, DataEnd, Footer, McapRecord, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from edge_runtime.util import UserError

MAX_RECORD_BYTES = 64 << 20
"""A torn length must not ask for more memory than any record of ours needs."""
MAX_CHUNK_BYTES = 8 << 20
"""Unpacked; ours hold little more than 1 MiB."""
MAX_WORK = 200
"""Bytes read and unpacked for each byte of the file, above one chunk. The recording of a car that
stands still for an hour comes to 100: every picture in it is the same."""
RECORD_BYTES = 256
"""What a record counts besides its bytes: taking it apart costs as much, however empty it is."""
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
BLOCK_BYTES = 1 << 16
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
        self.is_altered = False
        """By the checksum over the data, bytes changed that are in no damaged place."""
        self.has_checksums = False
        """Over all of the data and over the index."""
        self._spent_bytes = 0

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
            parts, end = found
            for part in parts[:1]:  # Neither end is within a chunk.
                self._note_end(part, at)
            at = end
            self.is_cut_off = at >= self._size and not self.is_complete
            yield from parts

    def names(self) -> Iterator[McapRecord]:
        """Yield every schema and channel of the file; the index repeats them all at its end."""
        for record in Records(self._stream, self._size).walk():
            if isinstance(record, Schema | Channel):
                yield record

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
            self.is_complete = True

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
            block = self._bytes(at, BLOCK_BYTES + LANDMARK_BYTES)
            self._spend(len(block), at)
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
        self._spend(end - at, end)
        data = self._bytes(at, end - at)
        try:
            record = next(StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records)
            # The library reads on over lengths inside of a record that do not fit.
            if _written(record) != data:
                return None
            parts = self._unpack(record, end) if isinstance(record, Chunk) else [record]
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

    def _unpack(self, chunk: Chunk, end: int) -> list[McapRecord]:
        """What a chunk holds; one of the TORN where it does not hold what it announces."""
        size = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
        # -1: the data do not say. They are then unpacked up to what the chunk says.
        if size not in (-1, chunk.uncompressed_size) or chunk.uncompressed_size > MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
        self._spend(chunk.uncompressed_size, end)
        parts = breakup_chunk(chunk, validate_crc=True)
        self._spend(RECORD_BYTES * len(parts), end)
        return parts

    def _crc32(self, start: int, end: int) -> int:
        self._spend(max(0, end - start), end)
        crc = 0
        for at in range(start, end, BLOCK_BYTES):
            crc = zlib.crc32(self._bytes(at, min(BLOCK_BYTES, end - at)), crc)
        return crc

    def _spend(self, count: int, at: int) -> None:
        """Count bytes to be read or unpacked, up to that place of the file.

        UserError where they are out of proportion: damage does not do that.
        """
        self._spent_bytes += count
        if self._spent_bytes > MAX_CHUNK_BYTES + MAX_WORK * at:
            raise UserError(
                f"recording {self._stream.name} is refused: reading it takes more than"
                f" {MAX_WORK} times its size"
            )

    def _bytes(self, at: int, count: int) -> bytes:
        """Those bytes, fewer at the file's end."""
        self._stream.seek(max(0, at))
        return self._stream.read(max(0, min(count, self._size - at)))


def _written(record: McapRecord) -> bytes:
    """The record as the library writes it; a footer with the magic that must follow."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end() + (MCAP0_MAGIC if isinstance(record, Footer) else b"")
