"""What both views share: geometry, timelines, pace, and where a recording goes."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time

import pytest
import rerun as rr
import rerun.blueprint as rrb
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader

import bridge.rerun
from bridge.messages import Pace, SeenCar, SeenScene, read_scene
from bridge.rerun import Sink, check_sink, flush, free_port, open_sink, read_sink
from bridge.rerun.draw import outline, view_bounds
from bridge.rerun.wire_view import Timeline
from bridge.tests.viewers import NO_GPU, in_place, listens
from edge_runtime.util import UserError


def test_a_car_that_heads_down_the_picture_is_long_in_y():
    car = SeenCar(x=5.0, y=2.0, heading_rad=math.pi / 2, length_m=4.0, width_m=2.0)
    xs, ys = zip(*outline(car), strict=True)
    assert (min(xs), max(xs)) == pytest.approx((4.0, 6.0))
    assert (min(ys), max(ys)) == pytest.approx((0.0, 4.0))
    x_range, y_range = view_bounds(SeenScene(vehicles=[car]))
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


def test_a_car_far_from_the_path_does_not_shrink_the_picture():
    def bounds(x):
        car = SeenCar(x=x, y=0.0, heading_rad=0.0, length_m=4.0, width_m=2.0)
        return view_bounds(SeenScene(path=[[0.0, 0.0], [10.0, 0.0]], vehicles=[car]))

    assert bounds(-60.0) == bounds(5.0)
    assert bounds(-15.0)[0][0] == pytest.approx(bounds(5.0)[0][0] - 15.0)


def test_a_scene_is_read_without_what_is_not_drawn():
    scene = {
        "roads": [[[0.0, 0.0], [9.0, 0.0]]],
        "goal": [9.0, 0.0],
        "stop_line": [1.0, 2.0],
        "vehicles": [{"id": 7, "x": 1.0, "y": 2.0, "heading_rad": 0.0, "length_m": 4.0,
                      "width_m": 2.0, "speed_mps": 3.0, "ego": True}],
    }  # fmt: skip
    seen = read_scene(scene)
    assert (seen.roads, seen.goal, seen.path) == ([[[0.0, 0.0], [9.0, 0.0]]], [9.0, 0.0], ())
    assert seen.vehicles == [SeenCar(1.0, 2.0, 0.0, 4.0, 2.0, ego=True)]


@given(st.lists(st.floats(0, 0.2), min_size=1, max_size=300), st.floats(1, 100))
def test_no_rate_is_passed(steps, rate_hz):
    pace, now_s, passed = Pace(1.0 / rate_hz), 0.0, 0
    for step in steps:
        now_s += step
        passed += pace.due(now_s)
    assert passed <= rate_hz * now_s + 2
    assert pace.skipped == len(steps) - passed


@given(st.lists(st.floats(-0.02, 0.02), min_size=50, max_size=200))
def test_jitter_at_the_rate_itself_costs_nothing(jitters):
    pace = Pace(0.05)
    assert all(pace.due(step * 0.05 + jitter) for step, jitter in enumerate(jitters))


def test_what_comes_faster_is_thinned_out_and_a_pause_brings_no_burst():
    pace = Pace(0.1)
    assert sum(pace.due(0.01 * n) for n in range(1000)) == pytest.approx(100, abs=2)
    assert sum(pace.due(60.0 + 0.01 * n) for n in range(100)) == pytest.approx(10, abs=2)


def test_an_interval_of_zero_takes_all():
    pace = Pace(0.0)
    assert all(pace.due(now_s) for now_s in [0.0, 0.0, 5.0, 5.0, 4.0])


def opened(kind, path=""):
    return open_sink(Sink(kind, str(path)), "test", rrb.Blueprint())


def test_sigterm_finishes_the_file(tmp_path):
    out = tmp_path / "a.rrd"

    with pytest.raises(KeyboardInterrupt), opened("save", out) as recording:  # noqa: PT012
        recording.log("speed", rr.Scalars(3.0))
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5.0)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
    found = [chunk.entity_path for chunk in RrdReader(str(out)).stream().to_chunks()]
    assert "/speed" in found


def test_a_link_to_a_file_stays_and_the_file_is_written(tmp_path):
    target, link = tmp_path / "kept.rrd", tmp_path / "link.rrd"
    link.symlink_to(target)
    with opened("save", link):
        pass
    assert link.is_symlink()
    assert target.stat().st_size > 0


def test_the_folder_of_a_file_is_made(tmp_path):
    path = tmp_path / "runs" / "today" / "drive.rrd"
    check_sink(Sink("save", str(path)))
    assert not path.parent.exists()
    with opened("save", path):
        pass
    assert path.stat().st_size > 0


def test_a_command_with_another_use_for_sigterm_keeps_it(tmp_path):
    def quit_softly(*_):
        pass

    before = signal.signal(signal.SIGTERM, quit_softly)
    try:
        with opened("save", tmp_path / "a.rrd"):
            assert signal.getsignal(signal.SIGTERM) is quit_softly
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_sink_is_named_by_a_word():
    assert read_sink("spawn") == Sink("spawn")
    assert read_sink("serve").is_live
    assert read_sink("a/b.rrd") == Sink("save", "a/b.rrd")
    with pytest.raises(UserError, match="neither spawn nor serve"):
        read_sink("window")


def show(kind, for_s=0.0):
    with opened(kind) as recording:
        end_s = time.monotonic() + for_s
        while not for_s or time.monotonic() < end_s:
            recording.log("speed", rr.Scalars(3.0))
            flush(recording)
            if not for_s:
                break
        return recording


@pytest.mark.parametrize("kind", ["starts slowly", "works"])
def test_a_page_is_told_of_when_it_answers(kind, tmp_path, monkeypatch, capsys):
    with in_place(kind, tmp_path, monkeypatch), opened("serve") as recording:
        (address,) = re.findall(r"http://([\d.]+):(\d+)/", capsys.readouterr().out)
        assert listens(*address)
        assert listens("127.0.0.1", bridge.rerun.GRPC_PORT)
        assert not listens("127.0.0.2", bridge.rerun.GRPC_PORT), "loopback's first address only"
        recording.log("speed", rr.Scalars(3.0))
    end_s = time.monotonic() + 5.0
    while listens(*address):
        assert time.monotonic() < end_s, "it ends with the command"


def test_a_window_listens_on_loopback_only_and_stays_open(tmp_path, monkeypatch):
    ports = [free_port(), free_port()]
    monkeypatch.setattr(bridge.rerun, "free_port", iter(ports).__next__)
    with in_place("works", tmp_path, monkeypatch):
        show("spawn")
        show("spawn")
        assert len(set(ports)) == 2, "each its own"
        assert [listens("127.0.0.1", port) for port in ports] == [True, True]
        assert [listens("127.0.0.2", port) for port in ports] == [False, False]


@pytest.mark.parametrize("where", ["spawn", "serve"])
@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("ends at once", NO_GPU),
        ("never listens", "does not listen after 1 s"),
        ("is killed", "it was closed"),
        ("hangs", "timed out"),
    ],
)
def test_a_viewer_that_is_gone_is_one_plain_error(where, kind, why, tmp_path, monkeypatch):
    with (
        in_place(kind, tmp_path, monkeypatch),
        pytest.raises(UserError, match=f"viewer gone: .*{why}"),
    ):
        show(where, for_s=5.0)


def test_what_the_trainer_takes_loads_neither_zenoh_nor_rerun():
    """A scenario needs a colour of the view, and not the view; an evaluation needs no network."""
    taken = ("messages", "network", "recording", "report", "virtual_link", "rerun")
    code = "import sys\n" + "".join(f"import bridge.{name}\n" for name in taken)
    code += "assert not {'zenoh', 'rerun', 'gymnasium'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
