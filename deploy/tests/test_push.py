"""`deploy push` with stand-ins for ssh and scp: real processes that work on this computer."""

import os
import sys
from pathlib import Path

import pytest

from deploy.__main__ import main
from deploy.certs import write_key_pair
from hil_tests.testing.commands import exit_status

SSH = """\
#!{python}
import subprocess, sys
assert sys.argv[1:5] == ["-o", "BatchMode=yes", "-o", "ConnectTimeout=10"], sys.argv
host, command = sys.argv[5:]
open({log!r}, "a").write(f"ssh {{host}} {{command}}\\n")
if host == "nowhere":
    sys.exit(255)
sys.exit(subprocess.run(["sh", "-c", command], cwd={home!r}).returncode)
"""
SCP = """\
#!{python}
import shutil, sys
assert sys.argv[1:7] == ["-q", "-p", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10"], sys.argv
file, target = sys.argv[7:]
host, _, path = target.partition(":")
open({log!r}, "a").write(f"scp {{target}}\\n")
assert file.startswith("/"), file  # or scp would look for a host
if host == "full" and target.endswith(".tar"):
    sys.exit("scp: write remote: No space left on device")
shutil.copy2(file, {home!r} + "/" + path)
"""
PROGRAMS = ["ssh"] + ["scp"] * 4 + ["ssh"] * 2


@pytest.fixture
def far(tmp_path, monkeypatch):
    """A far computer: its home is a folder here. Its log says what was asked of it."""
    home, programs = tmp_path / "home", tmp_path / "programs"
    home.mkdir()
    programs.mkdir()
    (tmp_path / "log").touch()
    names = {"python": sys.executable, "log": str(tmp_path / "log"), "home": str(home)}
    for name, text in (("ssh", SSH), ("scp", SCP)):
        (programs / name).write_text(text.format(**names))
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    yield tmp_path
    assert list(home.iterdir()) == []  # What has come may hold the vehicle's private key.


def asked(far: Path) -> list[str]:
    return [line.split()[0] for line in (far / "log").read_text().splitlines()]


@pytest.fixture
def push(far, board, workshop):
    def pushed(*arguments: object) -> int:
        options = ["--trust", workshop.public_key, "--root", board.root, "--no-sudo"]
        return exit_status(main, ["push", *map(str, [*arguments, *options])])

    return pushed


def test_a_push_installs_a_bundle_of_any_name(far, board, push, workshop):
    made, bundle = workshop.make(), far / "two words;id.tar"
    bundle.write_bytes(made.path.read_bytes())
    Path(f"{bundle}.sig").write_bytes(Path(f"{made.path}.sig").read_bytes())
    assert push("phil@board", bundle, "--service", "none") == 0
    assert asked(far) == PROGRAMS
    assert board.status()["current"] == made.manifest.version


def test_a_dry_run_prints_each_command_and_does_none(far, board, push, workshop, capsys):
    assert push("board", workshop.make().path, "--dry-run") == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == PROGRAMS
    assert asked(far) == []
    assert not board.root.exists()


def test_the_boards_refusal_is_the_exit_status(far, board, push, workshop):
    """The board trusts somebody else's key already."""
    board.root.mkdir()
    (board.root / "trusted.pub").write_bytes(write_key_pair(far / "other")[1].read_bytes())
    assert push("board", workshop.make().path, "--service", "none") == 2
    assert [p.name for p in board.root.iterdir()] == ["trusted.pub"]
    (board.root / "trusted.pub").unlink()


@pytest.mark.parametrize(("host", "expected"), [("nowhere", PROGRAMS[:1]), ("full", None)])
def test_a_push_that_fails_ends_at_once(far, board, push, workshop, host, expected, capfd):
    assert push(host, workshop.make().path) == 2
    assert len([line for line in capfd.readouterr().err.splitlines() if "error: " in line]) == 1
    assert asked(far) == (expected or ["ssh", "scp", "scp", "scp", "ssh"])
    assert not board.root.exists()


@pytest.mark.parametrize("host", ["-oProxyCommand=touch x", "a b", "", "$(id)"])
def test_a_host_that_would_be_an_option_or_a_command_is_refused(far, push, workshop, host):
    assert push(*(["--"] if host[:1] == "-" else []), host, workshop.make().path) == 2
    assert asked(far) == []


def test_a_bundle_that_the_board_would_refuse_is_not_sent(far, push, workshop):
    made, changed = workshop.make(), far / "changed.tar"
    changed.write_bytes(made.path.read_bytes() + b"x")
    Path(f"{changed}.sig").write_bytes(Path(f"{made.path}.sig").read_bytes())
    assert push("board", changed) == 2
    assert asked(far) == []
