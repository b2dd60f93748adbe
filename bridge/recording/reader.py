"""Reads recordings: whole ones, ones that a kill or a full disk has cut off, and damaged ones."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from mcap.records import Channel, McapRecord, Message, Metadata, Schema

from bridge.recording.records import Records
from edge_runtime.errors import UserError


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
        self.damaged_places = 0
        """Broken parts before the end; all that is whole between them is read."""
        self.damaged_bytes = 0
        self.torn_bytes = 0
        """Of what was being written when the file was cut off."""
        self.nameless_messages = 0
        """Whole ones whose topic stood in a broken part alone."""
        self.metadata: dict[str, str] = {}

    @property
    def is_damaged(self) -> bool:
        """Whether more is amiss than a kill leaves behind."""
        return self.damaged_places > 0 or self.nameless_messages > 0

    def messages(self) -> Iterator[Stored]:
        """Yield the messages as they stand in the file, which is the order of their arrival.

        UserError for a file that is not there, cannot be read, or is no MCAP at all.
        """
        self.cut_off, self.nameless_messages, self.metadata = True, 0, {}
        try:
            with _open(self.path) as stream:
                yield from self._read(Records(stream, os.fstat(stream.fileno()).st_size))
        except OSError as error:
            raise UserError(f"recording {self.path} cannot be read: {error.strerror}") from None

    def missing(self) -> str:
        """Say what could not be read; empty where all of the file could."""
        parts = []
        if self.damaged_places:
            places = "place" if self.damaged_places == 1 else "places"
            parts.append(f"{self.damaged_places} damaged {places} of {self.damaged_bytes} bytes")
        if self.nameless_messages:
            parts.append(f"{self.nameless_messages} messages whose topic was in a damaged place")
        if self.torn_bytes:
            parts.append(f"a torn end of {self.torn_bytes} bytes")
        return ", ".join(parts)

    def trouble(self) -> str:
        """Say what is wrong with the file, as a verb with its object; empty: nothing."""
        if self.is_damaged:
            return f"is damaged ({self.missing()})"
        return "was cut off" if self.cut_off else ""

    def _read(self, records: Records) -> Iterator[Stored]:
        if not records.is_mcap():
            raise UserError(f"{self.path} is no MCAP recording")
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        # The index repeats every name: the chunk in which a name stood first may be broken.
        for record in records.summary():
            _learn(record, schemas, channels)
        for record in records.walk():
            _learn(record, schemas, channels)
            if isinstance(record, Metadata):
                self.metadata |= record.metadata
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    self.nameless_messages += 1
                else:
                    yield Stored(channel, schemas.get(channel.schema_id), record)
        self.cut_off = records.is_cut_off
        self.damaged_places = records.damaged_places
        self.damaged_bytes = records.damaged_bytes
        self.torn_bytes = records.torn_bytes


def _open(path: Path) -> IO[bytes]:
    """Open a file to go back and forth in; a pipe would be waited for."""
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise UserError(f"recording {path} cannot be read: it is no regular file")
    return path.open("rb")


def _learn(record: McapRecord, schemas: dict[int, Schema], channels: dict[int, Channel]) -> None:
    if isinstance(record, Schema):
        schemas[record.id] = record
    elif isinstance(record, Channel):
        channels[record.id] = record
