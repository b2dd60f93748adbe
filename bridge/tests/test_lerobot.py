"""A recording as LeRobot's data set, read back with other libraries; live in Foxglove."""

import asyncio
import contextlib
import json
import tracemalloc

import aiohttp
import av
import msgspec
import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet

from bridge.messages import Scene, encode_scene
from bridge.recording import RawImage, whole_recording
from bridge.rerun import free_port
from bridge.tests import recordings
from bridge.tests.recordings import heard
from edge_runtime.manifest import Action, Entry, Task
from edge_runtime.reach import free_endpoint
from edge_runtime.wire import encode
from hil_tests.processes import Process
from hil_tests.tests.shared import drives
from hil_tests.tests.shared.drives import start_edge
from hil_tests.tests.shared.messages import make_command, make_state
from hil_tests.tests.shared.policies import TASK

SEEN = {
    "a": Entry(dtype="uint8", shape=[6, 8, 3]),
    "b": Entry(dtype="float32", shape=[2]),
    "c": Entry(dtype="uint8", shape=[2, 5, 7]),  # A grey pair, of odd size
}
ACTIONS = [Action(name=name, low=-1, high=1) for name in ("left", "right")]
ROVER = Task(task="rover", observation=SEEN, action=ACTIONS, control_period_s=0.05)
ODD = msgspec.structs.replace(ROVER, observation={"a/../b": SEEN["b"]})
STEPS = {(0, 0): "drive", (0, 1): "safe_stop", (0, 2): "drive", (0, 3): "final", (1, 0): "drive",
         (1, 1): "no answer", (1, 2): "drive"}  # fmt: skip
FILE = "chunk-000/file-000"


def recorded(path, task):
    with whole_recording(path) as writer:
        scene = Scene(episode=0, step=0, sim_time_s=0.0, task=task)
        writer.write(heard("scene", encode_scene({}, scene)))
        for (episode, step), mode in STEPS.items():
            place = {"session": "here", "episode": episode}
            seen = {"a": bytes([20 * step, 90, 10 * episode] * 48)}
            seen["b"] = np.array([episode, step], np.float32).tobytes()
            seen["c"] = bytes(35) + bytes([50 + 20 * step] * 35)
            state = make_state(step, **place, observation=seen, final=mode == "final")
            writer.write(heard("state", encode(state)))
            if mode in ("drive", "safe_stop"):
                ours = {"mode": mode, "action": [step / 4, -0.5]}
                if (episode, step) == (0, 2):
                    ours["plan"] = [[0.5, 0.5]]
                done = make_command(step, **place, **ours)
                writer.write(heard("command", encode(done)))
    return path


def export(path, out):
    return ["export", str(path), "--format", "lerobot", "--out", str(out)]


def test_a_data_set_holds_what_was_seen_and_commanded(tmp_path, capsys):
    out = tmp_path / "sets" / "a"
    assert recordings.bridge_status(export(recorded(tmp_path / "a.mcap", ROVER), out)) == 0
    assert capsys.readouterr().out.endswith("5 frames\n")
    rows = parquet.read_table(out / f"data/{FILE}.parquet").to_pylist()
    episodes = parquet.read_table(out / f"meta/episodes/{FILE}.parquet").to_pylist()
    kept = [place for place, mode in STEPS.items() if mode in ("drive", "safe_stop")]
    for index, (row, (episode, step)) in enumerate(zip(rows, kept, strict=True)):
        number = index - 3 * episode
        assert row == {
            "action": [step / 4, -0.5], "mode": STEPS[episode, step], "step": step, "index": index,
            "next.done": index == 2, "timestamp": pytest.approx(number / 20), "task_index": 0,
            "frame_index": number, "episode_index": episode, "observation.state": [episode, step],
        }  # fmt: skip
    for key in ("observation.images.a", "observation.images.c"):
        starts_s = [one[f"videos/{key}/from_timestamp"] for one in episodes]
        with av.open(str(out / f"videos/{key}/{FILE}.mp4")) as video:
            for row, frame, (episode, step) in zip(rows, video.decode(), kept, strict=True):
                wanted_s = starts_s[episode] + row["timestamp"]  # as LeRobot looks it up
                assert frame.time == pytest.approx(wanted_s, abs=1e-4)
                colour = [20 * step, 90, 10 * episode] if key[-1] == "a" else 50 + 20 * step
                assert np.abs(frame.to_ndarray(format="rgb24").astype(int) - colour).max() <= 4
    assert episodes[1]["stats/observation.images.a/max"] == [[[40 / 255]], [[90 / 255]], [[2 / 51]]]
    assert episodes[1]["stats/action/mean"] == [0.25, -0.5]
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 20, 5)
    assert info["features"]["action"]["names"] == ["left", "right"]
    assert pd.read_parquet(out / "meta/tasks.parquet").loc["rover"].task_index == 0


def drive_of(path, entry, values, action=0.5):
    """A recording of answered states, each of one array as bytes."""
    task = msgspec.structs.replace(ROVER, observation={"a": entry}, action=ACTIONS[:1])
    with whole_recording(path) as writer:
        scene = Scene(episode=0, step=0, sim_time_s=0.0, task=task)
        writer.write(heard("scene", encode_scene({}, scene)))
        for step, value in enumerate(values):
            state = make_state(step, session="here", observation={"a": value})
            writer.write(heard("state", encode(state)), with_view=False)
            writer.write(heard("command", encode(make_command(step, action=[action]))))
    return path


def test_large_numbers_have_finite_statistics_and_too_large_ones_are_left_out(tmp_path):
    large = np.full(2, np.finfo(np.float32).max, np.float32)
    values = [large.tobytes(), (-large).tobytes()] * 3
    path = drive_of(tmp_path / "a.mcap", SEEN["b"], values, action=1e11)
    assert recordings.bridge_status(export(path, tmp_path / "a")) == 0
    stats = json.loads((tmp_path / "a/meta/stats.json").read_text())
    assert stats["observation.state"]["std"] == pytest.approx(large.astype(float).tolist())
    path = drive_of(tmp_path / "b.mcap", SEEN["b"], values, action=1e308)
    assert recordings.bridge_status(export(path, tmp_path / "b")) == 2


def test_memory_does_not_grow_with_the_pictures(tmp_path):
    """Black pictures, of which a small file holds very many."""
    black, frames = bytes(480 * 640 * 3), 50
    entry = Entry(dtype="uint8", shape=[480, 640, 3])
    path = drive_of(tmp_path / "a.mcap", entry, [black] * frames)
    tracemalloc.start()
    try:
        assert recordings.bridge_status(export(path, tmp_path / "a")) == 0
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 24e6 < 0.8 * frames * len(black)


@pytest.mark.parametrize(
    ("task", "says"),
    [(None, "no scene that says"), (ODD, "cannot be the name"), (TASK, "no answered state")],
)
def test_what_cannot_be_exported_is_one_line_and_leaves_nothing(task, says, tmp_path, refusal):
    path = recorded(tmp_path / "a.mcap", task)
    assert says in refusal(*export(path, tmp_path / "a"))
    assert "exists; choose another name" in refusal(*export(path, tmp_path))
    assert list(tmp_path.iterdir()) == [path]


async def first_message(port, topic, start_drive):
    """What a client that is there before the drive begins gets first."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{port}", protocols=["foxglove.sdk.v1"]) as server,
    ):
        start_drive()
        both = None
        while (message := await server.receive(timeout=40)).type == aiohttp.WSMsgType.TEXT:
            told = json.loads(message.data)
            for channel in told.get("channels", ()):
                if channel["topic"] == topic:
                    both = {"id": 1, "channelId": channel["id"]}
            # The SDK (0.30) announces a channel before it knows it: who was too early asks again.
            if both and told["op"] in ("advertise", "status"):
                await server.send_json({"op": "subscribe", "subscriptions": [both]})
        assert message.type == aiohttp.WSMsgType.BINARY, message
        return message.data[13:]  # Behind the kind, the subscription and the time


def test_a_drive_is_served_to_foxglove(tmp_path, refusal):
    endpoint, port = free_endpoint(), free_port()
    policy = drives.make_policy(tmp_path, "constant")
    with (
        Process("bridge", "view", "--foxglove", str(port), "--connect", endpoint) as view,
        # So many drives that none is the last, however late a busy machine lets the client ask.
        drives.start_simulate(
            endpoint, tmp_path / "r.json", drives.SLOW_TOY, "--episodes", "1000"
        ) as run,
        contextlib.ExitStack() as edge,
    ):
        view.wait_for_line(f"open ws://127.0.0.1:{port} in Foxglove")

        def start_drive():
            edge.enter_context(start_edge(endpoint, policy))

        data = asyncio.run(first_message(port, "view/hunter01/frames", start_drive))
        run.kill()
        assert view.wait(30) == 0, view.errors  # with the simulator
    assert msgspec.json.decode(data, type=RawImage).height == 90
    assert "goes with neither" in refusal("view", "a.mcap", "--foxglove")
