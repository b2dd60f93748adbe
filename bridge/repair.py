"""``python -m bridge repair``: save what is whole of a recording that was cut off or damaged."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bridge.record import check_new, start_mcap
from bridge.recording import METADATA, Recording
from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.files import behind_link, check_writable, try_to_lock_file, write_atomic
from edge_runtime.util import UserError, counted, open_regular

KEPT = ".damaged"
"""Ends the name under which a damaged recording is kept beside the repaired one."""

EXAMPLE = examples(
    "python -m bridge repair drive.mcap",
    "python -m bridge repair drive.mcap --out whole.mcap",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "recording",
        metavar="F.mcap",
        help="the recording; where more than a torn end is left out of it, the file as it was is"
        f" kept as F.mcap{KEPT}",
    )
    parser.add_argument(
        "--out",
        metavar="G.mcap",
        help="write here instead of over the recording itself; it must not exist yet",
    )


def run(arguments: Any) -> int:
    """Rewrite what can be read; the file is replaced only once the new one is whole."""
    source = Path(arguments.recording)
    if arguments.out is None:
        check_writable(source)
    else:
        check_new(Path(arguments.out))
    with _held(source):
        recording = Recording(source)
        data, messages = _rewrite(recording)
        if not messages:
            raise UserError(f"{source} holds no whole message; there is nothing to repair")
        if not recording.trouble() and arguments.out is None:
            print(_nothing_done(recording, messages))
            return 0
        kept = _write(data, recording, arguments.out)
    left_out = recording.missing() and f"; left out: {recording.missing()}"
    print(f"wrote {arguments.out or source}: {counted(messages, 'message')}{left_out}{kept}")
    return 0


def _nothing_done(recording: Recording, messages: int) -> str:
    found = counted(messages, "message")
    if recording.has_checksums:
        return f"{recording.path} is whole: {found}; nothing done"
    return (
        f"{recording.path} can be read to its end: {found}; nothing done. It has no checksum over"
        " all of it, so a change in its index would not show; --out G.mcap writes it with one"
    )


@contextlib.contextmanager
def _held(source: Path) -> Iterator[None]:
    """Refuse a recording that is still growing: what comes later would go into the old file."""
    try:
        stream = open_regular(source)
    except OSError as error:
        raise UserError(f"recording {source} cannot be read: {error.strerror}") from None
    with stream:
        if not try_to_lock_file(stream.fileno()):
            raise UserError(f"{source} is being written; repair it when its writer has ended")
        yield


def _write(data: bytes, recording: Recording, out: str | None) -> str:
    """Write the new file, over the recording or to ``out``; say where the old one is kept."""
    if out is not None or not recording.is_damaged:
        write_atomic(out or recording.path, data)
        return ""
    file = behind_link(recording.path)
    kept = file.with_name(file.name + KEPT)
    _link(file, kept)
    try:
        write_atomic(file, data)
    except UserError:  # Nothing was replaced. (After an interrupt nobody knows: it stays.)
        kept.unlink()
        raise
    return f"; the file as it was: {kept}"


def _link(file: Path, kept: Path) -> None:
    try:
        os.link(file, kept)
    except FileExistsError:
        # A repair that was killed leaves its link.
        if not (kept.exists() and kept.samefile(file)):
            raise UserError(
                f"{kept} exists; move it away, or name another file with --out"
            ) from None
    except OSError as error:
        raise UserError(
            f"cannot keep {file} as {kept}: {error.strerror}; name another file with --out"
        ) from None


def _rewrite(recording: Recording) -> tuple[bytes, int]:
    """Copy every message into a new recording, held in memory."""
    stream = io.BytesIO()
    writer = start_mcap(stream)
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    messages = 0
    for channel, schema, message in recording.messages():
        if schema is not None and schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas.get(channel.schema_id, 0)
            )
        writer.add_message(
            channels[channel.id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
        messages += 1
    if recording.metadata:
        writer.add_metadata(METADATA, recording.metadata)
    writer.finish()
    return stream.getvalue(), messages
