"""Recordings: how they are written, cut off, and damaged."""

import collections
import contextlib
import inspect
import json
import math
import os
import re
import resource
import shutil
import signal
import time
import tracemalloc
from pathlib import Path
from typing import Any

import foxglove.messages
import msgspec
import numpy as np
import pytest
import zenoh
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, Header, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from bridge import ports, recording
from bridge.messages import DECODERS, Heard, Scene, encode_scene
from bridge.ports import QUEUE_MESSAGES, WireListener
from bridge.recording import (
    FOXGLOVE,
    FrameTransform,
    Log,
    RawImage,
    Recording,
    RecordingWriter,
    SceneUpdate,
    describe,
    whole_recording,
)
from bridge.replay import RecordedDrive, replay
from bridge.tests.recordings import chunks, flip, health, heard, start_record, verify_view
from edge_runtime.cli import quit_on_signals
from edge_runtime.config import Config
from edge_runtime.manifest import Entry, Task
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.wire import (
    MAX_STATE_BYTES,
    Command,
    Feedback,
    Health,
    State,
    decode_state,
    encode,
)
from hil_tests.processes import wait_until
from hil_tests.tests.shared.drives import (
    LEFT_TURN,
    SLOW_TOY,
    make_policy,
    read,
    start_edge,
    start_simulate,
)
from hil_tests.tests.shared.messages import make_command, make_state
from hil_tests.tests.shared.policies import SIZE, TASK

ODD = Task(task="", observation={"a": Entry(dtype="odd", shape=[1])}, action=[], control_period_s=1)
ROOT = Path(__file__).parents[2]
MIB = 1 << 20


def told_in(path):
    """Return topic, time and payload of every message."""
    found = Recording(path).messages()
    return [(channel.topic, message.log_time, message.data) for channel, message in found]


def states_in(path):
    """Return the states of a recording with the times of their arrival (ns)."""
    found = [
        (arrived_ns, decode_state(data))
        for topic, arrived_ns, data in told_in(path)
        if topic.startswith("phil/") and topic.endswith("/state")
    ]
    assert all(isinstance(state, State) for _, state in found)
    return found


def test_the_picture_is_what_the_policy_saw_and_may_have_the_name_of_a_message(tmp_path):
    frames = bytes(range(256)) * (SIZE // 256) + bytes(SIZE % 256)
    place: dict[str, Any] = {"episode": 0, "step": 3, "sim_time_s": 0.3}
    task = msgspec.structs.replace(TASK, observation={"state": TASK.observation["frames"]})
    with whole_recording(tmp_path / "runs" / "a.mcap") as writer:
        # It says how to read the states.
        writer.write(heard("scene", encode_scene({}, Scene(**place, task=task))))
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
    with whole_recording(tmp_path / "a.mcap") as writer:
        writer.write(heard("state", b"junk"))
        writer.write(Heard("phil/v/state", "state", b"", 2, MAX_STATE_BYTES + 1))
        writer.write(heard("alive", b"\x01"))
    found = [(topic, data) for topic, _, data in told_in(tmp_path / "a.mcap")]
    assert {("phil/v/state", b"junk"), ("phil/v/alive", b'{"here": true}')} <= set(found)
    events = [data for topic, data in found if topic == "view/v/events"]
    assert b"unreadable" in events[0]
    assert b"4194305 bytes" in events[1]


def test_no_payload_stops_the_recorder_or_a_replay(tmp_path):
    """Ints beyond 64 bits signed, and 3,000 mutated messages of every topic."""
    random = np.random.default_rng(1)
    good = [
        encode(make_state(1, episode=2**63)), encode(make_state(1)), encode(make_command(1)),
        encode(health(1, 2.0, stale=2**63)),
        encode_scene({"vehicles": []}, Scene(episode=1, step=1, sim_time_s=0.1)),
        encode_scene({}, Scene(episode=1, step=1, sim_time_s=0.1, task=ODD)),
    ]  # fmt: skip
    with whole_recording(tmp_path / "a.mcap") as writer:
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
    assert ("here", 0, 1) in drive.answers
    assert list(replay(drive, policy, Config()))


def test_everything_on_the_wire_is_recorded_and_mcap_reads_it(drive):
    recording, _, report = drive
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


def test_a_view_keeps_what_it_recorded_and_ends_with_the_simulator(drive):
    found = verify_view(drive[1])
    entities = ("frames/now", "road/ego/body", "action/asked", "latency/round_trip", "mode/mode")
    assert [one for one in entities if one not in found] == []
    assert list(drive[1].parent.glob(".drive*")) == []


COPIED = (State, Command, Health, Scene, RawImage, Log, SceneUpdate, FrameTransform)


@pytest.mark.parametrize("kind", COPIED)
def test_a_copy_has_the_fields_and_types_of_its_schema(kind, drive):
    name_of_kind, text = describe(kind)
    schema = msgspec.json.decode(text)
    assert schema["type"] == "object"  # Foxglove takes no other.
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
             "number": int | float, None: dict}  # fmt: skip
    with drive[0].open("rb") as stream:
        copies = [
            json.loads(message.data)
            for told, _, message in make_reader(stream).iter_messages()
            if told is not None and told.name == name_of_kind
        ]
    assert copies
    for copy in copies:
        for name, value in copy.items():
            assert isinstance(value, kinds[schema["properties"][name].get("type")]), name


def check_schema(schema):
    """Fail at what Foxglove's readers do not know, such as references."""
    assert set(schema) <= {"type", "properties", "items", "contentEncoding"}
    if schema["type"] == "array":
        check_schema(schema["items"])
    elif schema["type"] == "object":
        for part in schema["properties"].values():
            check_schema(part)
    else:
        assert schema["type"] in ("string", "number", "integer", "boolean")


def test_foxglove_can_read_every_schema_and_knows_the_fields_of_its_own():
    for kind in {*COPIED, *FOXGLOVE}:
        check_schema(msgspec.json.decode(describe(kind)[1]))
    kinds = [
        kind
        for kind in vars(recording).values()
        if isinstance(kind, type(msgspec.Struct)) and hasattr(foxglove.messages, kind.__name__)
    ]
    assert {*FOXGLOVE} <= {*kinds}
    for kind in kinds:
        official = inspect.signature(getattr(foxglove.messages, kind.__name__))
        assert {*kind.__struct_fields__} <= {*official.parameters}, kind


def test_the_road_is_drawn_as_on_a_map(tmp_path):
    """y grows upwards there, and downwards in the scene."""
    car: dict[str, Any] = {"x": 1.0, "y": 2.0, "length_m": 4.0, "width_m": 2.0, "ego": True}
    scene: dict[str, Any] = {"roads": [[[0.0, 0.0], [0.0, 9.0]]], "goal": [3.0, 4.0]}
    place: dict[str, Any] = {"episode": 0, "step": 3, "sim_time_s": 0.3}
    scene["vehicles"] = [{**car, "heading_rad": math.pi / 2}]
    with whole_recording(tmp_path / "a.mcap") as writer:
        writer.write(heard("scene", encode_scene(scene, Scene(**place)), 5 * 10**9 + 7))
    found = {topic: msgspec.json.decode(data) for topic, _, data in told_in(tmp_path / "a.mcap")
             if topic.startswith("view/")}  # fmt: skip
    assert found["view/v/ego"]["translation"] == {"x": 1.0, "y": -2.0, "z": 0.0}
    (entity,) = found["view/v/road"]["entities"]
    assert entity["timestamp"] == {"sec": 5, "nsec": 7}
    assert [point["y"] for point in entity["lines"][0]["points"]] == [0.0, -9.0]
    _, _, goal, ego, _ = entity["lines"]
    assert [(point["x"], point["y"]) for point in goal["points"]] == [(2.5, -4.0), (3.5, -4.0)]
    assert ego["thickness"] == 2.0
    ends = [value for point in ego["points"] for value in (point["x"], point["y"])]
    assert ends == pytest.approx([1.0, -1.0, 1.0, -3.0])  # Round ends, of a metre each


@pytest.mark.parametrize("keep", [0.2, 0.9, 0.999])
def test_a_torn_file_is_read_up_to_the_tear(drive, tmp_path, keep):
    recording, *_ = drive
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recording.read_bytes()[: int(recording.stat().st_size * keep)])
    whole, part = states_in(recording), states_in(torn)
    assert part == whole[: len(part)]
    read_again = Recording(torn)
    collections.deque(read_again.messages(), maxlen=0)
    assert (read_again.cut_off, read_again.damaged_places) == (True, 0)


def test_a_kill_loses_little_and_a_full_disk_nothing_that_was_written(tmp_path):
    """Half a second at most on an idle machine.

    A limit on the file's size stands in for the disk: the same error path of write(2).
    """
    endpoint, cut, full = free_endpoint(), tmp_path / "cut.mcap", tmp_path / "full.mcap"
    out = tmp_path / "r.json"
    with (
        start_simulate(endpoint, out, SLOW_TOY, "--episodes", "2") as run,
        start_record(endpoint, cut) as killed,
        start_record(endpoint, full) as recorder,
        start_edge(endpoint, make_policy(tmp_path)),
    ):
        wait_until(lambda: len(states_in(cut)) > 10 and states_in(full), "a second")
        written, size = states_in(full), full.stat().st_size + 100
        resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (size, size))
        time.sleep(0.7)  # Just after a flush there would be nothing to lose.
        killed.send(signal.SIGKILL)
        killed_ns = time.time_ns()
        assert recorder.wait() == 1, recorder.errors
        assert run.wait() == 0, run.errors
    states = states_in(cut)
    assert (killed_ns - states[-1][0]) * 1e-9 < 2.0
    places = [(state.episode, state.step) for _, state in states]
    assert places == [divmod(number, 61) for number in range(len(places))]
    (line,) = recorder.errors.splitlines()
    assert "File too large" in line
    assert states_in(full)[: len(written)] == written
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
    listener, path = WireListener(), tmp_path / "a.mcap"
    monkeypatch.setattr(listener, "next", lambda _: heard("state", encode(make_state(0))))

    with whole_recording(path) as writer, quit_on_signals(listener.stopped.set):
        copy = writer._copies.write

        def signalled(one):
            signal.raise_signal(signal.SIGTERM)
            copy(one)

        monkeypatch.setattr(writer._copies, "write", signalled)
        ports._listen(listener, writer, 9.0)
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
    with whole_recording(tmp_path / "drive.mcap") as writer:
        ports._listen(listener, writer, 0.05)
    assert writer.messages > 0


def messages_of(index):
    """How many messages a chunk of the undamaged file holds."""
    with LEFT_TURN.open("rb") as stream:
        stream.seek(index.chunk_start_offset)
        record: Any = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
    return sum(isinstance(part, Message) for part in breakup_chunk(record, True))


@pytest.mark.parametrize("number", [0, 3, -1])
def test_only_the_damaged_chunk_is_lost(tmp_path, number):
    """The first one names most of the topics."""
    copy = Path(shutil.copy(LEFT_TURN, tmp_path))
    index = chunks(copy)[number]
    flip(copy, index.chunk_start_offset + index.chunk_length // 2)
    sizes, whole = list(map(messages_of, chunks(LEFT_TURN))), told_in(LEFT_TURN)
    first = sum(sizes[:number])
    assert told_in(copy) == whole[:first] + whole[first + sizes[number] :]
    recording = Recording(copy)
    assert list(recording.messages())
    assert (recording.cut_off, recording.damaged_places) == (False, 1)


def test_what_is_no_recording_is_refused_and_nobody_waits_for_a_pipe(tmp_path, refusal):
    pipe, empty = tmp_path / "pipe", tmp_path / "empty.mcap"
    os.mkfifo(pipe)
    empty.touch()
    for path, says in ((pipe, "no regular file"), (empty, "no MCAP recording")):
        assert says in refusal("view", path, "--save", tmp_path / "out.rrd")


def test_no_change_of_bytes_makes_a_message_or_loses_one_unsaid(tmp_path):
    """In two chunks and an index: each kind of record that `record` writes."""
    small, path = tmp_path / "small.mcap", tmp_path / "changed.mcap"
    payloads = {"state": encode(make_state(1)), "command": encode(make_command(1))}
    with whole_recording(small) as writer:
        for number, (topic, payload) in enumerate(payloads.items()):
            writer.write(heard(topic, payload, number))
            writer.flush()
    data, whole = small.read_bytes(), told_in(small)
    for at in range(len(MCAP0_MAGIC), len(data) - 9, 61):
        flipped = bytes(byte ^ 0xFF for byte in data[at : at + 10])
        for new in (flipped, bytes(10), flipped[: at % 9 + 1]):
            path.write_bytes(data[:at] + new + data[at + len(new) :])
            recording = Recording(path)
            found = [(channel.topic, m.log_time, m.data) for channel, m in recording.messages()]
            assert set(found) <= set(whole), at
            assert found == whole or recording.cut_off or recording.damaged_places, at


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
def test_a_bomb_is_passed_over(tmp_path, said_mib, tells_size):
    """Whether the chunk says so itself, or its data alone do, or neither."""
    zeros = zstandard.ZstdCompressor(write_content_size=tells_size).compress(bytes(256 * MIB))
    path = crafted(tmp_path / "bomb.mcap", *[(zeros, said_mib * MIB)] * 2)
    recording = Recording(path)
    tracemalloc.start()
    try:
        assert list(recording.messages()) == []
        assert tracemalloc.get_traced_memory()[1] < 40 * MIB
    finally:
        tracemalloc.stop()
    assert recording.damaged_places == 2


def test_the_layout_for_foxglove_names_what_a_recording_holds(drive):
    layout = json.loads((ROOT / "docs" / "foxglove.json").read_text())
    text = json.dumps(layout["configById"])
    named = set(re.findall(r"view/hunter01/\w+", text))
    topics = {topic for topic, _, _ in told_in(drive[0])}
    # A drive without a vehicle and without a policy in the shadow has neither's.
    assert named - topics == {"view/hunter01/feedback", "view/hunter01/shadow"}
    placed = re.findall(r'"(\w+!\w+)"', json.dumps(layout["layout"]))
    assert sorted(placed) == sorted(layout["configById"])
    schemas = {"state": State, "command": Command, "scene": Scene, "shadow": Command}
    for topic, field in re.findall(r"view/hunter01/(\w+)\.(\w+)", text):
        kind = schemas.get(topic, Feedback)
        assert field in msgspec.json.decode(describe(kind)[1])["properties"]
