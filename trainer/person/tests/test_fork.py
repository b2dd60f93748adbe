"""A person drives on in a recorded drive: `trainer drive --from`, and what learns from it."""

from pathlib import Path

import pytest

from bridge import fork
from bridge.fork import RecordedEpisode
from bridge.tests.recordings import record_in_process
from hil_tests.tests.shared.commands import call
from hil_tests.tests.shared.policies import write_policy
from trainer.person.recording import find_recordings, read_episodes, read_steps
from trainer.person.tests.people import LET_GO, QUIT, Puppet, hold

UNJUDGED = ["--out", "run", "--threads", "1", "--set", "batch_size=4"]
FORK = ["drive", "--human", "web", "--from", "drive.mcap", "--at", "0.95s"]


@pytest.fixture
def recorded(tmp_path, monkeypatch, one_thread) -> RecordedEpisode:
    """A left turn with a constant pedal, as ``bridge record`` keeps it, where the test is."""
    monkeypatch.chdir(tmp_path)
    write_policy("policy.onnx", "constant", 0.2)
    drive = Path("drive.mcap")
    record_in_process(drive, "left_turn", Path("policy.onnx"), 3, "50ms", "variant")
    (episode,) = fork.read_episodes(drive)
    return episode


def test_a_persons_fork_begins_where_the_drive_was_and_is_a_demonstration(
    sit_down, recorded, capsys
):
    person = Puppet([LET_GO, *[hold(-1.0)] * 60], then=QUIT)
    status, out, errors = sit_down(person, *FORK, "--out", "rec", "--episodes", "1")
    assert status == 0, errors
    (path,) = find_recordings([Path("rec")])
    (steps,) = read_episodes(read_steps(path))
    state = recorded.states[10].observation["frames"]
    assert steps[0].observation.tobytes() == state, "what the policy saw 1 s after the start"
    assert {(step.seed, step.scenario) for step in steps} == {(3, "left_turn")}
    assert [step.action for step in steps[1:4]] == [-1.0] * 3
    assert all(step.control == "human" for step in steps)
    assert steps[-1].speed_mps < steps[1].speed_mps
    short = "--episodes 1 --updates-per-episode 2 --refining-updates 3"
    status, out, _ = call(capsys, "human", "--from", "rec", *short.split(), "--out", "me")
    assert (status, f"from {len(steps)} demonstrated steps" in out) == (0, True)
    assert call(capsys, "train", "--human", "me", "--steps", "60", *UNJUDGED)[0] == 0
