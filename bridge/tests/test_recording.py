"""Recordings: cut off, damaged, mended, and made to keep a reader busy."""

import collections
import io
import json
import os
import shutil
import zlib

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, Header, Message
from mcap.writer import MCAP0_MAGIC

from bridge import recording as records
from bridge.recording import Recording
from bridge.tests.harness import (
    LEFT_TURN,
    bridge_status,
    chunks,
    flip,
    flip_chunk,
    make_command,
    make_policy,
    messages_of,
)
from bridge.tests.test_record import heard, told, told_in, writing
from bridge.tests.test_replay import Hand
from edge_runtime.tests.harness import make_state
from edge_runtime.util import UserError
from edge_runtime.wire import encode


@pytest.fixture
def copy(tmp_path):
    path = tmp_path / "drive.mcap"
    shutil.copy(LEFT_TURN, path)
    return path


def without_chunk(number: int) -> list[tuple[str, int, bytes]]:
    """The messages of the undamaged file but those of one chunk."""
    sizes = [messages_of(LEFT_TURN, index) for index in chunks(LEFT_TURN)]
    first, whole = sum(sizes[:number]), told_in(LEFT_TURN)
    return whole[:first] + whole[first + sizes[number] :]


@pytest.mark.parametrize("number", [0, 3, -1], ids=["first", "middle", "last"])
@pytest.mark.parametrize("damage", ["contents", "length", "opcode", "all zero, as a disk does"])
def test_only_the_broken_chunk_is_lost(copy, damage, number):
    index = chunks(copy)[number]
    start, size = index.chunk_start_offset, index.chunk_length
    if damage.startswith("all"):  # Neither the record nor its length is left.
        data = copy.read_bytes()
        copy.write_bytes(data[:start] + bytes(size) + data[start + size :])
    else:
        place = {"contents": (size // 2, 4), "length": (1, 8), "opcode": (0, 1)}[damage]
        flip(copy, start + place[0], place[1])
    recording = Recording(copy)
    assert [told(stored) for stored in recording.messages()] == without_chunk(number)
    assert (recording.damaged_places, recording.cut_off) == (1, False)
    whole = Recording(LEFT_TURN)
    list(whole.messages())
    assert recording.metadata == whole.metadata


def test_repair_says_what_it_leaves_out_and_keeps_the_file_as_it_was(copy, repair):
    flip_chunk(copy, 3)
    damaged, kept = copy.read_bytes(), copy.with_name("drive.mcap.damaged")
    left = without_chunk(3)
    assert 2000 < len(left) < len(told_in(LEFT_TURN))
    assert repair(copy) == (
        f"wrote {copy}: {len(left)} messages; left out: 1 damaged place of"
        f" {chunks(LEFT_TURN)[3].chunk_length} bytes; the file as it was: {kept}\n"
    )
    assert kept.read_bytes() == damaged
    assert told_in(copy) == left
    with copy.open("rb") as stream:
        assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == len(left)
    assert "is whole" in repair(copy)


def test_a_replay_says_damaged_and_replays_the_rest(tmp_path, capsys):
    path, out = tmp_path / "by_hand.mcap", tmp_path / "r.json"
    hand = Hand(path)
    for first in (0, 20, 40):
        hand.drive(first, first + 20)
        hand.writer.flush()
    hand.close()
    flip_chunk(path, 1)
    trust = ["--policy", str(make_policy(tmp_path, "constant", 0.3)), "--allow-unsigned"]
    bridge_status(["replay", str(path), *trust, "--out", str(out)])
    report = json.loads(out.read_text())
    assert (report["states"], report["cut_off"], report["damaged_places"]) == (40, False, 1)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("the recording is damaged (1 damaged place of")


def test_bytes_that_are_gone_take_no_more_with_them(copy):
    """The index is not where it says; its names are good all the same."""
    data = copy.read_bytes()
    copy.write_bytes(data[:300] + data[320:])
    assert told_in(copy) == without_chunk(0)


def test_of_a_cut_file_with_a_broken_first_chunk_the_nameless_messages_are_counted(copy, repair):
    data = copy.read_bytes()
    copy.write_bytes(data[: chunks(copy)[20].chunk_start_offset])
    flip(copy, 300)
    out = repair(copy)
    assert "messages whose topic was in a damaged place" in out
    assert "the file as it was" in out


def test_a_file_without_a_checksum_over_all_of_it_is_not_called_whole(copy, tmp_path, repair):
    """As other programs write them. --out writes it with one."""
    data, out = bytearray(copy.read_bytes()), tmp_path / "out.mcap"
    end = data.index(b"\x0f" + (4).to_bytes(8, "little"), chunks(copy)[-1].chunk_start_offset)
    data[end + 9 : end + 13] = bytes(4)
    copy.write_bytes(data)
    said = repair(copy)
    assert f"can be read to its end: {len(told_in(LEFT_TURN))} messages; nothing done" in said
    assert copy.read_bytes() == data
    repair(copy, "--out", out)
    assert "is whole" in repair(out)


@pytest.mark.parametrize(
    ("at", "says"),
    [
        (lambda path: path.stat().st_size - 100, "1 damaged place"),  # in the index
        # when the first message of a chunk came
        (lambda path: chunks(path)[3].chunk_start_offset + 9, "bytes that changed outside of its"),
    ],
)
def test_what_is_broken_outside_of_the_chunks_is_said_and_mended(copy, tmp_path, repair, at, says):
    whole, count = tmp_path / "whole.mcap", len(told_in(LEFT_TURN))
    repair(copy, "--out", whole)  # with a checksum over all of it
    flip(whole, at(whole))
    assert f"{count} messages; left out: {says}" in repair(whole)
    assert whole.with_name("whole.mcap.damaged").exists()
    with whole.open("rb") as stream:
        assert len(list(make_reader(stream).iter_messages())) == count
    assert "is whole" in repair(whole)


def test_through_a_link_the_file_is_repaired_and_kept_where_it_is(copy, tmp_path, repair):
    flip_chunk(copy, 3)
    copy.with_name("drive.mcap.damaged").hardlink_to(copy)  # As a repair that was killed leaves it.
    link = tmp_path / "elsewhere" / "link.mcap"
    link.parent.mkdir()
    link.symlink_to(copy)
    repair(link)
    assert link.is_symlink()
    assert told_in(copy) == without_chunk(3)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "drive.mcap", "drive.mcap.damaged", "elsewhere",
    ]  # fmt: skip


def test_no_file_is_overwritten(copy, tmp_path, refusal, repair):
    flip_chunk(copy, 3)
    damaged, out, kept = copy.read_bytes(), tmp_path / "ok.mcap", tmp_path / "drive.mcap.damaged"
    repair(copy, "--out", out)
    whole = out.read_bytes()
    line = refusal("repair", copy, "--out", out)
    assert "exists; choose another name: no recording is lost" in line
    kept.write_text("mine")
    assert "drive.mcap.damaged exists" in refusal("repair", copy)
    found = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert found == {"drive.mcap": damaged, "ok.mcap": whole, kept.name: b"mine"}


def test_what_is_no_recording_is_refused_and_nobody_waits_for_a_pipe(tmp_path, refusal):
    pipe, empty = tmp_path / "pipe", tmp_path / "empty.mcap"
    os.mkfifo(pipe)
    empty.touch()
    for path, says in ((pipe, "no regular file"), (empty, "no MCAP recording")):
        assert says in refusal("repair", path, "--out", tmp_path / "out.mcap")
        assert says in refusal("view", path, "--save", tmp_path / "out.rrd")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Two chunks, an index and metadata: each kind of record that `record` writes."""
    path = tmp_path_factory.mktemp("recordings") / "small.mcap"
    payloads = {"state": encode(make_state(1)), "command": encode(make_command(1))}
    with writing(path) as writer:
        for number, (topic, payload) in enumerate(payloads.items()):
            writer.write(heard(topic, payload, number))
            writer.flush()
    return path


def is_whole(path) -> bool:
    recording = Recording(path)
    try:
        collections.deque(recording.messages(), maxlen=0)
    except UserError:
        return False
    return not recording.trouble() and recording.has_checksums


def test_bytes_overwritten_at_any_place_are_noticed(small):
    assert is_whole(small)
    data, path = small.read_bytes(), small.with_name("changed.mcap")
    for at in range(0, len(data) - 9, 5):
        flipped = bytes(byte ^ 0xFF for byte in data[at : at + 10])
        for new in (flipped, bytes(10), flipped[: at % 9 + 1]):
            changed = data[:at] + new + data[at + len(new) :]
            path.write_bytes(changed)
            assert changed == data or not is_whole(path), (at, new)


MIB = 1 << 20
HEADER_BYTES = 17


def zeros(mib: int, tells_size: bool = True) -> bytes:
    stream = io.BytesIO()
    compressor = zstandard.ZstdCompressor(write_content_size=tells_size)
    with compressor.stream_writer(stream, size=mib * MIB, closefd=False) as writer:
        for _ in range(mib):
            writer.write(bytes(MIB))
    return stream.getvalue()


def crafted(path, *chunks: tuple[bytes, int]):
    """A recording of chunks, each of its data and of what it announces to unpack to."""
    builder = RecordBuilder()
    builder.write(MCAP0_MAGIC)
    Header("", "").write(builder)
    for data, announced in chunks:
        Chunk("zstd", data, 0, 0, 0, announced).write(builder)
    path.write_bytes(builder.end())
    return path


@pytest.fixture
def unpacked(monkeypatch):
    sizes, breakup = [], records.breakup_chunk

    def count(chunk, validate_crc):
        sizes.append(chunk.uncompressed_size)
        return breakup(chunk, validate_crc)

    monkeypatch.setattr(records, "breakup_chunk", count)
    return sizes


@pytest.mark.parametrize(
    ("mib", "said_mib", "tells_size", "count", "most_mib"),
    [(1024, 1024, True, 40, 0), (1024, 1, True, 40, 0), (1024, 1024, False, 40, 0),
     (64, 1, False, 1, 1)],
)  # fmt: skip
def test_a_bomb_is_passed_over(tmp_path, unpacked, mib, said_mib, tells_size, count, most_mib):
    """Whether the chunk says so itself, or its data alone do, or neither."""
    bomb = zeros(mib, tells_size)
    path = crafted(tmp_path / "bomb.mcap", *[(bomb, said_mib * MIB)] * count)
    recording = Recording(path)
    assert list(recording.messages()) == []
    assert recording.damaged_bytes == path.stat().st_size - len(MCAP0_MAGIC) - HEADER_BYTES
    assert sum(unpacked) <= most_mib * MIB


def test_many_small_bombs_together_are_refused(tmp_path, monkeypatch, unpacked, refusal):
    monkeypatch.setattr(records, "MAX_CHUNK_BYTES", MIB)
    path = crafted(tmp_path / "bomb.mcap", *[(zeros(1), MIB)] * 100)
    for command in (["repair"], ["view", "--save", str(tmp_path / "a.rrd")]):
        assert "bomb.mcap is refused" in refusal(*command, path)
    assert sum(unpacked) <= 4 * MIB
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
