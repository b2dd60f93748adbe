"""Files that a command reads: regular, of a sane size, and nested no deeper than can be read."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from edge_runtime.config import load_config
from edge_runtime.errors import UserError
from edge_runtime.files import MAX_FILE_MIB, read_bytes, read_json, read_toml
from edge_runtime.hold import Hold
from edge_runtime.policy import load_policy
from edge_runtime.tests.harness import run_command

READERS = {
    "bytes": lambda path: read_bytes(path, "thing"),
    "json": lambda path: read_json(path, "thing"),
    "toml": lambda path: read_toml(path, "thing"),
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
    os.truncate(path, (MAX_FILE_MIB << 20) + 1)
    with pytest.raises(UserError, match=f"is larger than {MAX_FILE_MIB} MiB"):
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
        read_json(path, "thing")
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
