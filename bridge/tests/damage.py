"""Recordings that are damaged, for the tests."""

from __future__ import annotations

from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex, Message
from mcap.stream_reader import StreamReader, breakup_chunk

LEFT_TURN = Path(__file__).parents[2] / "hil_tests" / "recordings" / "left_turn.mcap"


def chunks(path: Path) -> list[ChunkIndex]:
    """Where the chunks of a whole recording lie."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def messages_of(path: Path, chunk: ChunkIndex) -> int:
    """How many messages a chunk of an undamaged file holds."""
    with path.open("rb") as stream:
        stream.seek(chunk.chunk_start_offset)
        record = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
    assert isinstance(record, Chunk)
    return sum(isinstance(part, Message) for part in breakup_chunk(record, True))


def flip(path: Path, at: int, count: int = 4) -> None:
    """Turn round every bit of some bytes."""
    data = bytearray(path.read_bytes())
    data[at : at + count] = bytes(byte ^ 0xFF for byte in data[at : at + count])
    path.write_bytes(data)


def flip_chunk(path: Path, number: int) -> None:
    """Damage what the chunk holds, so that its checksum is wrong."""
    index = chunks(path)[number]
    flip(path, index.chunk_start_offset + index.chunk_length // 2)
