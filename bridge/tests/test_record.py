"""How recordings are written, cut off by a kill, a full disk or a signal, and read by others."""

import collections
import contextlib
import os
import resource
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
from mcap.reader import NonSeekingReader, make_reader

from bridge.messages import WIRE_TOPICS, Heard, Scene, encode_scene
from bridge.ports import QUEUE_MESSAGES, WireListener
from bridge.record import RawImage, RecordingWriter, _listen, describe
from bridge.recording import Recording, Stored
from bridge.replay import RecordedDrive, replay_in_process
from bridge.tests.harness import (
    SLOW_TOY,
    BridgeProcess,
    bridge_status,
    chunks,
    make_command,
    make_policy,
    read,
    rerun,
    start_edge,
    start_simulate,
)
from bridge.tests.test_inbound import health
from edge_runtime.cli import quit_on_signals
from edge_runtime.config import Config
from edge_runtime.manifest import Entry, Task
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.tests.harness import PATIENCE_S, make_state, wait_until
from edge_runtime.tests.policies import SIZE, TASK
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_STATE_BYTES, State, decode_state, encode

ODD = Task(task="", observation={"a": Entry(dtype="odd", shape=[1])}, action=[], control_period_s=1)


def heard(topic: str, payload: bytes, arrived_ns: int = 1) -> Heard:
    return Heard(f"phil/v/{topic}", topic, payload, arrived_ns, len(payload))


def told(stored: Stored) -> tuple[str, int, bytes]:
    return stored.channel.topic, stored.message.log_time, stored.message.data


def told_in(path: Path) -> list[tuple[str, int, bytes]]:
    return list(map(told, Recording(path).messages()))


@contextlib.contextmanager
def writing(path: Path, dropped: int = 0):
    with contextlib.closing(RecordingWriter(path)) as writer:
        yield writer
        writer.finish(dropped)


def test_the_picture_is_what_the_policy_saw(tmp_path):
    frames = bytes(range(256)) * (SIZE // 256) + bytes(SIZE % 256)
    path = tmp_path / "runs" / "a.mcap"
    with writing(path) as writer:
        told = encode_scene({}, Scene(episode=0, step=3, sim_time_s=0.3, task=TASK))
        writer.write(heard("scene", told))  # it says how to read the states
        state = encode(make_state(3, observation={"frames": frames}))
        writer.write(heard("state", state, arrived_ns=5 * 10**9 + 7))
    (data,) = (data for topic, _, data in told_in(path) if topic == "view/v/frames")
    image = describe(RawImage).make.FromString(data)
    assert (image.width, image.height, image.step, image.encoding) == (80, 90, 80, "mono8")
    assert (image.timestamp.seconds, image.timestamp.nanos) == (5, 7)
    assert image.data == frames


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
            topic = WIRE_TOPICS[(number // len(good)) % len(WIRE_TOPICS)]
            writer.write(heard(topic, bytes(payload), arrived_ns=number))
    raw = [stored for stored in Recording(tmp_path / "a.mcap").messages() if stored.schema is None]
    assert len(raw) == 3000
    drive = RecordedDrive(tmp_path / "a.mcap", None)
    policy = load_policy(make_policy(tmp_path), allow_unsigned=True)
    assert ("here", 0, 1) in drive.exchanges
    replay_in_process(drive, policy, Config())


def start_record(endpoint: str, path: Path, *options: str) -> BridgeProcess:
    run = BridgeProcess("record", "--out", str(path), "--connect", endpoint, *options)
    # A file is made before its first bytes are in it.
    wait_until(lambda: path.exists() and path.stat().st_size > 0, "the recording to begin")
    return run


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
    folder, endpoint = tmp_path_factory.mktemp("drive"), free_endpoint()
    recording, out = folder / "drive.mcap", folder / "r.json"
    with (
        start_simulate(endpoint, out, SLOW_TOY) as run,
        start_record(endpoint, recording) as recorder,
        start_edge(endpoint, make_policy(folder)),
    ):
        assert run.wait() == 0, run.errors
        assert recorder.wait(PATIENCE_S) == 0, recorder.errors
    return recording, read(out)


def test_everything_on_the_wire_is_recorded_and_mcap_reads_it(drive):
    recording, report = drive
    steps = report["per_episode"][0]["steps"]
    counts: collections.Counter[str] = collections.Counter()
    with recording.open("rb") as stream:
        for _, channel, _ in make_reader(stream, validate_crcs=True).iter_messages():
            counts[channel.topic] += 1
    name = "hunter01"
    for topic in ("phil/{}/state", "phil/{}/scene", "view/{}/frames", "view/{}/scene"):
        assert counts[topic.format(name)] == steps + 1
    for topic, least in (("command", steps), ("health", 1), ("alive", 1)):  # The last: it came.
        assert counts[f"phil/{name}/{topic}"] >= least
    assert counts[f"phil/{name}/simulator"] == 2  # It came, and it went.
    assert [state.step for _, state in states_in(recording)] == list(range(steps + 1))


def test_rerun_draws_frames_texts_and_values(drive, tmp_path):
    recording, _ = drive
    drawn = tmp_path / "drive.rrd"
    rerun("mcap", "convert", str(recording), "-o", str(drawn))
    found = rerun("rrd", "stats", str(drawn))
    parts = ("/view/hunter01/frames", "Image:buffer", "TextLog:text", "phil.Command:message")
    assert [part for part in parts if part not in found] == []


def record_and_kill(folder: Path) -> tuple[Path, float]:
    """Kill a recorder of a drive in real time; the file, and how many seconds it has lost."""
    endpoint, recording = free_endpoint(), folder / f"cut-{time.monotonic_ns()}.mcap"
    with (
        start_simulate(endpoint, folder / "r.json", SLOW_TOY, "--clock", "realtime"),
        start_record(endpoint, recording) as run,
        start_edge(endpoint, make_policy(folder)),
    ):
        wait_until(lambda: len(states_in(recording)) > 10, "a second")
        for options in ([], ["--out", str(folder / "other.mcap")]):  # Not while it grows.
            assert bridge_status(["repair", str(recording), *options]) == 2
        run.process.send_signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        run.process.wait()
    assert not (folder / "other.mcap").exists()
    return recording, (killed_ns - states_in(recording)[-1][0]) * 1e-9


def test_a_kill_loses_at_most_the_last_second_and_repair_gives_the_index_back(tmp_path, capsys):
    for _ in range(4):  # On a busy machine no state may come, or be written, for over a second.
        recording, lost_s = record_and_kill(tmp_path)
        if lost_s < 1.0:
            break
    assert lost_s < 1.0
    states = states_in(recording)
    assert [state.step for _, state in states] == list(range(len(states)))
    # The library's own reader for streams gets as far, and then finds the end missing.
    with recording.open("rb") as stream, contextlib.suppress(Exception):
        count = 0
        for _ in NonSeekingReader(stream).iter_messages(
            "phil/hunter01/state", log_time_order=False
        ):
            count += 1
    assert count == len(states)
    assert capsys.readouterr().err.count("is being written") >= 2
    assert bridge_status(["repair", str(recording)]) == 0
    assert chunks(recording)
    assert len(states_in(recording)) == len(states)
    assert bridge_status(["repair", str(recording)]) == 0
    assert "is whole" in capsys.readouterr().out


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.9, 0.999])
def test_a_torn_file_is_read_up_to_the_tear(drive, tmp_path, keep, repair):
    recording, _ = drive
    torn = tmp_path / "torn.mcap"
    first = chunks(recording)[0]
    whole_to = first.chunk_start_offset + first.chunk_length  # Else there is nothing to repair.
    cut = max(whole_to + 1, int(recording.stat().st_size * keep))
    torn.write_bytes(recording.read_bytes()[:cut])
    whole, part = states_in(recording), states_in(torn)
    assert part == whole[: len(part)]
    read_again = Recording(torn)
    collections.deque(read_again.messages(), maxlen=0)
    assert read_again.cut_off
    said = repair(torn)
    assert "a torn end of" in said or keep > 0.99  # Only the index is torn.
    assert states_in(torn) == part


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
        resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (full, full))
        assert recorder.wait() == 1, recorder.errors
        assert run.wait() == 0, run.errors
    (line,) = recorder.errors.splitlines()
    assert "File too large" in line
    assert "repair" in line
    assert states_in(recording)[: len(written)] == written
    assert read(out)["per_episode"][0]["steps"] == 60  # The loop went on to its end.


def test_a_disk_that_is_full_at_the_start_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "write", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(UserError, match=r"cannot write .*a.mcap: No space left"):
        RecordingWriter(tmp_path / "a.mcap")
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


def test_a_picture_may_have_the_name_of_a_message(tmp_path):
    frames = Entry(dtype="uint8", shape=[2, 45, 80])
    task = msgspec.structs.replace(TASK, observation={"state": frames})
    scene = Scene(episode=0, step=3, sim_time_s=0.3, task=task)
    with writing(tmp_path / "a.mcap") as writer:
        writer.write(heard("scene", encode_scene({}, scene)))
        writer.write(heard("state", encode(make_state(3, observation={"state": bytes(SIZE)}))))
    with (tmp_path / "a.mcap").open("rb") as stream:
        found = [
            (channel.topic, schema.name)
            for schema, channel, _ in make_reader(stream).iter_messages()
            if schema is not None and channel.topic == "view/v/state"
        ]
    assert sorted(name for _, name in found) == ["foxglove.RawImage", "phil.State"]


def test_a_feed_that_falls_behind_drops_and_counts():
    feed, endpoint = WireListener(), free_endpoint()
    with contextlib.closing(open_session(listen=endpoint, mode="router")) as session:
        subscriber = session.declare_subscriber("phil/v/state", feed.hearer("state"))
        for _ in range(QUEUE_MESSAGES + 5):
            session.put("phil/v/state", b"x", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: feed.dropped == 5, "the queue to be full")
        subscriber.undeclare()
    assert feed.waiting == QUEUE_MESSAGES


def test_a_recording_ends_though_an_edge_runtime_stays(tmp_path, monkeypatch):
    """It is behind a router, its simulator has gone, and it goes on saying how it is."""
    listener = WireListener()
    listener.simulator_gone.set()
    said = iter([Heard("phil/car/health", "health", b"", 1, 0)] * 1000)

    def hear(_timeout_s):
        time.sleep(0.005)
        return next(said)  # They come to an end where it listens on.

    monkeypatch.setattr(listener, "next", hear)
    with writing(tmp_path / "drive.mcap") as writer:
        _listen(listener, writer, SimpleNamespace(duration_s=None, linger_s=0.05), Event())
    assert writer.messages > 0


def test_a_simulator_that_comes_back_is_recorded_into_the_same_file(tmp_path):
    endpoint, recording = free_endpoint(), tmp_path / "both.mcap"
    policy = make_policy(tmp_path, "constant")
    with start_edge(endpoint, policy):
        with start_simulate(endpoint, tmp_path / "1.json", SLOW_TOY) as first:
            recorder = start_record(endpoint, recording, "--linger-s", "10")
            wait_until(lambda: len(states_in(recording)) > 5, "the first drive")
            first.process.kill()
        with recorder, start_simulate(endpoint, tmp_path / "2.json", SLOW_TOY) as second:
            assert second.wait() == 0, second.errors
            recorder.process.send_signal(signal.SIGTERM)
            assert recorder.wait(PATIENCE_S) == 0, recorder.errors
    sessions = {state.session for _, state in states_in(recording)}
    assert len(sessions) == 2
