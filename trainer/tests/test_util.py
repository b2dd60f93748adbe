import subprocess
import zipfile

import numpy as np
import pytest
import torch

from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import refusal
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


def test_a_packed_checkpoint_is_refused_before_it_fills_the_memory(tmp_path):
    path, packed = tmp_path / "c.pt", tmp_path / "packed.pt"
    util.save_torch(path, {"episode": 3})
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as copy:
        for name in whole.namelist():
            copy.writestr(name, whole.read(name))
    with pytest.raises(UserError):
        util.load_torch(packed)


def test_what_asks_for_more_than_the_limit_of_memory_fails_by_itself():
    with util.limited_memory(64):
        np.ones(1 << 20)
        with pytest.raises(MemoryError):
            np.ones(1 << 24)
    np.ones(1 << 24)


def test_a_revision_is_a_commit_dirty_where_files_differ(tmp_path):
    def git(*words):
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *words]
        return subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)

    revision_of, code = util.source_revision.__wrapped__, tmp_path / "code.py"
    code.write_text("as committed")
    for words in ("init -q", "add -A", "commit -qm all", "tag -am all v1"):
        git(*words.split())
    commit = git("rev-parse", "HEAD").stdout.strip()
    assert revision_of(tmp_path) == commit
    code.write_text("changed")
    assert revision_of(tmp_path) == f"{commit}-dirty"
    assert revision_of(tmp_path.parent) == "unknown"
