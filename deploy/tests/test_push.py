"""`deploy push` with stand-ins for ssh and scp: real processes that work on this computer."""

import os
import sys
from pathlib import Path

import pytest

from deploy.__main__ import main
from deploy.bundle import make_bundle
from deploy.certs import write_key_pair
from deploy.tests.boards import HERE
from hil_tests.testing.commands import exit_status

SSH = """\
#!{python}
import os, subprocess, sys
assert sys.argv[1:5] == ["-o", "BatchMode=yes", "-o", "ConnectTimeout=10"], sys.argv
host, command = sys.argv[5:]
with open({log!r}, "a") as log:
    log.write(f"ssh {{host}} {{command}}\\n")
if host == "nowhere":
    print("ssh: Could not resolve hostname nowhere", file=sys.stderr)
    sys.exit(255)
sys.exit(subprocess.run(["sh", "-c", command], cwd={home!r}).returncode)
"""
SCP = """\
#!{python}
import shutil, sys
assert sys.argv[1:7] == ["-q", "-p", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10"], sys.argv
*files, target = sys.argv[7:]
host, _, folder = target.partition(":")
with open({log!r}, "a") as log:
    log.write(f"scp {{host}} {{folder}}\\n")
assert all(file.startswith("/") for file in files), files  # or scp would look for a host
for file in files:
    if host == "full" and target.endswith(".tar"):
        sys.exit("scp: write remote: No space left on device")
    shutil.copy2(file, {home!r} + "/" + folder)
"""
PROGRAMS = ["ssh"] * 2 + ["scp"] * 4 + ["ssh"] * 2


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
    return tmp_path


@pytest.fixture
def push(far, board, workshop):
    def pushed(*arguments: object) -> int:
        options = ["--trust", workshop.public_key, "--root", board.root, "--no-sudo"]
        return exit_status(main, ["push", *map(str, [*arguments, *options])])

    return pushed


def test_a_push_installs_a_bundle_of_any_name_and_leaves_nothing_behind(
    far, board, push, workshop, capfd
):
    for number, name in enumerate(("install.pyz", "trust.pub", "-q.tar", "two words;id.tar")):
        made, bundle = workshop.make(number / 10), far / name
        bundle.write_bytes(made.path.read_bytes())
        Path(f"{bundle}.sig").write_bytes(Path(f"{made.path}.sig").read_bytes())
        (far / "log").write_text("")
        assert push("phil@board", bundle, "--service", "none") == 0
        said = capfd.readouterr().out
        assert f"verified {made.manifest.version}" in said
        assert f"current: {made.manifest.version}" in said
        assert list((far / "home").iterdir()) == []
        log = (far / "log").read_text().splitlines()
        assert [line.split()[0] for line in log] == PROGRAMS
        assert board.status()["current"] == made.manifest.version


def test_a_dry_run_says_each_step_and_does_none(far, board, push, workshop, capsys):
    made = workshop.make(0.1)
    assert push("board", made.path, "--dry-run") == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said[::2]] == ["#"] * len(PROGRAMS)
    assert [line.split()[0] for line in said[1::2]] == PROGRAMS
    assert str(made.path) in said[9]
    assert "install" in said[13]
    assert not (far / "log").read_text()
    assert not board.root.exists()


def test_a_refusal_there_is_told_and_cleaned_up(far, board, push, workshop, tmp_path, capfd):
    """The board trusts somebody else's key already."""
    _, other = write_key_pair(tmp_path / "other")
    made = workshop.make(0.1)
    board.root.mkdir()
    (board.root / "trusted.pub").write_bytes(other.read_bytes())
    assert push("board", made.path, "--service", "none") == 2
    assert "trusts another key" in capfd.readouterr().err
    assert list((far / "home").iterdir()) == []
    assert [p.name for p in board.root.iterdir()] == ["trusted.pub"]


@pytest.mark.parametrize(
    ("host", "machine", "says", "lines"),
    [
        ("nowhere", HERE.machine, "ssh does not reach the board", 1),
        ("board", "riscv64", "the bundle is for riscv64", 1),
        ("full", HERE.machine, "scp ended with status 1", 6),
    ],
)
def test_a_push_that_fails_ends_at_once_and_leaves_nothing_behind(
    far, board, push, workshop, monkeypatch, capfd, host, machine, says, lines
):
    """What has come so far may hold the vehicle's private key."""
    made = make_bundle(workshop.inputs(), HERE._replace(machine=machine), far / "bundles")
    monkeypatch.chdir(made.path.parent)
    assert push(host, made.path.name) == 2
    assert says in capfd.readouterr().err
    assert len((far / "log").read_text().splitlines()) == lines
    assert list((far / "home").iterdir()) == []
    assert not board.root.exists()


@pytest.mark.parametrize("host", ["-oProxyCommand=touch x", "a b", "", "a;b", "$(id)", "user@"])
def test_a_host_that_would_be_an_option_or_a_command_is_refused(far, push, workshop, host):
    assert push(*(["--"] if host[:1] == "-" else []), host, workshop.make(0.1).path) == 2
    assert not (far / "log").read_text()


def test_a_bundle_that_the_board_would_refuse_is_not_sent(far, push, workshop, capsys):
    made, changed = workshop.make(0.1), far / "changed.tar"
    data = bytearray(made.path.read_bytes())
    data[-2000] ^= 1
    changed.write_bytes(data)
    Path(f"{changed}.sig").write_bytes(Path(f"{made.path}.sig").read_bytes())
    assert push("board", changed) == 2
    assert "is refused" in capsys.readouterr().err
    assert push("board", Path("missing.tar")) == 2
    assert not (far / "log").read_text()
