"""The views in rerun: what is drawn, where a recording goes, and `bridge view` beside a drive."""

import math
import re
import shutil
import signal
import subprocess
import sys
import time
from typing import Any
from unittest.mock import MagicMock

import msgspec
import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb

import bridge.rerun
from bridge import messages
from bridge.__main__ import main
from bridge.ports import open_port
from bridge.recording import Recording, heard_of, whole_recording
from bridge.rerun import (
    APPLIED,
    POLICY,
    ViewerGone,
    check_sink,
    draw,
    flush,
    free_port,
    open_sink,
    shades,
)
from bridge.rerun.draw import WireLog
from bridge.tests import recordings
from bridge.tests.viewers import NO_GPU, in_place, listens
from edge_runtime.link import FIELDS
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.wire import Rejection
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared import drives
from hil_tests.tests.shared.environments import ToyEnv
from hil_tests.tests.shared.messages import HEALTH, make_command, make_state
from hil_tests.tests.shared.policies import TASK

ALONG_Y = messages.SeenCar(
    x=5.0, y=2.0, heading_rad=math.pi / 2, length_m=4.0, width_m=2.0, ego=True
)


def test_a_car_is_drawn_in_place_and_the_view_shows_the_path():
    lines = [*messages.body(ALONG_Y), *messages.windscreen(ALONG_Y)]
    assert np.round(lines, 9).tolist() == [[5.0, 1.0], [5.0, 3.0], [5.7, 2.8], [4.3, 2.8]]
    path = [(0.0, 0.0), (50.0, 0.0)]
    view: Any = draw.road_view(messages.SeenScene(path=path, vehicles=[ALONG_Y]))
    bounds = view.properties["VisualBounds2D"]
    (found,) = bounds.range.as_arrow_array().to_pylist()
    assert found == {"x_range": [-8.0, 58.0], "y_range": [-8.0, 8.0]}
    away = [
        draw.away_m(messages.SeenScene(path=path, vehicles=[msgspec.structs.replace(ALONG_Y, x=x)]))
        for x in (0.0, 57.0, 61.0, 225.0)
    ]
    assert away == [[0.0, 0.0], [0.0, 0.0], [36.0, 2.0], [200.0, 2.0]]


@pytest.fixture
def log():
    """Draws on a recording that only notes it (``drawn``)."""
    return WireLog(MagicMock())


def drawings(log):
    recording: Any = log._canvas.recording
    return [call.args for call in recording.log.call_args_list]


def drawn(log, path):
    """What was drawn at a path: the numbers of a line, or the words of a state."""
    calls = [one for place, one in drawings(log) if place == path]
    shown = [one for one in calls if isinstance(one, rr.Scalars | rr.StateChange)]
    rows = [one.as_component_batches()[0].as_arrow_array().to_pylist() for one in shown]
    return [row[0] if len(row) == 1 else row for row in rows]


def make_scene(**fields):
    return messages.Scene(episode=0, step=9, sim_time_s=0.9, **fields)


def test_each_of_several_actions_has_a_name_and_a_colour_of_its_own(log):
    names = [TASK.action[0].name, "steering"]
    two = [msgspec.structs.replace(TASK.action[0], name=name) for name in names]
    log.write_scene(make_scene(task=msgspec.structs.replace(TASK, action=two)), 10**18)
    colours = []
    for what in ("asked", "achieved"):
        *_, style = [one for place, one in drawings(log) if place == f"action/{what}"]
        assert style.names.as_arrow_array().to_pylist() == [f"{what} {name}" for name in names]
        colours += style.colors.as_arrow_array().to_pylist()
    assert len(set(colours)) == 4
    assert shades(POLICY, 16)[0] == POLICY
    assert len({*shades(POLICY, 16), *shades(APPLIED, 16)}) == 32


def test_episodes_stand_end_to_end_and_a_second_session_behind_the_first(log):
    for session, episode, step in (("a", 0, 0), ("a", 0, 7), ("a", 1, 0), ("a", 0, 5), ("b", 0, 0)):
        log.write_state(make_state(step, session=session, episode=episode), 10**18)
    calls = log._canvas.recording.set_time.call_args_list
    assert [call.kwargs["sequence"] for call in calls if call.args == ("step",)] == [0, 7, 8, 5, 9]
    for episode in range(100):  # However long they say that they are.
        log.write_state(make_state(10**8, episode=episode, sim_time_s=1.99e8), 10**18)
    assert log._canvas.recording.set_time.call_args.kwargs["duration"] * 1e9 < 2**63


def test_a_scene_survives_the_wire_without_what_is_not_drawn():
    environment = ToyEnv()
    environment.reset(seed=1)
    stamps = messages.Scene(episode=2, step=3, sim_time_s=0.3, rejected={"stale": 2})
    given = {**environment.scene(), "stop_line": [1.0, 2.0]}  # With numbers of NumPy's.
    scene = messages.decode_scene(messages.encode_scene(given, stamps))
    assert isinstance(scene, messages.Scene)
    assert (scene.episode, scene.step, scene.rejected) == (2, 3, {"stale": 2})
    (car,) = scene.vehicles
    assert (car.ego, car.id, scene.path, scene.lane_lines) == (True, 0, [(0, 0), (14, 0)], ())
    assert messages.read_scene(given).vehicles == [car]
    for payload in (b"", b"\xc1", b"\x80", bytes(70_000)):
        assert isinstance(messages.decode_scene(payload), Rejection)


def opened(sink, port=None):
    return open_sink(str(sink), "test", rrb.Blueprint(), port)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_no_part_of_a_recording_takes_a_whole_ones_place(tmp_path, error):
    out = tmp_path / "a.rrd"
    out.write_bytes(b"whole")
    with pytest.raises(error), opened(out):
        raise error
    assert out.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [out]


def test_a_disk_that_takes_no_more_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    gone = MagicMock(side_effect=RuntimeError("writer is gone"))
    monkeypatch.setattr(rr.RecordingStream, "flush", gone)
    with pytest.raises(UserError, match="writer is gone"), opened(tmp_path / "a.rrd"):
        pass
    assert list(tmp_path.iterdir()) == []


def show(kind, for_s=0.0):
    with opened(kind) as recording:
        end_s = time.monotonic() + for_s
        while True:
            recording.log("speed", rr.Scalars(3.0))
            flush(recording)
            if time.monotonic() >= end_s:
                return


LOOP = ("127.0.0.1", "127.0.0.1")


def test_pages_are_told_of_when_they_answer_and_have_ports_of_their_own(
    tmp_path, monkeypatch, capsys
):
    # Below the ports that connections take.
    asked = next(p for p in range(21000, 30000, 2) if not any(map(listens, LOOP, (p, p + 1))))
    with in_place("works", tmp_path, monkeypatch):
        with opened("serve"), opened("serve"), opened("serve", asked) as recording:
            pages = [int(port) for port in re.findall(r"127.0.0.1:(\d+)/", capsys.readouterr().out)]
            assert len(set(pages)) == 3
            assert pages[2] == asked
            for port in (*pages, asked + 1):
                assert listens("127.0.0.1", port)
                assert not listens("127.0.0.2", port), "loopback's first address only"
            with pytest.raises(UserError, match=str(asked)):
                check_sink("serve", asked)
            recording.log("speed", rr.Scalars(3.0))
        wait_until(lambda: not any(listens("127.0.0.1", page) for page in pages), "their ends")
    with pytest.raises(UserError):
        check_sink("drive.rrd", asked)
    with pytest.raises(UserError):
        check_sink("drive.mcap")


def test_a_window_listens_on_loopback_only_and_stays_open(tmp_path, monkeypatch):
    ports = iter(pairs := [free_port() for _ in range(4)])
    monkeypatch.setattr(bridge.rerun, "free_port", lambda: next(ports))
    with in_place("works", tmp_path, monkeypatch):
        show("spawn")
        show("spawn")
        assert [listens("127.0.0.1", port) for port in pairs[1::2]] == [True, True]
        assert [listens("127.0.0.2", port) for port in pairs[1::2]] == [False, False]


@pytest.mark.parametrize(
    ("kind", "where", "why"),
    [
        ("ends at once", "serve", NO_GPU),
        ("never listens", "serve", "does not listen"),
        ("is killed", "spawn", "it was closed"),
        ("hangs", "spawn", None),
    ],
)
def test_a_viewer_that_is_gone_is_one_plain_error(kind, where, why, tmp_path, monkeypatch):
    with in_place(kind, tmp_path, monkeypatch), pytest.raises(ViewerGone, match=why):
        show(where, for_s=5.0)


def test_what_the_trainer_takes_loads_neither_zenoh_nor_rerun():
    """A scenario needs a colour of the view, and not the view; an evaluation needs no network."""
    taken = ("messages", "network", "recording", "report", "rerun")
    code = "import sys\n" + "".join(f"import bridge.{name}\n" for name in taken)
    code += "assert not {'zenoh', 'rerun'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_view_that_is_interrupted_keeps_what_it_recorded(tmp_path):
    endpoint, recording = free_endpoint(), tmp_path / "drive.rrd"
    words = ("view", "--save", str(recording), "--connect", endpoint)
    with open_port(endpoint, "hunter01"), Process("bridge", *words) as view:
        wait_until(lambda: list(tmp_path.glob(".drive.rrd*")), "the recording to begin")
        time.sleep(0.3)
        assert not recording.exists()
        view.send(signal.SIGTERM)
        assert view.wait(20) == 0, view.errors
    recordings.verify_view(recording)
    assert list(tmp_path.iterdir()) == [recording]


def test_only_a_missing_command_within_an_episode_is_silence(log):
    begin_ns, s = 10**18, 10**9
    log.write_state(make_state(50), begin_ns)  # A viewer that comes late.
    assert drawn(log, "mode/reason") == []
    log.write_state(make_state(53), begin_ns + s // 2)
    assert drawn(log, "mode/reason") == ["the simulator brakes by itself"]
    log.write_command(make_command(53), begin_ns + s)
    log.write_state(make_state(1, episode=1), begin_ns + 2 * s)  # Between two episodes.
    assert drawn(log, "mode/mode") == ["no command", "drive"]
    assert drawn(log, "mode/reason")[1:] == ["-"]


def test_a_ride_is_shown_and_no_silence(log):
    log.write_state(make_state(7), 10**18)
    log.write_command(make_command(7, plan=[[0.1]] * 5), 10**18)
    for step, ridden in ((8, 0), (9, 1), (10, 2)):
        log.write_state(make_state(step), 10**18 + (step - 7) * 10**8)
        log.write_scene(make_scene(ridden=ridden), 10**18)
    log.write_command(make_command(10), 10**18)
    assert drawn(log, "mode/mode") == ["drive"]
    assert drawn(log, "mode/reason") == ["-", "rides on the plan", "-"]


def test_a_recording_is_shown_without_a_drive_and_without_what_is_broken(tmp_path, capsys):
    path, out = tmp_path / "drive.mcap", tmp_path / "drive.rrd"
    shutil.copy(drives.LEFT_TURN, path)
    recordings.flip_chunk(path, 3)
    assert main(["view", str(path), "--save", str(out)]) == 0
    found, said = recordings.verify_view(out), capsys.readouterr()
    entities = ("frames/now", "road/ego/body", "road/roads", "action/asked", "latency/inference",
                "mode/reason", "rejected/edge")  # fmt: skip
    assert [entity for entity in entities if entity not in found] == []
    assert said.out == f"wrote {out}\n"
    assert len(said.err.splitlines()) == 1


ABSURD = [2**63, 2**53, -(2**63), 1e308, math.nan, math.inf]


def test_no_number_ends_a_viewer_or_makes_a_recording_unviewable(tmp_path, capsys):
    """What is absurd is left out and counted."""
    path, out = tmp_path / "drive.mcap", tmp_path / "drive.rrd"
    scene = {"episode": 0, "step": 3, "sim_time_s": 0.3, "goal": [1.0, 1.0], "round_trip_ms": 3.0}
    good = {"state": msgspec.to_builtins(make_state(3), builtin_types=(bytes,)), "scene": scene,
            "command": msgspec.to_builtins(make_command(3))}  # fmt: skip
    absurd = [
        (topic, {**message, name: wrong})
        for topic, message in good.items()
        for name, value in message.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
        for wrong in ABSURD
    ]
    with whole_recording(path) as writer:
        for at_ns, (topic, message) in enumerate([*absurd, *good.items()], 10**18):
            payload = msgspec.msgpack.encode(message)
            writer.write(messages.Heard(f"phil/v/{topic}", topic, payload, at_ns, len(payload)))
    assert main(["view", str(path), "--save", str(out)]) == 0
    assert "latency/round_trip" in recordings.verify_view(out)
    (line,) = capsys.readouterr().err.splitlines()
    (left_out,) = map(int, re.findall(r"left out: (\d+) messages", line))
    assert len(absurd) / 2 < left_out < len(absurd)
    log = WireLog(MagicMock())
    for stored in heard_of(Recording(path), "v"):
        log.write(stored)
    assert log._end_step < 10**6


def test_rejections_are_counted_by_side(log):
    for count in (0, 2, 5):
        log.write_scene(make_scene(rejected={"stale": count, "late": 1}), 10**18)
        log.write_health(msgspec.structs.replace(HEALTH, rejected={"stale": count}), 10**18)
    assert drawn(log, "rejected/simulator") == [1, 3, 6]
    assert drawn(log, "rejected/edge") == [0, 2, 5]


def test_the_link_is_drawn_where_its_numbers_are_known(log):
    link = {name: float(n) for n, name in enumerate(FIELDS)}
    for known in ({}, {"load": 1.0, "up_ms": 7.0}, link):  # none, another version's, ours
        log.write_health(msgspec.structs.replace(HEALTH, link=known), 10**18)
    assert drawn(log, "link/up_ms") == [7.0, 0.0]
    assert drawn(log, "link/down_ms") == [link["down_ms"]]


@pytest.mark.parametrize(("interval_s", "count"), [(0.1, 22), (0.0, 202)])
def test_live_pictures_are_at_most_ten_a_second(interval_s, count):
    log = WireLog(MagicMock(), interval_s)
    log.write_scene(make_scene(task=TASK), 10**18)  # says how to read the states
    for step in range(101):  # A lock-step drive at ten times real time.
        log.write_state(make_state(step), 10**18 + step * 10**7)
    pictures = [one for _, one in drawings(log) if isinstance(one, rr.Image)]
    assert len(pictures) == pytest.approx(count, abs=2)
