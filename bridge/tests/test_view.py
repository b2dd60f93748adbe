"""``python -m bridge view`` beside a real drive, and its pure parts."""

from __future__ import annotations

import shutil
import signal
import time

import msgspec
import pytest
import rerun as rr

from bridge.__main__ import main
from bridge.messages import Scene, Stamps, decode_scene, encode_scene
from bridge.ports import open_port
from bridge.rerun.wire_view import WireLog
from bridge.tests.harness import (
    LEFT_TURN,
    SLOW_TOY,
    BridgeProcess,
    flip_chunk,
    make_command,
    make_policy,
    rerun,
    start_edge,
    start_simulate,
)
from bridge.tests.toy import ToyEnv
from edge_runtime.tests.harness import make_state, wait_until
from edge_runtime.transport import free_endpoint


def verify(recording):
    """Fail unless rerun itself can read the recording; return what it holds."""
    rerun("rrd", "verify", str(recording))
    return rerun("rrd", "stats", str(recording))


def start_view(endpoint, path, *options):
    return BridgeProcess("view", "--save", str(path), "--connect", endpoint, *options)


def test_a_view_records_the_drive_and_ends_with_the_simulator(tmp_path):
    endpoint, recording = free_endpoint(), tmp_path / "drive.rrd"
    policy = make_policy(tmp_path, "constant")
    with (
        start_view(endpoint, recording) as view,
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY) as run,
    ):
        wait_until(lambda: list(tmp_path.glob(".drive.rrd*")), "the recording to begin")
        with start_edge(endpoint, policy):
            assert run.wait() == 0, run.errors
        assert view.wait(20) == 0, view.errors
    found = verify(recording)
    entities = ("frames/now", "road/ego/body", "action/asked", "latency/round_trip", "mode/mode")
    assert [entity for entity in entities if entity not in found] == []


@pytest.mark.parametrize("told", ["the view is interrupted", "the simulator is killed"])
def test_a_view_that_ends_early_keeps_what_it_recorded(told, tmp_path):
    endpoint, recording = free_endpoint(), tmp_path / "cut.rrd"
    with (
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY) as run,
        start_view(endpoint, recording) as view,
    ):
        wait_until(lambda: list(tmp_path.glob(".cut.rrd*")), "the recording to begin")
        time.sleep(0.3)
        assert not recording.exists()
        if told == "the view is interrupted":
            view.process.send_signal(signal.SIGTERM)
        else:
            run.process.kill()
        assert view.wait(20) == 0, view.errors
    verify(recording)
    assert list(tmp_path.glob(".cut*")) == []


def test_a_simulator_of_another_vehicle_is_one_line_and_no_file(tmp_path, refusal):
    endpoint, recording = free_endpoint(), tmp_path / "other.rrd"
    with open_port(endpoint, "other"):
        line = refusal("view", "--connect", endpoint, "--save", recording, "--wait-s", "0.2")
    assert "--vehicle-id" in line
    assert list(tmp_path.iterdir()) == []


def test_a_late_viewer_does_not_call_it_silence(monkeypatch):
    log = WireLog(rr.RecordingStream("test"))
    events = []
    monkeypatch.setattr(log, "_event", lambda text, *_: events.append(text))
    log.write_state(make_state(50), 10**18)
    assert events == []
    log.write_state(make_state(53), 10**18 + 3 * 10**8)
    assert events == ["no command: the simulator brakes by itself"]


def test_a_scene_survives_the_wire_with_numpy_numbers_inside():
    environment = ToyEnv()
    environment.reset(seed=1)
    stamps = Stamps(episode=2, step=3, sim_time_s=0.3, rejected={"stale": 2})
    scene = decode_scene(encode_scene(environment.scene(), stamps))
    assert scene is not None
    assert (scene.episode, scene.step, scene.vehicles[0].ego) == (2, 3, True)
    assert scene.path == [[0.0, 0.0], [14.0, 0.0]]


def test_a_recording_is_shown_without_a_drive(tmp_path, capsys):
    out = tmp_path / "left_turn.rrd"
    assert main(["view", str(LEFT_TURN), "--save", str(out)]) == 0
    found = verify(out)
    entities = ("frames/now", "road/ego/body", "road/roads", "action/asked", "latency/uplink",
                "latency/inference", "mode/reason", "rejected/edge/all")  # fmt: skip
    assert [entity for entity in entities if entity not in found] == []
    assert capsys.readouterr().out == f"wrote {out}\n"


def test_a_damaged_recording_is_shown_without_what_is_broken(tmp_path, capsys):
    damaged, out = tmp_path / "drive.mcap", tmp_path / "drive.rrd"
    shutil.copy(LEFT_TURN, damaged)
    flip_chunk(damaged, 3)
    assert main(["view", str(damaged), "--save", str(out)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "is damaged (1 damaged place of" in line
    assert "road/ego/body" in verify(out)


def keep_numbers(monkeypatch, log):
    """What the log draws as numbers from now on, by entity."""
    kept: dict[str, list[float]] = {}

    def keep(path, value):
        kept.setdefault(path, []).append(value)

    monkeypatch.setattr(log, "_scalar", keep)
    return kept


def make_scene(**fields):
    return Scene(episode=0, step=9, sim_time_s=0.9, **fields)


def test_a_round_trip_is_split_once_by_the_stamps_of_its_own_state(monkeypatch):
    log = WireLog(rr.RecordingStream("test"))
    kept = keep_numbers(monkeypatch, log)
    ms = 10**6
    for step in (3, 4):
        sent_ns = 10**18 + step * 100 * ms
        log.write_state(make_state(step, sent_ns=sent_ns), sent_ns)
        received_ns = sent_ns + (20 + step) * ms
        command = make_command(
            step, received_ns=received_ns, inference_ns=2 * ms, sent_ns=received_ns + 3 * ms
        )
        log.write_command(command, received_ns)
        repeated = msgspec.structs.replace(command, sent_ns=command.sent_ns + 100 * ms)
        log.write_command(repeated, received_ns + 100 * ms)
    # The newest command is that of step 4, but the round trip that is told is still step 3's.
    for _ in range(2):
        log.write_scene(make_scene(round_trip_ms=60.0, answered_step=3), 10**18)
    assert kept["latency/uplink"] == pytest.approx([23.0, 23.0, 24.0, 24.0])
    assert kept["latency/round_trip"] == [60.0, 60.0]
    assert kept["latency/downlink"] == pytest.approx([60.0 - 26.0])


def test_rejections_are_counted_by_side_and_reason(monkeypatch):
    log = WireLog(rr.RecordingStream("test"))
    kept = keep_numbers(monkeypatch, log)
    for count in (0, 2, 5):
        log.write_scene(make_scene(rejected={"stale": count}), 10**18)
    assert kept == {
        "rejected/simulator/all": [0, 2, 5],
        "rejected/simulator/stale": [0, 2, 5],  # From zero, so that the line shows the step.
    }


def test_live_pictures_are_at_most_ten_a_second(monkeypatch):
    drawn = []

    def draw(*_, **__):
        drawn.append(1)
        return rr.Clear(recursive=False)

    monkeypatch.setattr(rr, "Image", draw)
    for interval_s, expected in ((0.1, 2 * 11), (0.0, 2 * 101)):
        drawn.clear()
        log = WireLog(rr.RecordingStream("test"), interval_s)
        for step in range(101):  # A lock-step drive at ten times real time.
            log.write_state(make_state(step), 10**18 + step * 10**7)
        assert len(drawn) == pytest.approx(expected, abs=2)


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80", bytes(70_000)])
def test_what_is_no_scene_is_none(payload):
    assert decode_scene(payload) is None
