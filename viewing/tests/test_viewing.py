"""What both views share: geometry, timelines, pace, and where a recording goes."""

from __future__ import annotations

import math
import os
import signal
import time

import pytest
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from edge_runtime.util import UserError
from viewing.pace import Pace
from viewing.scene import SeenCar, SeenScene, read_scene
from viewing.shapes import outline, view_bounds
from viewing.sinks import Sink, check_sink, open_sink, read_sink
from viewing.timeline import Timeline


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
    assert timeline.now == late


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


@pytest.mark.parametrize("jitter_s", [0.0, 0.02])
def test_what_comes_at_the_pace_is_taken_whole(jitter_s):
    pace = Pace(0.1)
    times_s = [0.1 * n + jitter_s * (-1) ** n for n in range(100)]
    assert all(pace.due(now_s) for now_s in times_s)


def test_what_comes_faster_is_thinned_out_and_a_pause_brings_no_burst():
    pace = Pace(0.1)
    assert sum(pace.due(0.01 * n) for n in range(1000)) == pytest.approx(100, abs=2)
    assert sum(pace.due(60.0 + 0.01 * n) for n in range(100)) == pytest.approx(10, abs=2)


def test_an_interval_of_zero_takes_all():
    pace = Pace(0.0)
    assert all(pace.due(now_s) for now_s in [0.0, 0.0, 5.0, 5.0, 4.0])


def test_sigterm_finishes_the_file(tmp_path):
    out = tmp_path / "a.rrd"

    def draw():
        with open_sink(Sink("save", str(out)), "test", rrb.Blueprint()) as recording:
            recording.log("speed", rr.Scalars(3.0))
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5.0)

    with pytest.raises(KeyboardInterrupt):
        draw()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
    found = [chunk.entity_path for chunk in RrdReader(str(out)).stream().to_chunks()]
    assert "/speed" in found


def test_a_link_to_a_file_stays_and_the_file_is_written(tmp_path):
    target, link = tmp_path / "kept.rrd", tmp_path / "link.rrd"
    link.symlink_to(target)
    with open_sink(Sink("save", str(link)), "test", rrb.Blueprint()):
        pass
    assert link.is_symlink()
    assert target.stat().st_size > 0


def test_the_folder_of_a_file_is_made(tmp_path):
    path = tmp_path / "runs" / "today" / "drive.rrd"
    check_sink(Sink("save", str(path)))
    assert not path.parent.exists()
    with open_sink(Sink("save", str(path)), "test", rrb.Blueprint()):
        pass
    assert path.stat().st_size > 0


def test_a_command_with_another_use_for_sigterm_keeps_it(tmp_path):
    def quit_softly(*_):
        pass

    before = signal.signal(signal.SIGTERM, quit_softly)
    try:
        with open_sink(Sink("save", str(tmp_path / "a.rrd")), "test", rrb.Blueprint()):
            assert signal.getsignal(signal.SIGTERM) is quit_softly
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_sink_is_named_by_a_word():
    assert read_sink("spawn") == Sink("spawn")
    assert read_sink("serve").is_live
    assert read_sink("a/b.rrd") == Sink("save", "a/b.rrd")
    with pytest.raises(UserError, match="neither spawn nor serve"):
        read_sink("window")
