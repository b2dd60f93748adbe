"""One training in a directory at a time, and no human model over another."""

import os

import pytest

from edge_runtime.util import UserError
from trainer.locks import LOCK_FILE, claimed, held, holder
from trainer.tests.test_commands import call


@pytest.mark.parametrize("command", ["train", "human"])
def test_a_second_training_in_a_directory_is_refused(command, capsys, tmp_path):
    run_dir = tmp_path / "run"
    with claimed(run_dir):
        (run_dir / "metrics.csv").write_text("the first's")
        status, out, err = call(capsys, command, "--out", str(run_dir), "--episodes", "1")
        assert (status, out, len(err.splitlines())) == (2, "", 1)
        assert f"{run_dir} is being trained in by process {os.getpid()} on " in err
    assert [path.name for path in run_dir.iterdir()] == ["metrics.csv"]
    assert (run_dir / "metrics.csv").read_text() == "the first's"


def test_a_directory_that_nothing_came_into_goes_again(tmp_path):
    with pytest.raises(UserError, match="no"), claimed(tmp_path / "a" / "b"):
        raise UserError("no")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine").mkdir()
    with claimed(tmp_path / "mine"):
        pass
    assert (tmp_path / "mine").is_dir()


def test_what_a_killed_process_leaves_keeps_nobody_out(tmp_path):
    (tmp_path / LOCK_FILE).write_text('{"pid": 1, "host": "elsewhere", "more": "than we write"}')
    with claimed(tmp_path):
        assert holder(tmp_path / LOCK_FILE).startswith(f"process {os.getpid()} on ")
    assert list(tmp_path.iterdir()) == []


def test_a_lock_whose_file_was_taken_away_is_no_lock(tmp_path, monkeypatch):
    """Between opening and locking, the one before may have let go, and the file with it."""
    path = tmp_path / "lock"
    opened = []

    def open_late(*arguments):
        opened.append(os_open(*arguments))
        if len(opened) == 1:
            path.unlink()
        return opened[-1]

    os_open = os.open
    monkeypatch.setattr("trainer.locks.os.open", open_late)
    with held(path) as mine, held(path) as second:
        assert (mine, second) == (True, False)
    assert len(opened) == 3
    assert not path.exists()


@pytest.mark.parametrize("content", [b"", b"\xff", b"[]", b"{}"])
def test_a_holder_without_a_name_is_another_process(content, tmp_path):
    (tmp_path / "lock").write_bytes(content)
    assert holder(tmp_path / "lock") == "another process"


def test_a_lock_that_cannot_be_had_is_one_line(tmp_path):
    (tmp_path / LOCK_FILE).mkdir()
    with pytest.raises(UserError, match="cannot lock"), claimed(tmp_path):
        pass


def test_a_human_model_is_not_written_over(capsys, tmp_path):
    (tmp_path / "human_model.pt").write_bytes(b"mine")
    (tmp_path / "nominal.json").write_text("{}")
    status, out, err = call(capsys, "human", "--out", str(tmp_path), "--episodes", "1")
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert "holds a human model; choose another --out" in err
    assert (tmp_path / "human_model.pt").read_bytes() == b"mine"
    assert len(list(tmp_path.iterdir())) == 2
