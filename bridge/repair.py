"""``python -m bridge repair``: give a recording that was cut off its index back."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from bridge.recording.reader import Recording
from bridge.recording.writer import CHUNK_BYTES, METADATA
from edge_runtime.cli import ArgumentParser, UserError, examples
from edge_runtime.files import check_writable, write_atomic

EXAMPLE = examples(
    "python -m bridge repair drive.mcap",
    "python -m bridge repair drive.mcap --out whole.mcap",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("recording", metavar="F.mcap", help="the recording that was cut off")
    parser.add_argument(
        "--out", metavar="G.mcap", help="write here instead of over the recording itself"
    )


def repair(arguments: Any) -> int:
    """Rewrite what can be read; the file is replaced only once the new one is whole."""
    source = Path(arguments.recording)
    target = Path(arguments.out or source)
    check_writable(target)
    recording = Recording(source)
    data, messages = _rewrite(recording)
    if not messages:
        raise UserError(f"{source} holds no whole message; there is nothing to repair")
    if not recording.cut_off and arguments.out is None:
        print(f"{source} is whole: {messages} messages; nothing done")
        return 0
    write_atomic(target, data)
    print(f"wrote {target}: {messages} messages")
    return 0


def _rewrite(recording: Recording) -> tuple[bytes, int]:
    """Copy every message into a new recording, held in memory."""
    stream = io.BytesIO()
    writer = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD)
    writer.start()
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    messages = 0
    for channel, schema, message in recording.messages():
        if schema is not None and schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[channel.schema_id]
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
