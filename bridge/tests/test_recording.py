"""Recordings: how they are written, cut off, damaged, and made to keep a reader busy."""

import collections
import contextlib
import json
import os
import resource
import shutil
import signal
import time
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
import zenoh
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, Header, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from bridge import recording as records
from bridge.messages import DECODERS, Heard, Scene, encode_scene
from bridge.ports import QUEUE_MESSAGES, WireListener
from bridge.record import Log, RawImage, RecordingWriter, _listen, describe
from bridge.recording import Recording
from bridge.replay import RecordedDrive, replay
from edge_runtime.cli import quit_on_signals
from edge_runtime.config import Config
from edge_runtime.manifest import Entry, Task
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_STATE_BYTES, Command, Health, State, decode_state, encode
from hil_tests.processes import wait_until
from hil_tests.testing.drives import (
    LEFT_TURN,
    SLOW_TOY,
    chunks,
    flip,
    make_policy,
    read,
    record_drive,
    start_record,
    start_simulate,
    writing,
)
from hil_tests.testing.edge import start_edge
from hil_tests.testing.messages import make_command, make_state
from hil_tests.testing.policies import SIZE, TASK
from hil_tests.testing.recordings import health, heard

ODD = Task(task="", observation={"a": Entry(dtype="odd", shape=[1])}, action=[], control_period_s=1)

ODD_SIZE = msgspec.structs.replace(TASK, observation={"frames": Entry(dtype="uint8", shape=[2])})


def told(stored: tuple[Channel, Message]) -> tuple[str, int, bytes]:
    channel, message = stored
    return channel.topic, message.log_time, message.data


def told_in(path: Path) -> list[tuple[str, int, bytes]]:
    return list(map(told, Recording(path).messages()))


def test_the_picture_is_what_the_policy_saw_and_may_have_the_name_of_a_message(tmp_path):
    frames = bytes(range(256)) * (SIZE // 256) + bytes(SIZE % 256)
    place: dict[str, Any] = {"episode": 0, "step": 3, "sim_time_s": 0.3}
    task = msgspec.structs.replace(TASK, observation={"state": TASK.observation["frames"]})
    with writing(tmp_path / "runs" / "a.mcap") as writer:
        # It says how to read the states.
        writer.write(heard("scene", encode_scene({}, Scene(**place, task=task))))
        other = encode_scene({}, Scene(**place, task=ODD_SIZE))
        writer.write(Heard("phil/w/scene", "scene", other, 2, len(other)))  # another vehicle's
        state = encode(make_state(3, observation={"state": frames}))
        writer.write(heard("state", state, arrived_ns=5 * 10**9 + 7))
    with (tmp_path / "runs" / "a.mcap").open("rb") as stream:
        found = {
            schema.name: message.data
            for schema, channel, message in make_reader(stream).iter_messages()
            if schema is not None and channel.topic == "view/v/state"
        }
    assert set(found) == {"foxglove.RawImage", "phil.State"}
    image = msgspec.json.decode(found["foxglove.RawImage"], type=RawImage)
    assert (image.width, image.height, image.step, image.encoding) == (80, 90, 80, "mono8")
    assert (image.timestamp.sec, image.timestamp.nsec, image.data) == (5, 7, frames)


def test_what_cannot_be_read_is_kept_and_what_is_too_large_is_not(tmp_path):
    with writing(tmp_path / "a.mcap", dropped=3) as writer:
        writer.write(heard("state", b"junk"))
        writer.write(Heard("phil/v/state", "state", b"", 2, MAX_STATE_BYTES + 1))
        writer.write(heard("alive", b"\x01"))
    recording = Recording(tmp_path / "a.mcap")
    found = [(topic, data) for topic, _, data in map(told, recording.messages())]
    assert {("phil/v/state", b"junk"), ("phil/v/alive", b'{"here": true}')} <= set(found)
    events = [data for topic, data in found if topic == "view/v/events"]
    assert b"unreadable" in events[0]
    assert b"4194305 bytes" in events[1]
    assert recording.metadata == {"messages": "3", "dropped": "3"}


def test_no_payload_stops_the_recorder_or_a_replay(tmp_path):
    """Ints beyond 64 bits signed, and 3,000 mutated messages of every topic."""
    random = np.random.default_rng(1)
    good = [
        encode(make_state(1, episode=2**63)), encode(make_state(1)), encode(make_command(1)),
        encode(health(1, 2.0, stale=2**63)),
        encode_scene({"vehicles": []}, Scene(episode=1, step=1, sim_time_s=0.1)),
        encode_scene({}, Scene(episode=1, step=1, sim_time_s=0.1, task=ODD)),
    ]  # fmt: skip
    with writing(tmp_path / "a.mcap") as writer:
        for number in range(3000):
            payload = bytearray(good[number % len(good)])
            for _ in range(number // 1000):
                payload[random.integers(len(payload))] = random.integers(256)
            topic = list(DECODERS)[(number // len(good)) % len(DECODERS)]
            writer.write(heard(topic, bytes(payload), arrived_ns=number))
    raw = [topic for topic, _, _ in told_in(tmp_path / "a.mcap") if topic.startswith("phil/")]
    assert len(raw) == 3000
    drive = RecordedDrive(tmp_path / "a.mcap", None)
    policy = load_policy(make_policy(tmp_path), allow_unsigned=True)
    assert ("here", 0, 1) in drive.exchanges
    replay(drive, policy, Config())


def states_in(path: Path) -> list[tuple[int, Any]]:
    """Return the states of a recording with the times of their arrival (ns)."""
    found = [
        (arrived_ns, decode_state(data))
        for topic, arrived_ns, data in told_in(path)
        if topic.startswith("phil/") and topic.endswith("/state")
    ]
    assert all(isinstance(state, State) for _, state in found)
    return found


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    recording = record_drive(folder, SLOW_TOY, make_policy(folder))
    return recording, read(folder / "report.json")


def test_everything_on_the_wire_is_recorded_and_mcap_reads_it(drive):
    recording, report = drive
    steps = report["per_episode"][0]["steps"]
    with recording.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages()
        counts = collections.Counter(channel.topic for _, channel, _ in found)
    for topic in ("phil/{}/state", "phil/{}/scene", "view/{}/frames", "view/{}/scene"):
        assert counts[topic.format("hunter01")] == steps + 1
    # The last: it came, and it came and went.
    for topic, least in {"command": steps, "health": 1, "alive": 1, "simulator": 2}.items():
        assert counts[f"phil/hunter01/{topic}"] >= least
    assert [state.step for _, state in states_in(recording)] == list(range(steps + 1))


@pytest.mark.parametrize("kind", [State, Command, Health, Scene, RawImage, Log])
def test_a_copy_has_the_fields_and_types_of_its_schema(kind, drive):
    schema = msgspec.json.decode(describe(kind).data)
    assert schema["type"] == "object"  # Foxglove takes no other.
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
             "number": int | float, None: dict}  # fmt: skip
    with drive[0].open("rb") as stream:
        copies = [
            json.loads(message.data)
            for told, _, message in make_reader(stream).iter_messages()
            if told is not None and told.name == describe(kind).name
        ]
    assert copies
    for copy in copies:
        for name, value in copy.items():
            assert isinstance(value, kinds[schema["properties"][name].get("type")]), name


def test_a_kill_loses_little(tmp_path):
    """Half a second at most on an idle machine."""
    endpoint, recording = free_endpoint(), tmp_path / "cut.mcap"
    with (
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY, "--clock", "realtime"),
        start_record(endpoint, recording) as run,
        start_edge(endpoint, make_policy(tmp_path)),
    ):
        wait_until(lambda: len(states_in(recording)) > 10, "a second")
        time.sleep(0.7)  # Just after a flush there would be nothing to lose.
        run.send(signal.SIGKILL)
        killed_ns = time.time_ns()
        run.wait()
    states = states_in(recording)
    assert (killed_ns - states[-1][0]) * 1e-9 < 2.0
    assert [state.step for _, state in states] == list(range(len(states)))


@pytest.mark.parametrize("keep", [0.2, 0.9, 0.999])
def test_a_torn_file_is_read_up_to_the_tear(drive, tmp_path, keep):
    recording, _ = drive
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recording.read_bytes()[: int(recording.stat().st_size * keep)])
    whole, part = states_in(recording), states_in(torn)
    assert part == whole[: len(part)]
    read_again = Recording(torn)
    collections.deque(read_again.messages(), maxlen=0)
    assert (read_again.cut_off, read_again.is_damaged) == (True, False)
    assert read_again.torn_bytes


def test_a_full_disk_is_one_line_and_what_was_written_stays(tmp_path):
    """A limit on the file's size stands in for the disk: the same error path of write(2)."""
    endpoint, recording = free_endpoint(), tmp_path / "full.mcap"
    out = tmp_path / "r.json"
    with (
        start_simulate(endpoint, out, SLOW_TOY) as run,
        start_record(endpoint, recording) as recorder,
        start_edge(endpoint, make_policy(tmp_path)),
    ):
        wait_until(lambda: states_in(recording), "the first states")
        written, full = states_in(recording), recording.stat().st_size + 100
        resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (full, full))
        assert recorder.wait() == 1, recorder.errors
        assert run.wait() == 0, run.errors
    (line,) = recorder.errors.splitlines()
    assert "File too large" in line
    assert states_in(recording)[: len(written)] == written
    assert read(out)["per_episode"][0]["steps"] == 60  # The loop went on to its end.


def test_a_disk_that_is_full_at_the_start_leaves_no_file(tmp_path):
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limit[1]))
    try:
        with pytest.raises(UserError):
            RecordingWriter(tmp_path / "a.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert list(tmp_path.iterdir()) == []


def test_a_signal_cuts_no_message_in_two(tmp_path, monkeypatch):
    """Not even while the writer is in the middle of one."""
    listener, ended, path = WireListener(), Event(), tmp_path / "a.mcap"
    monkeypatch.setattr(listener, "next", lambda _: heard("state", encode(make_state(0))))

    def end() -> bool:
        ended.set()
        return True

    with writing(path) as writer, quit_on_signals(end):
        copy = writer._copies.write

        def signalled(one):
            signal.raise_signal(signal.SIGTERM)
            copy(one)

        monkeypatch.setattr(writer._copies, "write", signalled)
        _listen(listener, writer, SimpleNamespace(duration_s=None, linger_s=9.0), ended)
    assert [topic for topic, _, _ in told_in(path)] == ["phil/v/state", "view/v/state"]


def test_a_feed_that_falls_behind_drops_and_counts():
    feed, endpoint = WireListener(), free_endpoint()
    with contextlib.closing(open_session(listen=endpoint, mode="router")) as session:
        subscriber = session.declare_subscriber("phil/v/state", feed.hear)
        for _ in range(QUEUE_MESSAGES + 5):
            session.put("phil/v/state", b"x", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: feed.dropped == 5, "the queue to be full")
        subscriber.undeclare()
    assert feed.queue.qsize() == QUEUE_MESSAGES


def test_a_recording_ends_though_an_edge_runtime_stays(tmp_path, monkeypatch):
    """It is behind a router, its simulator has gone, and it goes on saying how it is."""
    listener = WireListener()
    said = iter([Heard("phil/car/health", "health", b"", 1, 0)] * 1000)

    def hear(_timeout_s):
        time.sleep(0.005)
        return next(said)  # They come to an end where it listens on.

    monkeypatch.setattr(listener, "next", hear)
    with writing(tmp_path / "drive.mcap") as writer:
        _listen(listener, writer, SimpleNamespace(duration_s=None, linger_s=0.05), Event())
    assert writer.messages > 0


@pytest.fixture
def copy(tmp_path):
    path = tmp_path / "drive.mcap"
    shutil.copy(LEFT_TURN, path)
    return path


def messages_of(index: ChunkIndex) -> int:
    """How many messages a chunk of the undamaged file holds."""
    with LEFT_TURN.open("rb") as stream:
        stream.seek(index.chunk_start_offset)
        record: Any = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
    return sum(isinstance(part, Message) for part in breakup_chunk(record, True))


def without_chunk(number: int) -> list[tuple[str, int, bytes]]:
    """The messages of the undamaged file but those of one chunk."""
    sizes = list(map(messages_of, chunks(LEFT_TURN)))
    first, whole = sum(sizes[:number]), told_in(LEFT_TURN)
    return whole[:first] + whole[first + sizes[number] :]


@pytest.mark.parametrize("number", [0, 3, -1])
@pytest.mark.parametrize("damage", ["contents", "length", "opcode", "all zero"])
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


def test_bytes_that_are_gone_take_no_more_with_them(copy):
    """The index is not where it says; its names are good all the same."""
    data = copy.read_bytes()
    copy.write_bytes(data[:300] + data[320:])
    assert told_in(copy) == without_chunk(0)


def test_of_a_cut_file_with_a_broken_first_chunk_the_nameless_messages_are_counted(copy):
    data = copy.read_bytes()
    copy.write_bytes(data[: chunks(copy)[20].chunk_start_offset])
    flip(copy, 300)
    recording = Recording(copy)
    assert list(recording.messages())
    assert recording.nameless_messages > 0
    assert recording.is_damaged


def test_what_is_no_recording_is_refused_and_nobody_waits_for_a_pipe(tmp_path, refusal):
    pipe, empty = tmp_path / "pipe", tmp_path / "empty.mcap"
    os.mkfifo(pipe)
    empty.touch()
    for path, says in ((pipe, "no regular file"), (empty, "no MCAP recording")):
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


def test_no_change_of_bytes_makes_a_message_or_loses_more_than_a_chunk(small):
    data, path, whole = small.read_bytes(), small.with_name("changed.mcap"), told_in(small)
    for at in range(len(MCAP0_MAGIC), len(data) - 9, 37):
        flipped = bytes(byte ^ 0xFF for byte in data[at : at + 10])
        for new in (flipped, bytes(10), flipped[: at % 9 + 1]):
            path.write_bytes(data[:at] + new + data[at + len(new) :])
            recording = Recording(path)
            found = list(map(told, recording.messages()))
            assert found in (whole, whole[:2], whole[2:]), at
            assert found == whole or recording.is_damaged, at


def test_no_flipped_bit_of_a_records_own_header_loses_anything_unsaid(small):
    """Of a chunk's header, too: where its records end, the library believes the header."""
    data, path, whole = small.read_bytes(), small.with_name("flipped.mcap"), told_in(small)
    at = len(MCAP0_MAGIC)
    while at < len(data) - len(MCAP0_MAGIC):
        length = int.from_bytes(data[at + 1 : at + 9], "little")
        for bit in range(at % 29, 8 * min(60, 9 + length), 29):
            flipped = bytearray(data)
            flipped[at + bit // 8] ^= 1 << bit % 8
            path.write_bytes(flipped)
            recording = Recording(path)
            assert list(map(told, recording.messages())) == whole or recording.trouble(), (at, bit)
        at += 9 + length


def test_black_pictures_are_no_bomb(tmp_path):
    with writing(tmp_path / "black.mcap") as writer:
        state = encode(make_state(0, observation={"rgb": bytes(480 * 640 * 3)}))
        for _ in range(40):
            writer.write(heard("state", state))
    recording = Recording(tmp_path / "black.mcap")
    assert len(list(recording.messages())) == 80
    assert not recording.trouble()


MIB = 1 << 20
HEADER_BYTES = 17


def crafted(path, *chunks: tuple[bytes, int]):
    """A recording of chunks, each of its data and of what it announces to unpack to."""
    builder = RecordBuilder()
    builder.write(MCAP0_MAGIC)
    Header("", "").write(builder)
    for data, announced in chunks:
        Chunk("zstd", data, 0, 0, 0, announced).write(builder)
    path.write_bytes(builder.end())
    return path


@pytest.mark.parametrize("said_mib", [256, 1])
@pytest.mark.parametrize("tells_size", [True, False])
def test_a_bomb_is_passed_over(tmp_path, monkeypatch, said_mib, tells_size):
    """Whether the chunk says so itself, or its data alone do, or neither."""
    unpack = Mock(side_effect=records.breakup_chunk)
    monkeypatch.setattr(records, "breakup_chunk", unpack)
    zeros = zstandard.ZstdCompressor(write_content_size=tells_size).compress(bytes(256 * MIB))
    path = crafted(tmp_path / "bomb.mcap", *[(zeros, said_mib * MIB)] * 2)
    recording = Recording(path)
    assert list(recording.messages()) == []
    passed_over = recording.damaged_bytes + recording.torn_bytes
    assert passed_over == path.stat().st_size - len(MCAP0_MAGIC) - HEADER_BYTES
    assert not unpack.called or (said_mib, tells_size) == (1, False)


def test_the_work_is_bounded_by_the_size(tmp_path):
    """Empty messages cost work though they have hardly any bytes; so do beginnings of chunks."""
    builder = RecordBuilder()
    for _ in range(20_000):
        Message(channel_id=0, log_time=0, data=b"", publish_time=0, sequence=0).write(builder)
    data = builder.end()
    empty = crafted(tmp_path / "empty.mcap", *[(zstandard.compress(data), len(data))] * 20)
    lengths = range(1_000_000 // 45 * 45 - 9, 0, -45)  # Each as long as the rest of the file
    rest = bytes(28) + b"\x04\0\0\0zstd"
    chunks = b"".join(b"\x06" + length.to_bytes(8, "little") + rest for length in lengths)
    fake = tmp_path / "fake.mcap"
    fake.write_bytes(MCAP0_MAGIC + chunks)
    for path in (empty, fake):
        with pytest.raises(UserError, match="times its size"):
            list(Recording(path).messages())
