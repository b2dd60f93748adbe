"""`deploy push` with ssh and scp that work on this computer."""

import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from deploy.__main__ import main
from hil_tests.testing.commands import exit_status

PROGRAMS = ["ssh"] + ["scp"] * 4 + ["ssh"] * 2


@pytest.fixture
def far(tmp_path, monkeypatch):
    """A far computer: its home is a folder here; `asked` are the programs that were run."""
    home, asked = tmp_path / "home", []
    home.mkdir()

    def run(command, **_):
        program, *options = command
        *options, last, words = options
        assert "BatchMode=yes" in options
        asked.append(program)
        if program == "ssh":
            if last == "nowhere":
                return SimpleNamespace(returncode=255)
            return subprocess.run(["sh", "-c", words], cwd=home, check=False)
        host, _, path = words.partition(":")
        assert last.startswith("/"), last  # or scp would look for a host
        if host == "full" and path.endswith(".tar"):
            return SimpleNamespace(returncode=1)
        shutil.copy2(last, home / path)
        return SimpleNamespace(returncode=0)

    fake = SimpleNamespace(run=run, DEVNULL=subprocess.DEVNULL)
    monkeypatch.setattr("deploy.push.subprocess", fake)
    yield SimpleNamespace(folder=tmp_path, asked=asked)
    assert list(home.iterdir()) == []  # What has come may hold the vehicle's private key.


@pytest.fixture
def push(far, board, workshop):
    def pushed(*arguments: object) -> int:
        options = ["--trust", workshop.public_key, "--root", board.root, "--no-sudo"]
        return exit_status(main, ["push", *map(str, [*arguments, *options])])

    return pushed


def test_a_push_installs_a_bundle_of_any_name(far, board, push, workshop):
    made, bundle = workshop.make(), far.folder / "two words;id.tar"
    bundle.write_bytes(made.path.read_bytes())
    Path(f"{bundle}.sig").write_bytes(Path(f"{made.path}.sig").read_bytes())
    assert push("phil@board", bundle, "--service", "none") == 0
    assert far.asked == PROGRAMS
    assert board.status()["current"] == made.manifest.version


def test_a_dry_run_prints_each_command_and_does_none(far, board, push, workshop, capsys):
    assert push("board", workshop.make().path, "--dry-run") == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == PROGRAMS
    assert far.asked == []
    assert not board.root.exists()


@pytest.mark.parametrize(("host", "expected"), [("nowhere", PROGRAMS[:1]), ("full", None)])
def test_a_push_that_fails_ends_at_once(far, board, push, workshop, host, expected, capfd):
    assert push(host, workshop.make().path) == 2
    assert len([line for line in capfd.readouterr().err.splitlines() if "error: " in line]) == 1
    assert far.asked == (expected or ["ssh", "scp", "scp", "scp", "ssh"])
    assert not board.root.exists()


@pytest.mark.parametrize("host", ["-oProxyCommand=touch x", "a b", "", "$(id)"])
def test_a_host_that_would_be_an_option_or_a_command_is_refused(far, push, workshop, host):
    assert push(*(["--"] if host[:1] == "-" else []), host, workshop.make().path) == 2
    assert far.asked == []


def test_a_bundle_that_the_board_would_refuse_is_not_sent(far, push, workshop):
    made, changed = workshop.make(), far.folder / "changed.tar"
    changed.write_bytes(made.path.read_bytes() + b"x")
    Path(f"{changed}.sig").write_bytes(Path(f"{made.path}.sig").read_bytes())
    assert push("board", changed) == 2
    assert far.asked == []
