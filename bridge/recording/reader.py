"""Reads recordings: whole ones, ones that a kill or a full disk has cut off, and damaged ones."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from mcap.records import Channel, McapRecord, Message, Metadata, Schema

from edge_runtime.util import UserError, counted
from viewing.records import Records


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
        self.is_altered = False
        """The checksum over the data is wrong, though nothing in it is broken."""
        self.has_checksums = False
        """Nothing could change without being noticed."""
        self.metadata: dict[str, str] = {}

    @property
    def is_damaged(self) -> bool:
        """Whether more is amiss than a kill leaves behind."""
        return self.damaged_places > 0 or self.nameless_messages > 0 or self.is_altered

    def messages(self) -> Iterator[Stored]:
        """Yield the messages as they stand in the file, which is the order of their arrival.

        UserError for a file that is not there, cannot be read, is no MCAP at all, or takes more
        work than its size accounts for.
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
            places = counted(self.damaged_places, "damaged place")
            parts.append(f"{places} of {counted(self.damaged_bytes, 'byte')}")
        if self.is_altered:
            parts.append("bytes that changed outside of its chunks")
        if self.nameless_messages:
            messages = counted(self.nameless_messages, "message")
            parts.append(f"{messages} whose topic was in a damaged place")
        if self.torn_bytes:
            parts.append(f"a torn end of {counted(self.torn_bytes, 'byte')}")
        return ", ".join(parts)

    def trouble(self) -> str:
        """Say what is wrong with the file, as a verb with its object; empty: nothing."""
        if self.is_damaged:
            return f"is damaged ({self.missing()})"
        return "was cut off" if self.cut_off else ""

    def _read(self, records: Records) -> Iterator[Stored]:
        if not records.is_mcap():
            raise UserError(f"{self.path} is no MCAP recording")
        names = _Names(records)
        for record in records.walk():
            if isinstance(record, Schema | Channel):
                names.learn(record)
            elif isinstance(record, Metadata):
                self.metadata |= record.metadata
            elif isinstance(record, Message):
                stored = names.name(record)
                if stored is None:
                    self.nameless_messages += 1
                else:
                    yield stored
        self.cut_off = records.is_cut_off
        self.damaged_places = records.damaged_places
        self.damaged_bytes = records.damaged_bytes
        self.torn_bytes = records.torn_bytes
        self.is_altered = records.is_altered
        self.has_checksums = records.has_checksums


def _open(path: Path) -> IO[bytes]:
    """Open a file to go back and forth in; a pipe would be waited for."""
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise UserError(f"recording {path} cannot be read: it is no regular file")
    return path.open("rb")


class _Names:
    """What the channels are called, as far as the file has been read."""

    def __init__(self, records: Records) -> None:
        self._records = records
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._has_looked = False

    def learn(self, record: McapRecord) -> None:
        """Take a schema or a channel; of two the first, which is from a chunk with a checksum."""
        if isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self._channels.setdefault(record.id, record)

    def name(self, message: Message) -> Stored | None:
        """Find out what the message is; None where the file does not say."""
        if not self._knows(message.channel_id) and not self._has_looked:
            # The chunk that said so is broken: the index may.
            self._has_looked = True
            for record in self._records.names():
                self.learn(record)
        channel = self._channels.get(message.channel_id)
        if channel is None:
            return None
        return Stored(channel, self._schemas.get(channel.schema_id), message)

    def _knows(self, channel_id: int) -> bool:
        channel = self._channels.get(channel_id)
        return channel is not None and channel.schema_id in (0, *self._schemas)
