"""Reads recordings: whole ones, and ones that a kill or a full disk has cut off."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk

from edge_runtime.errors import UserError

MAX_RECORD_BYTES = 64 << 20
"""A torn length must not ask for more memory than any chunk of ours needs."""
TORN = (
    McapError, struct.error, zstandard.ZstdError, ValueError, KeyError, RuntimeError, OverflowError,
    MemoryError,
)  # fmt: skip
"""What the libraries raise for bytes that are no MCAP."""


class Stored(NamedTuple):
    """One message of a recording."""

    channel: Channel
    schema: Schema | None
    message: Message


class Recording:
    """One file; read it with ``messages``, after which the other fields are known."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut_off = False
        """The file ends without its index: what was written last may be lost."""
        self.metadata: dict[str, str] = {}

    def messages(self) -> Iterator[Stored]:
        """Yield the messages as they stand in the file, which is the order of their arrival.

        UserError for a file that is not there, or no MCAP at all.
        """
        self.cut_off, self.metadata = True, {}
        try:
            stream = self.path.open("rb")
        except OSError as error:
            raise UserError(f"recording {self.path} cannot be read: {error.strerror}") from None
        with stream:
            yield from self._read(stream)

    def _read(self, stream: IO[bytes]) -> Iterator[Stored]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._records(stream):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata):
                self.metadata |= record.metadata
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                yield Stored(channel, schemas.get(channel.schema_id), record)

    def _records(self, stream: IO[bytes]) -> Iterator[McapRecord]:
        """Yield every record up to the end, or up to where the file is torn."""
        reader = StreamReader(stream, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records
        while True:
            try:
                record = next(reader)
                parts = breakup_chunk(record, True) if isinstance(record, Chunk) else [record]
            except StopIteration:
                return
            except TORN:
                if stream.tell() <= MAGIC_SIZE:
                    raise UserError(f"{self.path} is no MCAP recording") from None
                return
            # The footer comes with the closing magic: only then is the file whole.
            self.cut_off = self.cut_off and not isinstance(record, Footer)
            yield from parts
