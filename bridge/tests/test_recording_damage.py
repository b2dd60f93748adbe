"""Recordings with bytes overwritten anywhere, and recordings made to keep a reader busy."""

from __future__ import annotations

import io
import zlib

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Header, Message
from mcap.writer import MCAP0_MAGIC

from bridge import recording as records
from bridge.messages import Heard
from bridge.record import RecordingWriter
from bridge.recording import Recording
from bridge.tests.harness import make_command
from edge_runtime.tests.harness import make_state
from edge_runtime.util import UserError
from edge_runtime.wire import encode

OVERWRITTEN = 10


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Two chunks, an index and metadata: each kind of record that `record` writes."""
    path = tmp_path_factory.mktemp("recordings") / "small.mcap"
    writer = RecordingWriter(path)
    payloads = {"state": encode(make_state(1)), "command": encode(make_command(1))}
    for number, (topic, payload) in enumerate(payloads.items()):
        writer.write(Heard(f"phil/v/{topic}", topic, payload, number, len(payload)))
        writer.flush()
    writer.finish(dropped=0)
    writer.close()
    return path


def is_whole(path) -> bool:
    """Whether `repair` would say so."""
    recording = Recording(path)
    try:
        for _ in recording.messages():
            pass
    except UserError:
        return False
    return not recording.trouble() and recording.has_checksums


def overwritten(small, at: int, new: bytes) -> bool:
    """Whether a recording with those bytes at that place is no longer whole, or the same."""
    data = small.read_bytes()
    changed = data[:at] + new + data[at + len(new) :]
    path = small.with_name("changed.mcap")
    path.write_bytes(changed)
    return changed == data or not is_whole(path)


def test_ten_bytes_overwritten_at_any_place_are_noticed(small):
    assert is_whole(small)
    data = small.read_bytes()
    for at in range(0, len(data) - OVERWRITTEN + 1, 5):
        flipped = bytes(byte ^ 0xFF for byte in data[at : at + OVERWRITTEN])
        assert overwritten(small, at, flipped), at
        assert overwritten(small, at, bytes(OVERWRITTEN)), at


@given(place=st.floats(0, 1), new=st.binary(min_size=1, max_size=OVERWRITTEN))
def test_any_bytes_overwritten_are_noticed(small, place, new):
    at = round(place * (small.stat().st_size - len(new)))
    assert overwritten(small, at, new)


MIB = 1 << 20
HEADER_BYTES = 17


def zeros(mib: int, tells_size: bool = True) -> bytes:
    """That many MiB, compressed to almost nothing."""
    stream = io.BytesIO()
    compressor = zstandard.ZstdCompressor(write_content_size=tells_size)
    with compressor.stream_writer(stream, size=mib * MIB, closefd=False) as writer:
        for _ in range(mib):
            writer.write(bytes(MIB))
    return stream.getvalue()


def crafted(path, *chunks: tuple[bytes, int], filling: bytes = b""):
    """A recording of chunks, each of its data and of what it announces to unpack to."""
    builder = RecordBuilder()
    builder.write(MCAP0_MAGIC)
    Header("", "").write(builder)
    for data, announced in chunks:
        Chunk("zstd", data, 0, 0, 0, announced).write(builder)
    path.write_bytes(builder.end() + filling)
    return path


class Counted:
    """How many bytes are unpacked."""

    def __init__(self, monkeypatch) -> None:
        self.unpacked = 0
        self._breakup = records.breakup_chunk
        monkeypatch.setattr(records, "breakup_chunk", self)

    def __call__(self, chunk, validate_crc):
        self.unpacked += chunk.uncompressed_size
        return self._breakup(chunk, validate_crc)


@pytest.mark.parametrize(("announced", "tells_size"), [(1024, True), (1, True), (1024, False)])
def test_a_chunk_that_unpacks_to_too_much_is_passed_over(
    tmp_path, monkeypatch, announced, tells_size
):
    """Whether the chunk says so itself, or its data alone do."""
    counted = Counted(monkeypatch)
    bomb = zeros(1024, tells_size)
    path = crafted(tmp_path / "bomb.mcap", *[(bomb, announced * MIB)] * 40)
    recording = Recording(path)
    assert list(recording.messages()) == []
    assert recording.damaged_bytes == path.stat().st_size - len(MCAP0_MAGIC) - HEADER_BYTES
    assert counted.unpacked == 0


def test_data_that_do_not_say_their_size_are_unpacked_as_far_as_the_chunk_says(tmp_path):
    recording = Recording(crafted(tmp_path / "bomb.mcap", (zeros(64, False), MIB)))
    assert list(recording.messages()) == []
    assert recording.damaged_places == 1


def test_chunks_that_unpack_to_too_much_together_are_refused(tmp_path, monkeypatch, refusal):
    counted = Counted(monkeypatch)
    monkeypatch.setattr(records, "MAX_CHUNK_BYTES", MIB)
    path = crafted(tmp_path / "bomb.mcap", *[(zeros(1), MIB)] * 100)
    for command in (["repair"], ["view", "--save", str(tmp_path / "a.rrd")]):
        assert "bomb.mcap is refused" in refusal(*command, path)
    assert counted.unpacked <= 4 * MIB
    assert [file.name for file in tmp_path.iterdir()] == ["bomb.mcap"]


def test_empty_messages_count_though_they_hardly_have_bytes(tmp_path):
    builder = RecordBuilder()
    for _ in range(20_000):
        Message(channel_id=0, log_time=0, data=b"", publish_time=0, sequence=0).write(builder)
    data = builder.end()
    packed = zstandard.compress(data)
    path = crafted(tmp_path / "empty.mcap", *[(packed, len(data))] * 20)
    with pytest.raises(UserError, match="takes more than 200 times"):
        list(Recording(path).messages())


class ReadCounting(io.BytesIO):
    """A file in memory that counts what is read of it."""

    name = "crafted.mcap"
    read_bytes = 0

    def read(self, count: int | None = -1) -> bytes:
        data = super().read(count)
        self.read_bytes += len(data)
        return data


def fake_chunks(size: int) -> bytes:
    """Beginnings of chunks, each as long as the rest of the file."""
    lengths = range(size // 45 * 45 - 9, 0, -45)
    rest = bytes(28) + b"\x04\0\0\0zstd"
    return b"".join(b"\x06" + length.to_bytes(8, "little") + rest for length in lengths)


def fake_ends(size: int) -> bytes:
    """Ends of files, each with an index as long as all before it."""
    end = b"\x02" + b"".join(value.to_bytes(8, "little") for value in (20, 8, 0)) + b"\1\2\3\4"
    return (end + MCAP0_MAGIC) * (size // 37)


def true_data_ends(size: int) -> bytes:
    """Ends of the data, each with the right checksum over all before it."""
    ends, crc = [], zlib.crc32(MCAP0_MAGIC)
    for _ in range(size // 13):
        ends.append(b"\x0f" + (4).to_bytes(8, "little") + crc.to_bytes(4, "little"))
        crc = zlib.crc32(ends[-1], crc)
    return b"".join(ends)


@pytest.mark.parametrize("make", [fake_chunks, fake_ends, true_data_ends])
def test_the_work_is_bounded_by_the_size(make):
    """Landmarks at which nothing stands, or whose checksum takes the whole file."""
    size = 1_000_000
    data = MCAP0_MAGIC + make(size)
    stream = ReadCounting(data)
    with pytest.raises(UserError, match="takes more than 200 times"):
        list(records.Records(stream, len(data)).walk())
    assert stream.read_bytes <= 2 * (records.MAX_CHUNK_BYTES + records.MAX_WORK * size)
