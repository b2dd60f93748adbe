"""``python -m bridge repair`` of files that are damaged, not only cut off."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import pytest
from mcap.reader import make_reader

from bridge.recording import Recording, Stored
from bridge.tests.harness import (
    LEFT_TURN,
    bridge_status,
    chunks,
    flip,
    flip_chunk,
    make_policy,
    messages_of,
)
from bridge.tests.test_replay import Hand

HELD_OPEN = """
import sys
from pathlib import Path
from bridge.record import FlushedFile
file = FlushedFile(Path(sys.argv[1]))
file.write(sys.stdin.buffer.read(int(sys.argv[2])))
file.flush()
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def copy(tmp_path):
    path = tmp_path / "drive.mcap"
    shutil.copy(LEFT_TURN, path)
    return path


def told(stored: Stored) -> tuple[str, int, bytes]:
    return stored.channel.topic, stored.message.log_time, stored.message.data


def read(path) -> list[tuple[str, int, bytes]]:
    return [told(stored) for stored in Recording(path).messages()]


def without_chunk(number: int) -> list[tuple[str, int, bytes]]:
    """The messages of the undamaged file but those of one chunk."""
    sizes = [messages_of(LEFT_TURN, index) for index in chunks(LEFT_TURN)]
    first, whole = sum(sizes[:number]), read(LEFT_TURN)
    return whole[:first] + whole[first + sizes[number] :]


def damage_contents(path, number):
    flip_chunk(path, number)


def damage_length(path, number):
    flip(path, chunks(path)[number].chunk_start_offset + 1, 8)


def damage_opcode(path, number):
    flip(path, chunks(path)[number].chunk_start_offset, 1)


def zero_the_chunk(path, number):
    """As a disk does: neither the record nor its length is left."""
    index = chunks(path)[number]
    start, end = index.chunk_start_offset, index.chunk_start_offset + index.chunk_length
    data = path.read_bytes()
    path.write_bytes(data[:start] + bytes(end - start) + data[end:])


@pytest.mark.parametrize("number", [0, 3, 29], ids=["first", "middle", "last"])
@pytest.mark.parametrize("damage", [damage_contents, damage_length, damage_opcode, zero_the_chunk])
def test_only_the_broken_chunk_is_lost(copy, damage, number):
    damage(copy, number)
    recording = Recording(copy)
    assert [told(stored) for stored in recording.messages()] == without_chunk(number)
    assert (recording.damaged_places, recording.cut_off) == (1, False)
    whole = Recording(LEFT_TURN)
    list(whole.messages())
    assert recording.metadata == whole.metadata


def test_repair_says_what_it_leaves_out_and_keeps_the_file_as_it_was(copy, capsys):
    flip_chunk(copy, 3)
    damaged, kept = copy.read_bytes(), copy.with_name("drive.mcap.damaged")
    left = without_chunk(3)
    assert 2000 < len(left) < len(read(LEFT_TURN))
    assert bridge_status(["repair", str(copy)]) == 0
    assert capsys.readouterr().out == (
        f"wrote {copy}: {len(left)} messages; left out: 1 damaged place of"
        f" {chunks(LEFT_TURN)[3].chunk_length} bytes; the file as it was: {kept}\n"
    )
    assert kept.read_bytes() == damaged
    assert read(copy) == left
    with copy.open("rb") as stream:
        assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == len(left)
    assert bridge_status(["repair", str(copy)]) == 0
    assert "is whole" in capsys.readouterr().out


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


def test_a_broken_index_is_written_anew_and_no_message_is_lost(copy, capsys):
    flip(copy, copy.stat().st_size - 100)
    assert bridge_status(["repair", str(copy)]) == 0
    assert f"{len(read(LEFT_TURN))} messages; left out: 1 damaged place" in capsys.readouterr().out
    with copy.open("rb") as stream:
        assert len(list(make_reader(stream).iter_messages())) == len(read(LEFT_TURN))


def test_bytes_that_are_gone_take_no_more_with_them(copy):
    """The index is not where it says; its names are good all the same."""
    data = copy.read_bytes()
    copy.write_bytes(data[:300] + data[320:])
    assert read(copy) == without_chunk(0)


def test_of_a_cut_file_with_a_broken_first_chunk_the_nameless_messages_are_counted(copy, capsys):
    data = copy.read_bytes()
    copy.write_bytes(data[: chunks(copy)[20].chunk_start_offset])
    flip(copy, 300)
    assert bridge_status(["repair", str(copy)]) == 0
    out = capsys.readouterr().out
    assert "messages whose topic was in a damaged place" in out
    assert "the file as it was" in out


def test_a_damaged_file_is_not_kept_over_an_earlier_one(copy, refusal):
    flip_chunk(copy, 3)
    damaged, kept = copy.read_bytes(), copy.with_name("drive.mcap.damaged")
    kept.write_text("mine")
    assert "drive.mcap.damaged exists" in refusal("repair", copy)
    assert (kept.read_text(), copy.read_bytes()) == ("mine", damaged)


def test_a_file_without_a_checksum_over_all_of_it_is_not_called_whole(copy, tmp_path, capsys):
    """As other programs write them. --out writes it with one."""
    data, out = bytearray(copy.read_bytes()), tmp_path / "out.mcap"
    end = data.index(b"\x0f" + (4).to_bytes(8, "little"), chunks(copy)[-1].chunk_start_offset)
    data[end + 9 : end + 13] = bytes(4)
    copy.write_bytes(data)
    assert bridge_status(["repair", str(copy)]) == 0
    assert (
        f"can be read to its end: {len(read(LEFT_TURN))} messages; nothing done"
        in capsys.readouterr().out
    )
    assert copy.read_bytes() == data
    assert bridge_status(["repair", str(copy), "--out", str(out)]) == 0
    assert bridge_status(["repair", str(out)]) == 0
    assert "is whole" in capsys.readouterr().out


def test_a_change_outside_of_the_chunks_is_said_and_mended(copy, tmp_path, capsys):
    whole = tmp_path / "whole.mcap"
    assert bridge_status(["repair", str(copy), "--out", str(whole)]) == 0
    flip(whole, chunks(whole)[3].chunk_start_offset + 9)  # when its first message came
    assert bridge_status(["repair", str(whole)]) == 0
    said = capsys.readouterr().out
    assert (
        f"{len(read(LEFT_TURN))} messages; left out: bytes that changed outside of its chunks"
        in said
    )
    assert whole.with_name("whole.mcap.damaged").exists()
    assert bridge_status(["repair", str(whole)]) == 0
    assert "is whole" in capsys.readouterr().out


def test_a_repair_that_was_killed_can_be_done_again(copy):
    flip_chunk(copy, 3)
    copy.with_name("drive.mcap.damaged").hardlink_to(copy)
    assert bridge_status(["repair", str(copy)]) == 0
    assert read(copy) == without_chunk(3)


def test_through_a_link_the_file_is_repaired_and_kept_where_it_is(copy, tmp_path):
    flip_chunk(copy, 3)
    link = tmp_path / "elsewhere" / "link.mcap"
    link.parent.mkdir()
    link.symlink_to(copy)
    assert bridge_status(["repair", str(link)]) == 0
    assert link.is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "drive.mcap", "drive.mcap.damaged", "elsewhere",
    ]  # fmt: skip


def test_out_writes_a_new_file_only(copy, tmp_path, refusal):
    flip_chunk(copy, 3)
    damaged, out = copy.read_bytes(), tmp_path / "ok.mcap"
    assert bridge_status(["repair", str(copy), "--out", str(out)]) == 0
    assert copy.read_bytes() == damaged
    whole = out.read_bytes()
    line = refusal("repair", copy, "--out", out)
    assert "exists; choose another name: no recording is lost" in line
    assert out.read_bytes() == whole
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.mcap", "ok.mcap"]


def test_what_is_being_written_is_not_repaired_and_a_kill_frees_it(tmp_path, capsys, refusal):
    path, data = tmp_path / "growing.mcap", LEFT_TURN.read_bytes()[:100_000]
    command = [sys.executable, "-c", HELD_OPEN, str(path), str(len(data))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdin is not None
        assert writer.stdout is not None
        writer.stdin.write(data)
        writer.stdin.flush()
        assert writer.stdout.readline() == b"ready\n"
        for options in ([], ["--out", tmp_path / "other.mcap"]):
            assert "is being written" in refusal("repair", path, *options)
        assert path.read_bytes() == data
        writer.kill()
        writer.wait()
    assert bridge_status(["repair", str(path)]) == 0
    assert "a torn end of" in capsys.readouterr().out
    assert [place.name for place in tmp_path.iterdir()] == ["growing.mcap"]


def test_a_pipe_is_no_recording_and_nobody_waits_for_it(tmp_path, refusal):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for command, option, out in (("repair", "--out", "out.mcap"), ("view", "--save", "out.rrd")):
        assert "no regular file" in refusal(command, pipe, option, tmp_path / out)
