import subprocess

import numpy as np
import torch

from edge_runtime.util import UserError
from hil_tests.testing.commands import refusal
from trainer import util


def test_a_second_training_in_a_directory_is_refused(capsys, tmp_path):
    (tmp_path / f".{8 * '0a'}.tmp").touch()  # As `write_atomic` leaves it where it is killed
    with util.claimed(tmp_path):
        assert str(tmp_path) in refusal(capsys, "train", "--out", str(tmp_path), "--episodes", "1")
    assert list(tmp_path.iterdir()) == []


def test_a_flipped_bit_of_a_checkpoint_is_refused_or_in_nothing_that_is_read(tmp_path):
    path, weights = tmp_path / "c.pt", torch.arange(500.0)
    state = {"w": weights, "episode": 3}
    util.save_torch(path, state)
    whole, refused = path.read_bytes(), 0
    assert torch.equal(util.load_torch(path)["w"], weights)
    for bit in np.random.default_rng(0).integers(8 * len(whole), size=200):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            found = util.load_torch(path)
        except UserError as error:
            refused += "\n" not in str(error)
        else:
            assert torch.equal(found.pop("w"), weights)
            assert found == {"episode": 3}
    assert refused > 100


def test_changed_code_is_dirty_and_changed_results_are_not(tmp_path):
    def git(*arguments):
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments]
        done = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    code, written = tmp_path / "trainer/code.py", tmp_path / "results/paper/left_turn.jsonl"
    for path in (code, written):
        path.parent.mkdir(parents=True)
        path.write_text("as committed")
    for words in ("init -q", "add -A", "commit -qm all"):
        git(*words.split())
    commit = git("rev-parse", "HEAD")
    written.write_text("a run has written")
    revision_of = util.source_revision.__wrapped__
    assert revision_of(code.parent) == commit
    code.write_text("changed")
    assert revision_of(code.parent) == f"{commit}-dirty"
    assert revision_of(tmp_path.parent) == "unknown"
