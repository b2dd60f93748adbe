"""``python -m bridge view`` beside a real drive, and its pure parts."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time

import pytest
import rerun as rr

from bridge.port import open_port
from bridge.scene import Scene, SceneVehicle, decode_scene, encode_scene
from bridge.tests.processes import (
    SLOW_TOY,
    BridgeProcess,
    make_policy,
    refuse,
    start_edge,
    start_simulate,
)
from bridge.tests.toy import ToyEnv
from bridge.viewer.shapes import outline, view_bounds
from bridge.viewer.timeline import Timeline
from bridge.viewer.wire_log import WireLog
from edge_runtime.tests.harness import make_state, wait_until
from edge_runtime.transport import free_endpoint


def verify(recording):
    """Fail unless rerun itself can read the recording; return what it holds."""
    rerun = [sys.executable, "-m", "rerun", "rrd"]
    subprocess.run([*rerun, "verify", str(recording)], check=True, capture_output=True, timeout=60)
    stats = subprocess.run(
        [*rerun, "stats", str(recording)], check=True, capture_output=True, timeout=60, text=True
    )
    return stats.stdout


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


def test_an_interrupted_view_keeps_what_it_recorded(tmp_path):
    endpoint, recording = free_endpoint(), tmp_path / "cut.rrd"
    with (
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY),
        start_view(endpoint, recording) as view,
    ):
        wait_until(lambda: list(tmp_path.glob(".cut.rrd*")), "the recording to begin")
        time.sleep(0.3)
        assert not recording.exists()
        view.process.send_signal(signal.SIGTERM)
        assert view.wait(20) == 0, view.errors
    verify(recording)
    assert list(tmp_path.glob(".cut*")) == []


def test_a_killed_simulator_ends_the_view(tmp_path):
    endpoint, recording = free_endpoint(), tmp_path / "left.rrd"
    with (
        start_simulate(endpoint, tmp_path / "r.json", SLOW_TOY) as run,
        start_view(endpoint, recording) as view,
    ):
        wait_until(lambda: list(tmp_path.glob(".left.rrd*")), "the recording to begin")
        time.sleep(0.3)
        run.process.kill()
        assert view.wait(20) == 0, view.errors
    verify(recording)


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (["--save", "never.rrd", "--wait-s", "0"], "nobody answers"),
        ([], "no display"),
        (["--save", "/no/such/folder/a.rrd"], "does not exist"),
        (["--vehicle-id", "a/b"], "vehicle id"),
        (["--save", "a.rrd", "--serve"], "not allowed with"),
    ],
)
def test_bad_input_is_one_line_and_status_2(options, part, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert refuse(["view", "--connect", free_endpoint(), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line


def test_a_simulator_of_another_vehicle_is_one_line_and_no_file(tmp_path, capsys):
    endpoint, recording = free_endpoint(), tmp_path / "other.rrd"
    with open_port(endpoint, "other"):
        options = ["--connect", endpoint, "--save", str(recording), "--wait-s", "0.2"]
        assert refuse(["view", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
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
    scene = decode_scene(encode_scene(environment.scene(), episode=2, step=3, sim_time_s=0.3))
    assert scene is not None
    assert (scene.episode, scene.step, scene.vehicles[0].ego) == (2, 3, True)
    assert scene.path == [[0.0, 0.0], [14.0, 0.0]]


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80", bytes(70_000)])
def test_what_is_no_scene_is_none(payload):
    assert decode_scene(payload) is None


def test_a_car_that_heads_down_the_picture_is_long_in_y():
    car = SceneVehicle(
        id=1, x=5.0, y=2.0, heading_rad=math.pi / 2, length_m=4.0, width_m=2.0, speed_mps=0.0
    )
    xs, ys = zip(*outline(car), strict=True)
    assert (min(xs), max(xs)) == pytest.approx((4.0, 6.0))
    assert (min(ys), max(ys)) == pytest.approx((0.0, 4.0))
    x_range, y_range = view_bounds(Scene(episode=0, step=0, sim_time_s=0.0, vehicles=[car]))
    assert x_range[0] < 4.0 < 6.0 < x_range[1]
    assert y_range[0] < 0.0 < 4.0 < y_range[1]


def test_episodes_stand_end_to_end():
    timeline = Timeline()
    assert timeline.place(0, 0).total_step == 0
    assert timeline.place(0, 7).total_step == 7
    assert timeline.place(1, 0).total_step == 8
    assert timeline.place(0, 5).total_step == 5
    late = timeline.place(1, 2)
    assert (late.episode_time_s, late.sim_time_s) == (0.2, 1.0)
    assert timeline.now == late
