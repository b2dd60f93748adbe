"""Files that a command reads: regular, of a sane size, and nested no deeper than can be read."""

from __future__ import annotations

import json
import os
import signal
import socket
import stat
from pathlib import Path

import pytest

from edge_runtime import util
from edge_runtime.cli import run_cli, sigterm_as_interrupt
from edge_runtime.config import load_config
from edge_runtime.files import Hold, check_writable, write_atomic, write_json_out
from edge_runtime.policy import load_policy
from edge_runtime.service import WINDOW, LatencyWindow
from edge_runtime.tests.harness import run_command
from edge_runtime.util import UserError, printable, read_bytes


def test_write_atomic_replaces_what_is_whole_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "out.json"
    write_json_out(path, {"a": 1})
    write_json_out(path, {"a": 2})
    with pytest.raises(ValueError, match="JSON"):
        write_json_out(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 2}
    assert os.listdir(tmp_path) == ["out.json"]
    write_json_out(None, {"a": 3})


def refused(path, match=None):
    for write in (check_writable, lambda path: write_atomic(path, b"x")):
        with pytest.raises(UserError, match=match):
            write(path)


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    for bad in (tmp_path / "file" / "out.json", tmp_path / "file" / "no" / "out.json", tmp_path):
        refused(bad)
    assert os.listdir(tmp_path) == ["file"]


def test_the_folder_of_an_output_is_made_when_it_is_written_and_not_before(tmp_path):
    path = tmp_path / "runs" / "today" / "out.json"
    check_writable(path)
    assert os.listdir(tmp_path) == []
    write_json_out(path, {"a": 1})
    assert json.loads(path.read_text()) == {"a": 1}


def test_a_folder_that_may_not_be_written_is_said_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda place, _mode: place != str(tmp_path))
    with pytest.raises(UserError, match=f"the directory {tmp_path} is read-only"):
        check_writable(tmp_path / "runs" / "today" / "out.json")


def test_what_is_no_regular_file_is_refused_and_stays(tmp_path):
    """Devices are spared: a test that fails must not take the machine's away."""
    pipe, link, place = tmp_path / "pipe", tmp_path / "link", tmp_path / "socket"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(place))
        for path in (pipe, link, place):
            refused(path, "no regular file")
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert link.is_symlink()
    assert stat.S_ISSOCK(place.stat().st_mode)
    assert sorted(os.listdir(tmp_path)) == ["link", "pipe", "socket"]


@pytest.mark.parametrize("there", [True, False], ids=["there", "not yet there"])
def test_a_link_stays_and_the_file_behind_it_is_written(tmp_path, there):
    target, link = tmp_path / "kept" / "out.json", tmp_path / "link.json"
    target.parent.mkdir()
    if there:
        target.write_text("old")
    link.symlink_to("kept/out.json")
    check_writable(link)
    write_json_out(link, {"a": 1})
    assert os.readlink(link) == "kept/out.json"
    assert json.loads(target.read_text()) == {"a": 1}
    assert sorted(os.listdir(tmp_path)) == ["kept", "link.json"]
    assert os.listdir(target.parent) == ["out.json"]


def test_a_link_that_leads_nowhere_is_refused(tmp_path):
    lost, circle = tmp_path / "lost", tmp_path / "circle"
    lost.symlink_to(tmp_path / "no" / "out.json")
    circle.symlink_to(circle)
    for path in (lost, circle):
        refused(path, "cannot write")
        assert path.is_symlink()


def test_run_cli_turns_errors_into_one_line(capsys):
    def bad(argv):
        raise UserError("two\nlines")

    def interrupted(argv):
        raise KeyboardInterrupt

    assert run_cli(bad, []) == 2
    assert capsys.readouterr().err == "error: two lines\n"
    assert run_cli(interrupted, []) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert run_cli(lambda argv: len(argv), ["a"]) == 1


def test_run_cli_names_the_file_that_the_system_refuses(tmp_path, capsys):
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "below"
    assert run_cli(lambda argv: len(os.listdir(path)), []) == 2
    assert capsys.readouterr().err == f"error: {path}: Not a directory\n"


def test_run_cli_hides_no_error_that_is_about_no_file():
    def broken(argv):
        raise OSError("about a socket")

    with pytest.raises(OSError, match="about a socket"):
        run_cli(broken, [])


def test_the_latency_window_forgets():
    window = LatencyWindow()
    assert window.summary_ms() == {"p50": 0.0, "p99": 0.0, "max": 0.0}
    window.add(10**9)
    assert window.summary_ms()["max"] == 1000.0
    for _ in range(WINDOW):
        window.add(2_000_000)
    assert window.summary_ms() == {"p50": 2.0, "p99": 2.0, "max": 2.0}


READERS = {
    "bytes": lambda path: read_bytes(path, "thing"),
    "json": lambda path: util.read_json(path, "thing"),
    "toml": lambda path: util.read_toml(path, "thing"),
    "config": lambda path: load_config(path, {}),
    "policy": lambda path: load_policy(path, allow_unsigned=True),
    "hold": lambda path: Hold(str(path)),
}


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_regular_file_is_refused_and_not_waited_for(tmp_path, reader):
    pipe, place = tmp_path / "pipe", tmp_path / "socket"
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(place))
        for path in (pipe, place, Path("/dev/zero"), tmp_path):
            with pytest.raises(UserError, match=r"cannot be read|is a directory"):
                READERS[reader](path)


@pytest.mark.parametrize("reader", ["bytes", "json", "toml", "config", "policy"])
def test_what_is_too_large_is_refused_before_it_is_read(tmp_path, reader):
    path = tmp_path / "hole"
    path.touch()
    os.truncate(path, (util.MAX_FILE_MIB << 20) + 1)
    with pytest.raises(UserError, match=f"is larger than {util.MAX_FILE_MIB} MiB"):
        READERS[reader](path)


def test_a_file_that_does_not_know_its_size_is_read_to_its_end():
    assert read_bytes("/proc/self/status", "status").startswith(b"Name:")


@pytest.mark.parametrize("place", ["list", "table"])
def test_nested_thousands_deep_it_is_one_line(tmp_path, place):
    path = tmp_path / "deep"

    def nested(opening, closing):
        return opening * 100_000 + "1" + closing * 100_000

    path.write_text(nested("[", "]") if place == "list" else nested('{"a":', "}"))
    with pytest.raises(UserError, match=r"thing .* is not JSON: "):
        util.read_json(path, "thing")
    path.write_text("a = " + (nested("[", "]") if place == "list" else nested("{a=", "}")))
    with pytest.raises(UserError, match=r"config file .* is no TOML: "):
        load_config(path, {})


def test_run_ends_with_one_line(make_policy, tmp_path):
    pipe, deep = tmp_path / "pipe", tmp_path / "deep.toml"
    os.mkfifo(pipe)
    deep.write_text("a = " + "[" * 100_000)
    held = tmp_path / "held.toml"
    held.write_text(f"hold = '{pipe}'\n")
    flags = make_policy().flags
    for arguments in (
        ["--policy", str(pipe), "--allow-unsigned"],
        ["--policy", "/dev/zero", "--allow-unsigned"],
        [*flags, "--config", str(deep)],
        [*flags, "--config", str(held)],
    ):
        done = run_command("run", *arguments)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr


def test_one_is_not_many():
    words = [util.counted(count, "safe stop") for count in range(3)]
    assert words == ["0 safe stops", "1 safe stop", "2 safe stops"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a brake, 0.5 m/s\u00b2", "a brake, 0.5 m/s\u00b2"),
        ("\x1b[2J\x1b]0;title\x07", r"\x1b[2J\x1b]0;title\x07"),
        ("\x9b31m", r"\x9b31m"),  # the same as ESC [, in one character
        ("abc\u202edcb", r"abc\u202edcb"),  # from here on right to left
        ("line\r\nline", r"line\r\nline"),
        ("\udcff", r"\udcff"),  # a byte that is no UTF-8
    ],
)
def test_what_a_terminal_acts_upon_is_written_out(text, shown):
    assert printable(text) == shown


@pytest.fixture
def all_at_default():
    """Every signal as a fresh process has it."""
    before = {}
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        before[number] = signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_all_that_end_a_process_are_interrupts(all_at_default):
    ending = util.ending_signals()
    assert {signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM} <= ending
    assert {signal.SIGUSR1, signal.SIGALRM, signal.SIGABRT, signal.SIGPIPE} <= ending
    assert not {signal.SIGCHLD, signal.SIGCONT, signal.SIGTSTP, signal.SIGSEGV} & ending
    with sigterm_as_interrupt():
        for number in ending:
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
        assert util.ending_signals() == set()
    assert util.ending_signals() == ending


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda number, frame: None])
def test_one_that_somebody_ignores_or_handles_stays_so(all_at_default, handler):
    signal.signal(signal.SIGHUP, handler)
    with sigterm_as_interrupt():
        signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is handler
