"""The views in rerun: what is drawn, where a recording goes, and `bridge view` beside a drive."""

import math
import re
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import msgspec
import pytest
import rerun as rr
import rerun.blueprint as rrb
from hypothesis import given
from hypothesis import strategies as st

import bridge.rerun
from bridge import messages
from bridge.__main__ import main
from bridge.recording import Recording, heard_of
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
from bridge.rerun.wire_view import DriveTime, WireLog
from bridge.tests import recordings
from bridge.tests.viewers import NO_GPU, in_place, listens
from edge_runtime.link import FIELDS
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.wire import Rejection
from hil_tests.processes import Process, wait_until
from hil_tests.testing import drives
from hil_tests.testing.drives import start_edge
from hil_tests.testing.environments import ToyEnv
from hil_tests.testing.messages import HEALTH, make_command, make_feedback, make_state
from hil_tests.testing.policies import TASK


def scene_with(car_x, **more):
    car = messages.SeenCar(x=car_x, y=2.0, heading_rad=math.pi / 2, length_m=4.0, width_m=2.0,
                           **more)  # fmt: skip
    return messages.SeenScene(path=[(0.0, 0.0), (50.0, 0.0)], vehicles=[car])


def test_the_view_shows_the_path_and_the_cars_near_it_and_follows_the_ego_car():
    xs, ys = zip(*draw.shapes_of(scene_with(5.0).vehicles[0])["outline"], strict=True)
    assert (min(xs), max(xs), min(ys), max(ys)) == pytest.approx((4.0, 6.0, 0.0, 4.0))
    near, inside, far = (draw.view_bounds(scene_with(x)) for x in (-15.0, 5.0, -60.0))
    assert near[0][0] == pytest.approx(inside[0][0] - 15.0)
    assert far == inside
    bounds = draw.view_bounds(scene_with(0.0, ego=True))
    away = [draw.away_m(scene_with(x, ego=True), bounds)[0] for x in (0, 30, 59, 61, 200)]
    assert away == [0.0, 0.0, 0.0, 36.0, 175.0]


@pytest.fixture
def log():
    """Draws on a recording that only notes it (``drawn``)."""
    return WireLog(MagicMock())


def drawings(log):
    recording: Any = log._canvas.recording
    return [call.args for call in recording.log.call_args_list]


def drawn(log, path):
    """What was drawn at a path: the numbers of a line, or the texts of events."""
    calls = [one for place, one in drawings(log) if place == path]
    shown = [one for one in calls if isinstance(one, rr.Scalars | rr.TextLog)]
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


def test_episodes_stand_end_to_end():
    time = DriveTime()
    steps = [time.place("a", *place)[1] for place in ((0, 0), (0, 7), (1, 0), (0, 5))]
    assert steps == [0, 7, 8, 5]
    assert time.place("a", 1, 2) == ("episode_1", 10)
    # A second session is not drawn over the first.
    assert time.place("b", 0, 0) == ("episode_0_of_session_2", 11)


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


@given(st.lists(st.floats(0, 0.2), min_size=1, max_size=300), st.floats(1, 100))
def test_no_rate_is_passed(steps, rate_hz):
    pace, now_s, passed = messages.Pace(1.0 / rate_hz), 0.0, 0
    for step in steps:
        now_s += step
        passed += pace.due(now_s)
    assert passed <= rate_hz * now_s + 2


@given(st.lists(st.floats(-0.02, 0.02), min_size=50, max_size=200))
def test_jitter_at_the_rate_itself_costs_nothing(jitters):
    pace = messages.Pace(0.05)
    assert all(pace.due(step * 0.05 + jitter) for step, jitter in enumerate(jitters))
    assert all(map(messages.Pace(0.0).due, [0.0, 0.0, 5.0, 4.0]))


def opened(sink, port=None):
    return open_sink(str(sink), "test", rrb.Blueprint(), port)


def test_the_folder_of_a_file_is_made_and_a_commands_own_use_of_sigterm_stays(tmp_path):
    new = tmp_path / "a" / "b.rrd"
    check_sink(str(new))
    assert not new.parent.exists()
    before = signal.signal(signal.SIGTERM, quit_softly := lambda *_: None)
    try:
        with opened(new):
            assert signal.getsignal(signal.SIGTERM) is quit_softly
    finally:
        signal.signal(signal.SIGTERM, before)
    assert new.stat().st_size > 0


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_no_part_of_a_recording_takes_a_whole_ones_place(tmp_path, error):
    out = tmp_path / "a.rrd"
    out.write_bytes(b"whole")
    with pytest.raises(error), opened(out):
        raise error
    assert out.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [out]


def test_a_disk_without_space_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    gone = MagicMock(side_effect=RuntimeError("writer is gone"))
    monkeypatch.setattr(rr.RecordingStream, "flush", gone)
    with pytest.raises(UserError, match="writer is gone"), opened(tmp_path / "a.rrd"):
        pass
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=65_536))
    with pytest.raises(UserError, match="no space left"), opened(tmp_path / "a.rrd"):
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
            assert (pages[0], pages[2]) == (bridge.rerun.WEB_PORT, asked)
            for port in (*pages, bridge.rerun.GRPC_PORT, asked + 1):
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
    ports = [free_port(), free_port()]
    monkeypatch.setattr(bridge.rerun, "free_port", iter(ports).__next__)
    with in_place("works", tmp_path, monkeypatch):
        show("spawn")
        show("spawn")
        assert len(set(ports)) == 2, "each its own"
        assert [listens("127.0.0.1", port) for port in ports] == [True, True]
        assert [listens("127.0.0.2", port) for port in ports] == [False, False]


@pytest.mark.parametrize(
    ("kind", "where", "why"),  # Most of the other places: trainer/tests/test_view.py.
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


def verify(recording):
    recordings.rerun("rrd", "verify", str(recording))
    return recordings.rerun("rrd", "stats", str(recording))


@pytest.mark.parametrize("told", ["the drive ends", "the view is interrupted"])
def test_a_view_keeps_what_it_recorded_and_ends_with_the_simulator(told, tmp_path):
    endpoint, recording = free_endpoint(), tmp_path / "drive.rrd"
    words = ("view", "--save", str(recording), "--connect", endpoint)
    with (
        Process("bridge", *words) as view,
        drives.start_simulate(endpoint, tmp_path / "r.json", drives.SLOW_TOY) as run,
    ):
        wait_until(lambda: list(tmp_path.glob(".drive.rrd*")), "the recording to begin")
        if told == "the drive ends":
            with start_edge(endpoint, drives.make_policy(tmp_path, "constant")):
                assert run.wait() == 0, run.errors
        else:
            time.sleep(0.3)
            assert not recording.exists()
            view.send(signal.SIGTERM)
        assert view.wait(20) == 0, view.errors
    found = verify(recording)
    entities = ("frames/now", "road/ego/body", "action/asked", "latency/round_trip", "mode/mode")
    assert told != "the drive ends" or [one for one in entities if one not in found] == []
    assert list(tmp_path.glob(".drive*")) == []


def test_only_a_missing_command_within_an_episode_is_silence(log):
    begin_ns, s = 10**18, 10**9
    log.write_state(make_state(50), begin_ns)  # A viewer that comes late.
    assert drawn(log, "events") == []
    log.write_state(make_state(53), begin_ns + s // 2)
    assert drawn(log, "events") == ["no command: the simulator brakes by itself"]
    log.write_command(make_command(53), begin_ns + s)
    log.write_state(make_state(1, episode=1), begin_ns + 2 * s)  # Between two episodes.
    assert drawn(log, "events")[1:] == ["drive"]


def test_a_ride_is_shown_and_no_silence(log):
    log.write_state(make_state(7), 10**18)
    log.write_command(make_command(7, plan=[[0.1]] * 5), 10**18)
    for step, ridden in ((8, 0), (9, 1), (10, 2)):
        log.write_state(make_state(step), 10**18 + (step - 7) * 10**8)
        log.write_scene(make_scene(ridden=ridden), 10**18)
    log.write_command(make_command(10), 10**18)
    assert drawn(log, "events") == ["drive", "drive: rides on the plan", "drive"]


def test_a_recording_is_shown_without_a_drive_and_without_what_is_broken(tmp_path, capsys):
    path, out = tmp_path / "drive.mcap", tmp_path / "drive.rrd"
    shutil.copy(drives.LEFT_TURN, path)
    recordings.flip_chunk(path, 3)
    assert main(["view", str(path), "--save", str(out)]) == 0
    found, said = verify(out), capsys.readouterr()
    entities = ("frames/now", "road/ego/body", "road/roads", "action/asked", "latency/uplink",
                "latency/inference", "mode/reason", "rejected/edge/all")  # fmt: skip
    assert [entity for entity in entities if entity not in found] == []
    assert said.out == f"wrote {out}\n"
    assert len(said.err.splitlines()) == 1


CAR = {"x": 0.0, "y": 0.0, "heading_rad": 0.0, "length_m": 4.0, "width_m": 2.0, "ego": True}
PLACE = {"episode": 0, "step": 3, "sim_time_s": 0.3}
LINE = [[0.0, 0.0], [1.0, 1.0]]
GOOD: dict[str, dict] = {
    "state": msgspec.to_builtins(make_state(3), builtin_types=(bytes,)),
    "command": msgspec.to_builtins(make_command(3)),
    "feedback": msgspec.to_builtins(make_feedback(3)),
    "health": msgspec.to_builtins(HEALTH),
    "scene": PLACE | {"roads": [LINE], "path": LINE, "goal": [1.0, 1.0], "vehicles": [CAR],
                          "round_trip_ms": 3.0, "answered_step": 2, "applied": [0.1]},
}  # fmt: skip
ABSURD = [2**63, 2**64 - 1, 2**53, 2**31, -(2**63), 1e308, -1e308, math.nan, math.inf, [], [1.0]]


def with_each_number_absurd(value):
    """The same again and again, each time with another of its numbers or lists replaced."""
    if isinstance(value, dict | list):
        for key, inner in list(value.items() if isinstance(value, dict) else enumerate(value)):
            for changed in with_each_number_absurd(inner):
                again = value.copy()
                again[key] = changed
                yield again
    if isinstance(value, int | float | list) and not isinstance(value, bool):
        yield from ABSURD


def test_no_number_ends_a_viewer_or_makes_a_recording_unviewable(tmp_path, capsys):
    """What is absurd is left out and counted, by the recorder's copies and the view."""
    path, out = tmp_path / "drive.mcap", tmp_path / "drive.rrd"
    absurd = [(t, one) for t, good in GOOD.items() for one in with_each_number_absurd(good)]
    with recordings.writing(path) as writer:
        for at_ns, (topic, message) in enumerate([*absurd, *GOOD.items()], 10**18):
            payload = msgspec.msgpack.encode(message)
            key = f"phil/v/{topic}"
            writer.write(messages.Heard(key, topic, payload, at_ns, len(payload)))
    assert len(absurd) > 500
    assert main(["view", str(path), "--save", str(out)]) == 0
    assert "road/ego/body" in verify(out)
    (line,) = capsys.readouterr().err.splitlines()
    (left_out,) = map(int, re.findall(r"left out: (\d+) messages", line))
    assert len(absurd) / 2 < left_out < len(absurd)
    log = WireLog(MagicMock())
    for stored in heard_of(Recording(path), "v"):
        log.write(stored)
    assert log._time.place("late", 0, 0)[1] < 10**6


def test_a_round_trip_is_split_once_by_the_stamps_of_its_own_state(log):
    ms = 10**6
    for step in (3, 4):
        sent_ns = 10**18 + step * 100 * ms
        log.write_state(make_state(step, session="here", sent_ns=sent_ns), sent_ns)
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
    assert drawn(log, "latency/uplink") == pytest.approx([23.0, 23.0, 24.0, 24.0])
    assert drawn(log, "latency/round_trip") == [60.0, 60.0]
    assert drawn(log, "latency/downlink") == pytest.approx([60.0 - 26.0])


def test_rejections_are_counted_by_side_and_reason(log):
    for count in (0, 2, 5):
        log.write_scene(make_scene(rejected={"stale": count}), 10**18)
        log.write_health(msgspec.structs.replace(HEALTH, rejected={"stale": count}), 10**18)
    # From zero, so that the line shows the step.
    for side in ("simulator", "edge"):
        for of in ("all", "stale"):
            assert drawn(log, f"rejected/{side}/{of}") == [0, 2, 5]
    assert drawn(log, "events") == [f"edge rejected {new} states: stale" for new in (2, 3)]


def test_the_link_is_drawn_where_its_numbers_are_known(log):
    link = {name: float(n) for n, name in enumerate(FIELDS)}
    for known in ({}, {"load": 1.0, "up_ms": 7.0}, link):  # none, another version's, ours
        log.write_health(msgspec.structs.replace(HEALTH, link=known), 10**18)
    assert drawn(log, "link/up_ms") == [7.0, 0.0]
    assert drawn(log, "link/down_ms") == [link["down_ms"]]
    assert drawn(log, "link/load") == drawn(log, "link/error_ms") == []


@pytest.mark.parametrize(("interval_s", "count"), [(0.1, 22), (0.0, 202)])
def test_live_pictures_are_at_most_ten_a_second(interval_s, count):
    log = WireLog(MagicMock(), interval_s)
    log.write_scene(make_scene(task=TASK), 10**18)  # says how to read the states
    for step in range(101):  # A lock-step drive at ten times real time.
        log.write_state(make_state(step), 10**18 + step * 10**7)
    pictures = [one for _, one in drawings(log) if isinstance(one, rr.Image)]
    assert len(pictures) == pytest.approx(count, abs=2)
