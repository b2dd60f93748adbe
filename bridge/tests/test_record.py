"""The recording's format, written and read without a wire."""

from __future__ import annotations

import collections
import contextlib
import resource
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zenoh
from mcap.reader import NonSeekingReader, make_reader

from bridge.messages import WIRE_TOPICS, Heard, Stamps, encode_scene
from bridge.ports import QUEUE_MESSAGES, WireListener
from bridge.record import RecordingWriter, _listen
from bridge.recording import Recording
from bridge.replay import RecordedDrive, replay_in_process
from bridge.tests.harness import (
    SLOW_TOY,
    BridgeProcess,
    bridge_status,
    make_command,
    make_policy,
    read,
    rerun,
    start_edge,
    start_simulate,
)
from bridge.tests.test_inbound import health
from edge_runtime.config import Config
from edge_runtime.link_probe import free_endpoint
from edge_runtime.policy import load_policy
from edge_runtime.tests.harness import PATIENCE_S, make_state, wait_until
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.wire import FRAMES_BYTES, MAX_PAYLOAD_BYTES, State, decode_state, encode

SECOND_NS = 10**9


def heard(topic: str, payload: bytes, arrived_ns: int = 1, key: str = "") -> Heard:
    return Heard(key or f"phil/v/{topic}", topic, payload, arrived_ns, len(payload))


def test_the_picture_is_what_the_policy_saw(tmp_path):
    frames = bytes(range(256)) * (FRAMES_BYTES // 256) + bytes(FRAMES_BYTES % 256)
    writer = RecordingWriter(tmp_path / "runs" / "a.mcap")
    writer.write(heard("state", encode(make_state(3, frames=frames)), arrived_ns=5 * SECOND_NS + 7))
    schema, _ = writer._schemas["RawImage"]
    writer.finish(dropped=0)
    writer.close()
    (data,) = (
        stored.message.data
        for stored in Recording(tmp_path / "runs" / "a.mcap").messages()
        if stored.channel.topic == "view/v/frames"
    )
    image = schema.make.FromString(data)
    assert (image.width, image.height, image.step, image.encoding) == (80, 90, 80, "mono8")
    assert (image.timestamp.seconds, image.timestamp.nanos) == (5, 7)
    assert image.data == frames


def test_what_cannot_be_read_is_kept_and_what_is_too_large_is_not(tmp_path):
    writer = RecordingWriter(tmp_path / "a.mcap")
    writer.write(heard("state", b"junk"))
    writer.write(Heard("phil/v/state", "state", b"", 2, MAX_PAYLOAD_BYTES + 1))
    writer.write(heard("alive", b"\x01"))
    writer.finish(dropped=3)
    writer.close()
    recording = Recording(tmp_path / "a.mcap")
    found = [(stored.channel.topic, stored.message.data) for stored in recording.messages()]
    assert ("phil/v/state", b"junk") in found
    assert ("phil/v/alive", b'{"here": true}') in found
    events = [data for topic, data in found if topic == "view/v/events"]
    assert b"unreadable" in events[0]
    assert b"65537 bytes" in events[1]
    assert recording.metadata == {"messages": "3", "dropped": "3"}


def test_no_payload_stops_the_recorder_or_a_replay(tmp_path):
    """Ints beyond 64 bits signed, and 3,000 mutated messages of every topic."""
    random = np.random.default_rng(1)
    good = [
        encode(make_state(1, episode=2**63)),
        encode(make_state(1)),
        encode(make_command(1)),
        encode(health(1, 2.0, stale=2**63)),
        encode_scene({"vehicles": []}, Stamps(1, 1, 0.1)),
    ]
    writer = RecordingWriter(tmp_path / "a.mcap")
    for number in range(3000):
        payload = bytearray(good[number % len(good)])
        for _ in range(number // 1000):
            payload[random.integers(len(payload))] = random.integers(256)
        topic = WIRE_TOPICS[(number // len(good)) % len(WIRE_TOPICS)]
        writer.write(heard(topic, bytes(payload), arrived_ns=number))
    writer.finish(dropped=0)
    writer.close()
    raw = [stored for stored in Recording(tmp_path / "a.mcap").messages() if stored.schema is None]
    assert len(raw) == 3000
    drive = RecordedDrive(tmp_path / "a.mcap", None)
    policy = load_policy(make_policy(tmp_path), allow_unsigned=True)
    assert ("here", 0, 1) in drive.exchanges
    replay_in_process(drive, policy, Config())


def test_an_empty_file_is_no_recording(tmp_path):
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(UserError, match="no MCAP recording"):
        list(Recording(tmp_path / "empty.mcap").messages())


def start_record(endpoint: str, path: Path, *options: str) -> BridgeProcess:
    """Start ``record`` and wait until it writes."""
    run = BridgeProcess("record", "--out", str(path), "--connect", endpoint, *options)
    # A file is made before its first bytes are in it.
    wait_until(lambda: path.exists() and path.stat().st_size > 0, "the recording to begin")
    return run


def states_in(path: Path) -> list[tuple[int, State]]:
    """Return the states of a recording with the times of their arrival (ns)."""
    found = []
    for stored in Recording(path).messages():
        if stored.channel.topic.endswith("/state") and stored.channel.message_encoding == "msgpack":
            state = decode_state(stored.message.data)
            assert isinstance(state, State)
            found.append((stored.message.log_time, state))
    return found


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A recorded drive in lock-step, and its report."""
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
    assert counts["phil/hunter01/state"] == counts["view/hunter01/frames"] == steps + 1
    assert counts["phil/hunter01/scene"] == counts["view/hunter01/scene"] == steps + 1
    assert counts["phil/hunter01/command"] >= steps
    assert counts["phil/hunter01/health"] >= 1
    assert counts["phil/hunter01/alive"] >= 1  # It came.
    assert counts["phil/hunter01/simulator"] == 2  # It came, and it went.
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
        wait_until(lambda: recording.exists() and len(states_in(recording)) > 10, "a second")
        assert bridge_status(["repair", str(recording)]) == 2  # Not while it grows.
        run.process.send_signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        run.process.wait()
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
    assert "is being written" in capsys.readouterr().err
    assert bridge_status(["repair", str(recording)]) == 0
    with recording.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        assert len(states_in(recording)) == len(states)
    assert bridge_status(["repair", str(recording)]) == 0
    assert "is whole" in capsys.readouterr().out


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.9, 0.999])
def test_a_torn_file_is_read_up_to_the_tear(drive, tmp_path, keep):
    recording, _ = drive
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recording.read_bytes()[: int(recording.stat().st_size * keep)])
    whole, part = states_in(recording), states_in(torn)
    assert part == whole[: len(part)]
    read_again = Recording(torn)
    collections.deque(read_again.messages(), maxlen=0)
    assert read_again.cut_off


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


def test_a_feed_that_falls_behind_drops_and_counts():
    feed, endpoint = WireListener(), free_endpoint()
    session = open_session(listen=endpoint, mode="router")
    try:
        subscriber = session.declare_subscriber("phil/v/state", feed.hearer("state"))
        for _ in range(QUEUE_MESSAGES + 5):
            session.put("phil/v/state", b"x", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: feed.dropped == 5, "the queue to be full")
        subscriber.undeclare()
    finally:
        session.close()
    assert feed.waiting == QUEUE_MESSAGES


class WithoutSimulator(WireListener):
    """An edge runtime behind a router, whose simulator has gone: it goes on saying how it is."""

    def __init__(self) -> None:
        super().__init__()
        self.simulator_gone.set()
        self.said = 0

    def next(self, timeout_s: float) -> Heard | None:
        time.sleep(0.005)
        self.said += 1
        if self.said > 1000:
            raise AssertionError("it listens on")
        return Heard("phil/car/health", "health", b"", 1, 0)


def test_a_recording_ends_though_an_edge_runtime_stays(tmp_path):
    writer = RecordingWriter(tmp_path / "drive.mcap")
    _listen(WithoutSimulator(), writer, SimpleNamespace(duration_s=None, linger_s=0.05))
    writer.finish(0)
    writer.close()
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
