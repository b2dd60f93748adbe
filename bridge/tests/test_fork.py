"""``python -m bridge fork``: recordings of the real wire, driven again.

Of the kept recording the second drive (episode 1) is forked: its car slows down for a gap, and
arrives after 6.1 s.
"""

import os
import shutil
import tempfile
from dataclasses import asdict
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from bridge.recording import Recording, choose_vehicle, heard_of
from hil_tests.testing.drives import (
    LEFT_TURN,
    TOY,
    bridge_status,
    flip_chunk,
    make_policy,
    read,
    record_drive,
    record_in_process,
    writing,
)

SHIPPED = Path(__file__).parents[2] / "results" / "policies"
OURS = SHIPPED / "left_turn.onnx"
NETWORK = "60ms+-40ms,loss=8%,burst=4,duplicate=5%,outage=0.6s@2s"


def fork_of(path: Path, *options) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "fork.json"
        words = ["fork", path, "--out", out, "--allow-unsigned", *options]
        assert bridge_status([str(word) for word in words]) == 0
        return read(out)


def undisturbed(tmp_path: Path, *drive, **options) -> tuple[Path, dict]:
    """A recording, and its report: where the machine stood still, the edge runtime has stopped."""
    for attempt in range(8):
        (folder := tmp_path / str(attempt)).mkdir()
        path = record_drive(folder, *drive, **options)
        if not (driven := read(folder / "report.json"))["wall_clock_stalls"]:
            return path, driven
    raise AssertionError("the machine stood still in each of 8 drives")


@pytest.mark.parametrize("ride_s", [0.0, 0.3])
def test_without_a_change_the_fork_is_the_recorded_drive_to_the_bit(tmp_path, ride_s):
    """With plans as well."""
    settings, network = tmp_path / "edge.toml", "loss=30%" if ride_s else NETWORK
    settings.write_text(f"[ride_through]\nmax_s = {ride_s}\n")
    words = ("--seed", "3", "--latency", network)
    path, driven = undisturbed(tmp_path, "left_turn", OURS, *words, edge=("--config", settings))
    (row,) = driven["per_episode"]
    found = fork_of(path, "--at", row["time_s"] / 2, "--policy", OURS)
    assert found["differs_from_s"] is None
    assert found["fork"] == found["recorded"] == row, "rewards and all"
    assert (found["latency_spec"], found["origin"]["seed"]) == (driven["latency_spec"], 3)


def test_the_recording_of_a_fork_is_forked_to_the_bit(tmp_path):
    policy, path = SHIPPED / "congestion.onnx", tmp_path / "drive.mcap"
    row, again = record_in_process(path, "congestion", policy, 3, NETWORK), tmp_path / "again.mcap"
    for at_s, words in ((row.time_s / 2, ("--record", again)), (row.time_s / 4, ())):
        found = fork_of(path, "--at", at_s, "--policy", policy, *words)
        assert (found["differs_from_s"], found["fork"]) == (None, asdict(row))
        path = again


def test_an_environment_of_others_is_the_same_to_the_bit(tmp_path):
    """The toy's scene has a field that a message has, too."""
    path, policy = tmp_path / "drive.mcap", make_policy(tmp_path, "constant", 0.5)
    row = record_in_process(path, TOY, policy, seed=4, latency="50ms+-30ms,loss=5%")
    found = fork_of(path, "--at", row.time_s / 2, "--policy", policy, "--env", TOY)
    assert found["differs_from_s"] is None
    assert found["fork"] == found["recorded"] == asdict(row)


def test_another_policy_or_network_drives_on_in_another_way(tmp_path):
    place = ("--episode", 1, "--at", "2.95s")
    braking = fork_of(LEFT_TURN, *place, "--policy", make_policy(tmp_path, "constant", -1.0))
    assert braking["differs_from_s"] == braking["at_s"] == 3.0
    assert (braking["recorded"]["outcome"], braking["fork"]["outcome"]) == ("goal", "timeout")
    before, after = braking["recorded"]["actions"], braking["fork"]["actions"]
    assert before[:30] == after[:30]
    assert set(map(tuple, after[30:])) == {(-1.0,)}
    late = fork_of(LEFT_TURN, *place, "--policy", OURS, "--latency", "300ms")
    assert 3.0 <= late["differs_from_s"] < 3.4
    # What was answered before arrives; for 600 ms nothing newer does, and the car brakes.
    assert late["fork"]["actions"][32] == [-1.0]
    assert late["fork"]["actions"][:30] == before[:30]
    # Without a policy the drive is rebuilt to its end.
    assert fork_of(LEFT_TURN, *place)["differs_from_s"] is None


def rewritten(path: Path, out: Path, change) -> Path:
    """The recording with ``change(topic, message)`` in the place of each message, None: without."""
    with writing(out) as writer:
        recording = Recording(path)
        for heard in heard_of(recording, choose_vehicle(recording, None)):
            message = msgspec.msgpack.decode(heard.payload)
            if (message := change(heard.topic, message)) is not None:
                payload = msgspec.msgpack.encode(message)
                writer.write(heard._replace(payload=payload, size=len(payload)))
    return out


def a_pixel(topic, message):
    if topic == "state" and (message["episode"], message["step"]) == (1, 12):
        pixels = bytearray(message["observation"]["frames"])
        pixels[4000] ^= 1
        message["observation"]["frames"] = bytes(pixels)
    return message


def a_car(topic, message, step=31):
    if topic == "scene" and (message["episode"], message["step"]) == (1, step):
        message["vehicles"][1]["x"] = np.nextafter(message["vehicles"][1]["x"], 1e9).item()
    return message


def an_action(topic, message):
    if topic == "scene" and (message["episode"], message["step"]) == (1, 6):
        message["applied"][0] *= 0.5
    return message


def without_a_scene(topic, message):
    return None if topic == "scene" and message["step"] == 9 else message


def without_origins(topic, message):
    message.pop("origin", None)
    return message


def of_a_module(topic, message):
    if topic == "scene":
        message["origin"]["environment"] = TOY
    return message


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (a_pixel, "at step 12 (1.2 s) the observation 'frames' is another than recorded"),
        (a_car, "at step 31 (3.1 s) the scene is another than recorded"),
        (an_action, "at step 6 (0.6 s) the "),
        (without_a_scene, "is known for 0.8 s"),
        (without_origins, "does not say how its drives were begun"),
        (of_a_module, f"was driven in {TOY}: a module is imported only"),
    ],
)
def test_a_recording_that_cannot_be_rebuilt_gets_one_line(tmp_path, refusal, change, said):
    path, out = rewritten(LEFT_TURN, tmp_path / "changed.mcap", change), tmp_path / "again.mcap"
    words = ("--episode", 1, "--at", "3.5", "--policy", OURS, "--allow-unsigned", "--record", out)
    assert said in refusal("fork", path, *words)
    assert not out.exists()


def test_a_change_behind_the_fork_is_found_as_well(tmp_path, refusal):
    """What the recorded drive came to is found by driving it to its end."""
    for step in (31, 63):
        path = rewritten(LEFT_TURN, tmp_path / f"{step}.mcap", partial(a_car, step=step))
        assert f"at step {step} " in refusal("fork", path, "--episode", 1, "--at", "3")


def test_other_places(refusal):
    congestion = ("--policy", SHIPPED / "congestion.onnx", "--allow-unsigned")
    for words, said in (
        ((), "--episode says which, 0 to 4"), (("--episode", 5), "holds 5 drives"),
        (("--episode", 1, "--at", "999s"), "fork before"),
        (("--episode", 1, "--latency", "300ms"), "--policy"),
        (("--episode", 1, "--env", "congestion"), "was driven in 'left_turn:"),
        (("--episode", 1, *congestion), "the policy is for 'congestion:"),
        (("--human", "web", "--latency", "9ms"), "--human takes no"),
    ):  # fmt: skip
        assert said in refusal("fork", LEFT_TURN, *words)
    named = fork_of(LEFT_TURN, "--episode", 1, "--env", "trainer.scenarios:phil/LeftTurn-v0")
    assert named["differs_from_s"] is None


def test_of_a_damaged_recording_what_is_whole_is_forked(tmp_path, capsys):
    damaged = Path(shutil.copy(LEFT_TURN, tmp_path))
    flip_chunk(damaged, -1)
    words = ("--episode", 1, "--policy", OURS, "--latency", "40ms+-10ms")
    assert fork_of(damaged, *words)["fork"] == fork_of(LEFT_TURN, *words)["fork"]
    assert capsys.readouterr().err.count("damaged place") == 1
    flip_chunk(damaged, 4)  # The middle of the second drive is in it.
    assert bridge_status(["fork", str(damaged), "--episode", "1", "--at", "5s"]) == 2
    assert "fork before" in capsys.readouterr().err


def test_a_person_is_handed_to_the_trainer_with_all_that_was_said(monkeypatch):
    monkeypatch.setattr(os, "execv", ran := Mock(side_effect=SystemExit))
    words = ["--at", "3s", "--episode", "1", "--human", "web", "--record", "rec"]
    bridge_status(["fork", str(LEFT_TURN), *words])
    command = ran.call_args.args[1]
    where = ["--at", "3.0", "--human", "web", "--episode", "1", "--out", "rec"]
    assert command[1:] == ["-m", "trainer", "drive", "--from", str(LEFT_TURN), *where]
