"""Files that a command reads and writes, and the signals that end it."""

import json
import os
import signal
import socket
from pathlib import Path
from unittest.mock import Mock

import pytest

from edge_runtime import cli, util
from edge_runtime.cli import run_cli, sigterm_as_interrupt
from edge_runtime.config import load_config
from edge_runtime.files import check_writable, write_atomic, write_json_out
from edge_runtime.policy import MAX_POLICY_MIB, load_policy
from edge_runtime.util import UserError, read_bytes


def test_write_atomic_replaces_what_is_whole_and_leaves_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "runs" / "today" / "out.json"
    check_writable(path)
    assert os.listdir(tmp_path) == []  # the folder is made when it is written and not before
    for number in (1, 2):
        write_json_out(path, {"a": number})
    with pytest.raises(ValueError, match="JSON"):
        write_json_out(path, {"a": float("nan")})
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(UserError, match="No space left on device"):
            write_json_out(path, {"a": 3})
    assert json.loads(path.read_text()) == {"a": 2}
    assert os.listdir(path.parent) == ["out.json"]
    write_json_out(None, {"a": 3})
    longest = path.with_name("a" * 250 + ".json")  # as a file system has it
    write_json_out(longest, {"a": 4})
    assert json.loads(longest.read_text()) == {"a": 4}


@pytest.fixture
def special(tmp_path):
    """A pipe and a socket. Devices are spared: a test that fails must not take the machine's."""
    pipe, place = tmp_path / "pipe", tmp_path / "socket"
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(place))
        yield pipe, place


def test_where_nothing_can_be_written_all_stays_as_it_is(tmp_path, special, monkeypatch):
    (tmp_path / "file").touch()
    before = {path: path.lstat() for path in tmp_path.iterdir()}
    for write in (check_writable, lambda path: write_atomic(path, b"x")):
        for name in ("file/out.json", "file/no/out.json", ".", "pipe", "socket"):
            with pytest.raises(UserError):
                write(tmp_path / name)
    monkeypatch.setattr(os, "access", lambda place, _mode: place != str(tmp_path))
    with pytest.raises(UserError):
        check_writable(tmp_path / "runs" / "today" / "out.json")
    assert {path: path.lstat() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("error", "status"),
    [(UserError("two\nlines"), 2), (KeyboardInterrupt(), 130), (OSError(28, "No space", "f"), 2)],
)
def test_run_cli_turns_errors_into_one_line(capfd, error, status):
    def fails(argv):
        raise error

    stdout = os.dup(1)
    assert run_cli(fails, []) == status
    os.dup2(stdout, 1)
    assert capfd.readouterr().err.count("\n") == 1


READERS = {
    "bytes": lambda path: read_bytes(path, "thing"),
    "json": lambda path: util.read_json(path, "thing"),
    "config": lambda path: load_config(path, {}),
    "policy": lambda path: load_policy(path, allow_unsigned=True),
}


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_regular_file_or_too_large_or_deep_is_refused(tmp_path, special, reader):
    hole, deep = tmp_path / "hole", tmp_path / "deep"
    hole.touch()
    os.truncate(hole, (MAX_POLICY_MIB << 20) + 1)
    deep.write_text("a = " * (reader == "config") + "[" * 100_000)
    deeps = () if reader == "bytes" else (deep,)
    for path in (*special, Path("/dev/zero"), tmp_path, hole, *deeps):
        with pytest.raises(UserError):
            READERS[reader](path)


def test_signals_that_end_a_process_are_interrupts_unless_they_are_ignored(monkeypatch):
    monkeypatch.setattr(cli, "AGAIN_S", -1.0)
    before = {number: signal.getsignal(number) for number in cli.ENDING_SIGNALS}
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup: it stays so
    with sigterm_as_interrupt():
        signal.raise_signal(signal.SIGHUP)
        for number in cli.SIGNALS:
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
    signal.signal(signal.SIGHUP, before[signal.SIGHUP])
    assert {number: signal.getsignal(number) for number in cli.ENDING_SIGNALS} == before


@pytest.mark.parametrize("heeded", [True, False])
def test_the_first_signal_asks_to_stop_and_the_next_or_one_unheeded_ends(heeded, monkeypatch):
    before, asked = [signal.getsignal(each) for each in cli.ENDING_SIGNALS], []

    def ask():
        asked.append(1)
        return heeded

    with cli.quit_on_signals(ask):
        if heeded:
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGINT)  # So soon it is the same: `timeout` tells twice.
        monkeypatch.setattr(cli, "AGAIN_S", -1.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert asked == [1]
    assert [signal.getsignal(each) for each in cli.ENDING_SIGNALS] == before
