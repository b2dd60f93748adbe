from __future__ import annotations

import json
import os
import socket
import stat

import pytest

from edge_runtime.cli import ArgumentParser, UserError, run_cli, write_json_out
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.latency_window import WINDOW, LatencyWindow


def test_write_atomic_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "out.json"
    write_json_out(path, {"a": 1})
    write_json_out(path, {"a": 2})
    assert json.loads(path.read_text()) == {"a": 2}
    assert os.listdir(tmp_path) == ["out.json"]
    write_json_out(None, {"a": 3})


def test_a_result_that_is_no_json_leaves_the_old_file(tmp_path):
    path = tmp_path / "out.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="JSON"):
        write_json_out(path, {"a": float("nan")})
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.json"]


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    for bad in (tmp_path / "file" / "out.json", tmp_path / "file" / "no" / "out.json", tmp_path):
        with pytest.raises(UserError):
            check_writable(bad)
        with pytest.raises(UserError):
            write_atomic(bad, b"x")
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
            with pytest.raises(UserError, match="no regular file"):
                check_writable(path)
            with pytest.raises(UserError, match="no regular file"):
                write_atomic(path, b"x")
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
        with pytest.raises(UserError, match="cannot write"):
            check_writable(path)
        with pytest.raises(UserError, match="cannot write"):
            write_atomic(path, b"x")
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


def test_a_parser_error_is_one_line_and_help_shows_defaults(capsys):
    parser = ArgumentParser(prog="tool")
    parser.add_argument("--runs", type=int, default=50, help="how many")
    with pytest.raises(SystemExit) as caught:
        parser.parse_args(["--runs", "many"])
    assert caught.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert "how many (default: 50)" in parser.format_help()


def test_the_latency_window_forgets():
    window = LatencyWindow()
    assert window.summary_ms() == {"p50": 0.0, "p99": 0.0, "max": 0.0}
    window.add(10**9)
    assert window.summary_ms()["max"] == 1000.0
    for _ in range(WINDOW):
        window.add(2_000_000)
    assert window.summary_ms() == {"p50": 2.0, "p99": 2.0, "max": 2.0}
