"""What the installer refuses, in one line and with nothing written; and what it mends."""

from __future__ import annotations

import fcntl
import platform
import subprocess

import pytest

from deploy.bundle import make_bundle
from deploy.campaigns.light import HERE
from deploy.installer import release as release_module
from deploy.installer import systemctl
from deploy.installer.layout import Layout, sync_all
from deploy.keys import write_key_pair
from deploy.tests.boards import Board, changed_wheel


def refused(done, *words: str) -> None:
    said = done.stderr.strip().splitlines()
    assert (done.returncode, len(said)) == (2, 1), done.stderr
    assert all(word in said[0] for word in words), said


def test_a_board_that_trusts_nobody_yet_must_be_told_whom(board: Board, workshop):
    refused(board.run("install", workshop.make().path), "trusts no key yet", "--trust")
    refused(board.run("install", workshop.make().path, "--trust", "missing.pub"), "missing.pub")
    refused(board.run("install", workshop.make().path, "--trust", workshop.key), "not a PEM public")
    assert not board.root.exists()


def test_a_bundle_of_another_key_is_refused_now_and_later(board: Board, workshop, tmp_path):
    private, public = write_key_pair(tmp_path / "other")
    foreign = workshop.make(0.2, key=private)
    refused(board.install(foreign.path), "signature is not of the key")
    assert not board.root.exists()
    assert board.install(workshop.make(0.1).path).returncode == 0
    before = board.fingerprint()
    refused(board.run("install", foreign.path), "signature is not of the key")
    refused(board.run("install", foreign.path, "--trust", public), "trusts another key")
    assert board.fingerprint() == before


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"python": "3.7"}, "run it with python3.7"),
        ({"machine": "riscv64"}, f"this is {platform.machine()}"),
        ({"glibc": "9.99"}, "needs glibc 9.99"),
    ],
)
def test_a_bundle_for_another_computer_is_refused(board: Board, workshop, tmp_path, changes, word):
    made = make_bundle(workshop.inputs(), HERE._replace(**changes), tmp_path)
    refused(board.install(made.path), word)
    assert not board.root.exists()


def test_a_policy_that_may_not_drive_there_changes_nothing(board: Board, workshop, tmp_path):
    """`check` of the release's own runtime says no: the release before stays."""
    good = workshop.make(0.1)
    assert board.install(good.path).returncode == 0
    wheel = changed_wheel(
        workshop.edge_wheel, tmp_path / "w", "edge_runtime/policy.py", "OPSET = 17", "OPSET = 18"
    )
    done = board.install(workshop.make(0.2, wheels=[wheel, workshop.host]).path)
    assert done.returncode == 1
    assert "edge_runtime check" in done.stderr
    assert "opset" in done.stderr
    assert board.status()["current"] == good.manifest.version
    assert Layout(str(board.root)).versions() == [good.manifest.version]


def test_a_damaged_release_is_said_and_made_again(board: Board, workshop):
    made = workshop.make(0.1)
    assert board.install(made.path).returncode == 0
    victim = board.root / "current" / "site-packages" / "edge_runtime" / "safety.py"
    victim.write_text("# nothing left\n")
    shown = board.run("status")
    assert shown.returncode == 1
    assert "edge_runtime/safety.py" in shown.stdout
    done = board.install(made.path)
    assert done.returncode == 0
    assert "damaged" in done.stdout
    assert board.status()["whole"] == "yes"


def test_it_installs_to_the_end_where_nobody_reads_what_it_says(board: Board, workshop):
    """An ssh link that broke: its pipe has no reader."""
    made = workshop.make(0.1)
    line = board.command("install", made.path, "--trust", workshop.public_key)
    with subprocess.Popen([*line, "--service", "none"], stdout=subprocess.PIPE) as run:
        assert run.stdout is not None
        run.stdout.close()
    assert run.returncode == 0
    assert board.status()["current"] == made.manifest.version


def test_one_installer_at_a_time(board: Board, workshop):
    made = workshop.make(0.1)
    assert board.install(made.path).returncode == 0
    before = board.fingerprint()
    with open(board.root / ".lock", "r+") as other:
        fcntl.lockf(other, fcntl.LOCK_EX)
        refused(board.install(made.path), "another installer is at work")
        refused(board.run("rollback"), "another installer is at work")
    assert [row[0] for row in board.fingerprint()] == [row[0] for row in before]


def test_there_must_be_something_to_go_back_to(board: Board, workshop):
    refused(board.run("rollback", "--root", board.root), "no earlier release")
    refused(board.run("status"), "nothing is installed")
    assert board.install(workshop.make(0.1).path).returncode == 0
    refused(board.run("rollback"), "no earlier release")


def test_uninstall_takes_only_what_is_ours(board: Board, workshop):
    refused(board.run("uninstall"), "nothing is installed")
    assert board.install(workshop.make(0.1).path).returncode == 0
    (board.root / "diary.txt").write_text("not ours")
    done = board.run("uninstall")
    assert done.returncode == 0
    assert "stays" in done.stdout
    assert [p.name for p in board.root.iterdir()] == ["diary.txt"]
    (board.root / "diary.txt").unlink()
    board.root.rmdir()


def test_all_is_on_the_disk_before_a_release_has_its_name(workshop, tmp_path, monkeypatch):
    """The order that a SIGKILL cannot show: written, synced, and only then renamed."""
    from deploy.installer import ed25519
    from deploy.installer.archive import open_bundle

    order = []
    layout = Layout(str(tmp_path / "root"))

    def synced(folder):
        order.append(("synced", sorted(p.name for p in folder.iterdir())[-1], folder.exists()))
        sync_all(folder)

    monkeypatch.setattr(release_module, "sync_all", synced)
    key = ed25519.parse_public_key(workshop.public_key.read_bytes())
    with layout.locked(), open_bundle(str(workshop.make(0.1).path), key) as bundle:
        version = bundle.manifest.version
        monkeypatch.setattr(
            release_module, "sync_folder", lambda p: order.append(("named", p.name, p.exists()))
        )
        folder = release_module.make_release(bundle, layout, None)
    assert [row[0] for row in order] == ["synced", "named"]
    assert folder == layout.release(version)
    assert release_module.why_not_whole(folder) == ""


@pytest.mark.skipif(systemctl.is_there(), reason="systemd runs this computer")
def test_a_systemd_that_does_not_run_is_said_before_anything_is_made(board: Board, workshop):
    refused(board.install(workshop.make(0.1).path, "systemd"), "no systemd runs this computer")
    assert not board.root.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        [], ["install"], ["fly"], ["status", "--service", "cron"], ["install", "missing.tar"],
        ["supervise", "--root", "/nowhere/at/all"],
    ],
)  # fmt: skip
def test_a_mistake_is_one_line(board: Board, arguments):
    command, *rest = arguments or [""]
    line = board.command(command, *rest) if arguments else board.command("status")[:3]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stderr.strip().splitlines())) == (2, 1), done.stderr
    assert not board.root.exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--health-limit", "soon"), ("--health-limit", "0"), ("--health-limit", "inf"),
        ("--settle", "-1"), ("--settle", "nan"), ("--settle", "inf"),
    ],
)  # fmt: skip
def test_what_is_no_number_of_seconds_is_refused(board: Board, option, value):
    """Above all one that would wait for ever."""
    line = board.command("rollback", option, value)
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2, done.stderr
    assert f"argument {option}: {value!r} is not a number of seconds" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not board.root.exists()
