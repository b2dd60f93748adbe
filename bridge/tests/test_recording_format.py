"""The recording's format, written and read without a wire."""

from __future__ import annotations

import numpy as np
import pytest

from bridge.feed import WIRE_TOPICS, Heard
from bridge.recording.reader import Recording
from bridge.recording.writer import RecordingWriter
from bridge.replaying.in_process import replay_in_process
from bridge.replaying.recorded import RecordedDrive
from bridge.scene import Stamps, encode_scene
from bridge.tests.commands import make_command
from bridge.tests.processes import make_policy
from bridge.tests.test_edge_counts import health
from edge_runtime.config import Config
from edge_runtime.policy import load_policy
from edge_runtime.tests.harness import make_state
from edge_runtime.util import UserError
from edge_runtime.wire import FRAMES_BYTES, MAX_PAYLOAD_BYTES, encode

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
