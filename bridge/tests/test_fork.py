"""``python -m bridge fork``: recordings of the real wire, driven again.

Of the kept recording the second drive (episode 1) is forked: its car slows down for a gap, and
arrives after 6.3 s.
"""

import os
from pathlib import Path
from unittest.mock import Mock

import msgspec
import pytest

from bridge.recording import Recording, choose_vehicle, heard_of, whole_recording
from bridge.tests.recordings import bridge_status, flip_chunk, record_in_process
from hil_tests.tests.shared.drives import LEFT_TURN, TOY, make_policy, read

SHIPPED = Path(__file__).parents[2] / "results" / "policies"
OURS = SHIPPED / "left_turn.onnx"
PLACE = ("--episode", 1, "--at", "2.95s")


@pytest.fixture
def fork_of(tmp_path):
    def run(path, *options):
        out = tmp_path / "fork.json"
        words = ["fork", path, "--out", out, "--allow-unsigned", *options]
        assert bridge_status([str(word) for word in words]) == 0
        return read(out)

    return run


def test_the_same_policy_ends_the_drive_as_recorded(fork_of, tmp_path):
    """Behind a perfect network; and a recorded drive of our own, of which the fork is recorded."""
    found = fork_of(LEFT_TURN, *PLACE, "--policy", OURS)
    assert (found["at_s"], found["recorded_policy_ids"]) == (3.0, [found["policy_id"]])
    assert (found["fork"]["outcome"], found["fork"]["time_s"]) == ("goal", 3.3)
    path, again = tmp_path / "drive.mcap", tmp_path / "again.mcap"
    policy = make_policy(tmp_path, "constant", 0.5)
    row = record_in_process(path, TOY, policy, seed=4, latency="none")
    words = ("--at", 1, "--policy", policy, "--env", TOY, "--record", again)
    found = fork_of(path, *words)["fork"]
    assert found["actions"] == row.actions[10:]
    assert found["outcome"] == row.outcome
    states = [one for one in heard_of(Recording(again), "v") if one.topic == "state"]
    assert len(states) == found["steps"] + 1


def test_a_drive_is_rebuilt_behind_a_network(fork_of, tmp_path):
    path, policy = tmp_path / "drive.mcap", make_policy(tmp_path, "constant", 0.5)
    network = "delay=60ms,jitter=40ms,loss=8%,burst=4,duplicate=5%,outage=0.6s@2s"
    theirs = SHIPPED / "congestion.onnx"
    row = record_in_process(path, "congestion", theirs, 3, network)
    assert fork_of(path)["fork"] is None, "rebuilt to its end"
    found = fork_of(path, "--at", round(row.time_s - 0.1, 6), "--policy", theirs)
    assert (found["fork"]["steps"], found["latency_spec"]) == (1, network)
    record_in_process(tmp_path / "b.mcap", TOY, policy, seed=4, latency="200ms")
    found = fork_of(tmp_path / "b.mcap", "--at", 2, "--policy", policy, "--env", TOY)["fork"]
    # Until the first command arrives the car rolls, and no longer than 2 T.
    assert [action[0] for action in found["actions"][:6]] == [0.0, 0.0, -1.0, -1.0, 0.5, 0.5]


def test_another_policy_or_network_drives_on_in_another_way(fork_of, tmp_path):
    braking = fork_of(LEFT_TURN, *PLACE, "--policy", make_policy(tmp_path, "constant", -1.0))
    assert braking["fork"]["outcome"] == "timeout"
    assert set(map(tuple, braking["fork"]["actions"])) == {(-1.0,)}
    late = fork_of(LEFT_TURN, *PLACE, "--policy", OURS, "--latency", "300ms")
    assert late["latency_spec"] == "300ms"
    assert [-1.0] in late["fork"]["actions"][:5]  # For 600 ms nothing arrives.


def rewritten(path, out, change):
    """The recording with ``change(topic, message)`` in the place of each message, None: without."""
    with whole_recording(out) as writer:
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
        (a_pixel, "at step 12 (1.2 s) the observation differs from the recorded one"),
        (an_action, "at step 7 (0.7 s) the "),
        (without_a_scene, "is known for 0.8 s"),
        (without_origins, "holds 0 drives"),
        (of_a_module, f"was driven in {TOY}: a module is imported only"),
    ],
)
def test_a_recording_that_cannot_be_rebuilt_gets_one_line(tmp_path, refusal, change, said):
    path, out = rewritten(LEFT_TURN, tmp_path / "changed.mcap", change), tmp_path / "again.mcap"
    words = ("--episode", 1, "--at", "3.5", "--policy", OURS, "--allow-unsigned", "--record", out)
    assert said in refusal("fork", path, *words)
    assert not out.exists()


def test_other_places(refusal):
    ours = ("--policy", OURS, "--allow-unsigned")
    congestion = ("--policy", SHIPPED / "congestion.onnx", "--allow-unsigned")
    for words, said in (
        (ours, "--episode says which"),
        (("--episode", 5, *ours), "holds 5 drives"),
        (("--episode", 1, "--at", "999s", *ours), "fork before"),
        (("--episode", 1, "--env", "congestion", *ours), "was driven in 'left_turn:"),
        (("--episode", 1, *congestion), "the policy is for 'congestion:"),
        (("--human", "web", "--latency", "9ms"), "--human takes no"),
    ):  # fmt: skip
        assert said in refusal("fork", LEFT_TURN, *words)


def test_of_a_damaged_recording_what_is_whole_is_forked(fork_of, tmp_path, capsys):
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(LEFT_TURN.read_bytes())
    flip_chunk(damaged, -1)
    words = ("--episode", 1, "--policy", OURS, "--latency", "40ms+-10ms")
    assert fork_of(damaged, *words)["fork"] == fork_of(LEFT_TURN, *words)["fork"]
    assert capsys.readouterr().err.count("damaged place") == 1
    flip_chunk(damaged, 4)  # The middle of the second drive is in it.
    assert (
        bridge_status(["fork", str(damaged), "--episode", "1", "--at", "5s", "--policy", str(OURS)])
        == 2
    )
    assert "fork before" in capsys.readouterr().err


def test_a_person_is_handed_to_the_trainer_with_all_that_was_said(monkeypatch):
    monkeypatch.setattr(os, "execv", ran := Mock(side_effect=SystemExit))
    words = ["--at", "3s", "--episode", "1", "--human", "web", "--record", "rec"]
    bridge_status(["fork", str(LEFT_TURN), *words])
    command = ran.call_args.args[1]
    where = ["--at", "3.0", "--human", "web", "--episode", "1", "--out", os.path.abspath("rec")]
    assert command[1:] == ["-m", "trainer", "drive", "--from", str(LEFT_TURN), *where]
