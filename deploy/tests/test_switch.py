"""The order of the installer's steps: real folders, and a service that notes what it is told."""

import contextlib
import errno
import functools
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy.installer import __main__ as installer
from deploy.installer.release import CURRENT, PREVIOUS, Manifest, Releases
from deploy.installer.systemd import Systemd, UnhealthyError
from deploy.tests.boards import HERE
from edge_runtime.files import write_atomic
from hil_tests.tests.shared.policies import public_pem

EARLIER, OLD, NEW = "0.1.0-earlier", "0.1.0-old", "0.1.0-new"


class Service(Systemd):
    """Runs the release that `current` names. The `bad` one does not get healthy."""

    def __init__(self, root: Path) -> None:
        self.releases = Releases(str(root))
        self.running: str | None = None
        self.bad: str | None = None
        self.error: BaseException = UnhealthyError("it ended")

    def group(self) -> int:
        return os.getgid()

    def stop(self) -> None:
        self.running = None

    def prepare(self, folder: Path) -> None:
        write_atomic(self.releases.root / "unit", folder.name.encode())

    def start(self) -> None:
        self.running = self.releases.linked(CURRENT)
        if self.running == self.bad:
            if isinstance(self.error, KeyboardInterrupt):
                self.bad = None
            raise self.error

    def remove(self) -> None:
        self.running = None


@pytest.fixture
def board(tmp_path, monkeypatch):
    """A board on which OLD runs, and EARLIER is the release before it."""
    root, key = tmp_path / "root", tmp_path / "key.pub"
    service = Service(root)
    key.write_bytes(public_pem(Ed25519PrivateKey.generate()))

    def read_bundle(version: str, key: str) -> tuple[Manifest, dict[str, bytes]]:
        return Manifest(version, "hunter01", "policy", *HERE), {"config.toml": b""}

    monkeypatch.setattr(installer.release, "read_bundle", read_bundle)
    monkeypatch.setattr(installer, "choose", lambda *_: service)
    monkeypatch.setattr(installer, "_prove", lambda *_: None)
    for name in ("fsync", "sync"):
        monkeypatch.setattr(os, name, lambda *_: None)
    handlers = {one: signal.getsignal(one) for one in (*installer.SIGNALS, signal.SIGHUP)}

    def run(*words: str) -> int:
        more = ("--trust", str(key)) if words[0] == "install" else ()
        return installer.main([*words, "--root", str(root), *more])

    def runs_old() -> None:
        assert [run("install", version) for version in (EARLIER, OLD)] == [0, 0]
        assert {path.name for path in (root / "releases").iterdir()} == {EARLIER, OLD}

    before = os.umask(0o077)  # the caller's must not lock the service's user out
    runs_old()
    yield SimpleNamespace(run=run, releases=service.releases, service=service, runs_old=runs_old)
    os.umask(before)
    for one, handler in handlers.items():
        signal.signal(one, handler)


STEPS = {"os.rename": 1, "os.symlink": 1, "os.remove": 0, "os.rmdir": 0, "os.mkdir": 0, "open": 0}
"""What changes a disk, as audit events (PEP 578), and which argument is the path."""
_interfere: Callable[[str, str], None] | None = None


def _watch(event: str, arguments: Any) -> None:
    reads = event == "open" and not (isinstance(arguments[2], int) and arguments[2] & os.O_CREAT)
    if _interfere is not None and event in STEPS and not reads:
        _interfere(event, str(arguments[STEPS[event]]))


sys.addaudithook(_watch)


@contextlib.contextmanager
def at_step(number: int, root: Path, act: Callable[[str], None]):
    """Call `act(event)` before the change in `root` of that number, and before those after it."""
    global _interfere
    left = number

    def interfere(event: str, path: str) -> None:
        nonlocal left
        left -= path.startswith(str(root))
        if left <= 0:
            act(event)

    _interfere = interfere
    yield
    _interfere = None


def kill(event: str = "") -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def in_a_child(run: Callable[[], int]) -> int:
    child = os.fork()
    if child == 0:
        os._exit(run())
    return os.waitpid(child, 0)[1]


def cut_off(board, monkeypatch):
    """Kill an upgrade as it starts the new release."""
    with monkeypatch.context() as patch:
        patch.setattr(board.service, "start", kill)
        in_a_child(lambda: board.run("install", NEW))
    assert board.releases.linked(CURRENT) == NEW


@pytest.mark.parametrize(
    ("words", "target", "is_cut_off"),
    [(["install", NEW], NEW, False), (["rollback"], EARLIER, False), (["install", NEW], NEW, True)],
)
def test_killed_before_any_step_a_whole_release_is_current_and_the_same_command_completes(
    board, monkeypatch, words, target, is_cut_off
):
    releases, status, number = board.releases, -1, 0
    while status != 0:
        if is_cut_off:
            cut_off(board, monkeypatch)
        number += 1
        with at_step(number, releases.root, kill):
            status = in_a_child(lambda: board.run(*words))
        current = releases.linked(CURRENT)
        assert current in (OLD, target)
        assert releases.is_whole(current)
        if (current, releases.linked(PREVIOUS)) != (target, OLD):
            assert board.run(*words) == 0
        assert (releases.linked(CURRENT), releases.linked(PREVIOUS)) == (target, OLD)
        assert releases.is_whole(target)
        board.runs_old()
    assert number > 4


@pytest.mark.parametrize("trouble", ["full", "interrupt"])
@pytest.mark.parametrize("is_bad", [False, True], ids=["healthy", "bad"])
def test_on_a_full_disk_or_interrupted_a_whole_release_runs(board, trouble, is_bad):
    releases, service = board.releases, board.service
    service.bad = NEW if is_bad else None
    number, acted = 0, [""]

    def act(event: str) -> None:
        if trouble == "full" and event in ("os.symlink", "os.mkdir", "open"):
            acted.append(event)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "disk")
        if trouble == "interrupt" and not acted:
            acted.append(event)
            signal.raise_signal(signal.SIGINT)

    while acted:
        number += 1
        acted.clear()
        with at_step(number, releases.root, act):
            status = board.run("install", NEW)
        assert status == (1 if is_bad else 0) if not acted else status in (0, 1, 2, 130)
        assert releases.linked(CURRENT) == (OLD if status == 1 else service.running)
        assert releases.is_whole(releases.linked(CURRENT))
        assert service.running == (NEW if status == 0 else OLD) or (not is_bad and status != 1)
        if service.running != OLD:
            board.runs_old()
    assert number > 10


@pytest.mark.parametrize("is_cut_off", [False, True])
def test_a_first_release_that_is_bad_leaves_nothing(board, monkeypatch, is_cut_off):
    assert board.run("uninstall") == 0
    assert list(board.releases.root.iterdir()) == [board.releases.root / "unit"]
    if is_cut_off:
        cut_off(board, monkeypatch)
    board.service.bad = NEW
    assert board.run("install", NEW) == 1
    assert board.service.running is board.releases.linked(CURRENT) is None
    assert list((board.releases.root / "releases").iterdir()) == []


@pytest.mark.parametrize("is_cut_off", [False, True])
@pytest.mark.parametrize("error", [UnhealthyError("it ended"), KeyboardInterrupt()])
@pytest.mark.parametrize("words", [["rollback"], ["install", OLD], ["install", NEW]])
def test_what_served_before_stays_when_it_fails(board, monkeypatch, words, error, is_cut_off):
    if is_cut_off:
        cut_off(board, monkeypatch)
    # After an upgrade that was cut off, `rollback` undoes it.
    undoes = is_cut_off and words[-1] != NEW
    board.service.bad = NEW if is_cut_off else EARLIER if words == ["rollback"] else words[-1]
    board.service.error = error
    assert board.run(*words) == (0 if undoes else 1)
    assert board.releases.linked(CURRENT) == board.service.running == OLD
    assert board.releases.linked(PREVIOUS) == EARLIER


def test_a_service_that_does_not_stop_or_more_signals_do_not_keep_it_from_going_back(
    board, monkeypatch
):
    service, stop = board.service, board.service.stop
    service.bad, service.error = NEW, KeyboardInterrupt()

    def stop_badly() -> None:
        stop()
        if service.releases.linked(CURRENT) == NEW:
            for number in (signal.SIGINT, signal.SIGHUP):
                os.kill(os.getpid(), number)
            raise UnhealthyError("it does not stop")

    monkeypatch.setattr(service, "stop", stop_badly)
    assert board.run("install", NEW) == 1
    assert board.releases.linked(CURRENT) == service.running == OLD


def test_only_one_installer_is_at_work(board):
    assert (board.releases.folder(OLD) / "bin").stat().st_mode & 0o777 == 0o755
    with board.releases.locked():
        for words in (["install", NEW], ["rollback"], ["uninstall"]):
            status = in_a_child(functools.partial(board.run, *words))
            assert os.waitstatus_to_exitcode(status) == 2
    assert board.service.running == OLD


def test_all_is_on_the_disk_before_a_release_has_its_name(board, monkeypatch):
    synced, folder = [], board.releases.folder(NEW)
    monkeypatch.setattr(os, "sync", lambda: synced.append(folder.exists()))
    board.run("install", NEW)
    assert synced[:2] == [False, True]


def test_a_damaged_release_is_made_again_beside_the_service(board):
    (board.releases.folder(OLD) / "config.toml").write_text("changed = true")
    assert not board.releases.is_whole(OLD)
    assert [board.run("rollback"), board.run("rollback")] == [0, 2]
    assert board.releases.linked(CURRENT) == EARLIER
    assert board.run("install", OLD) == 0
    assert board.releases.is_whole(OLD)


@pytest.mark.parametrize("name", [CURRENT, PREVIOUS, ".before", ".next"])
def test_what_stands_in_a_links_place_is_refused_and_the_service_goes_on(board, name):
    place = board.releases.root / name
    place.unlink(missing_ok=True)
    place.mkdir()
    for words in (["install", NEW], ["rollback"], ["uninstall"]):
        assert board.run(*words) == 2
        assert board.service.running == OLD
    assert {board.releases.is_whole(version) for version in (EARLIER, OLD)} == {True}


def test_what_is_no_release_stays(board):
    lost = board.releases.folder("lost+found") / "#1"
    lost.parent.mkdir()
    lost.write_text("of another")
    lost.parent.with_name("notes").write_text("of another")
    commands = (["install", NEW], ["rollback"], ["uninstall"])
    assert [board.run(*words) for words in commands] == [0, 0, 0]
    left = sorted(path.name for path in board.releases.root.rglob("*"))
    assert left == ["#1", "lost+found", "notes", "releases", "unit"]


def test_the_old_release_goes_on_where_the_disk_can_no_more_be_written(board, monkeypatch):
    stop = board.service.stop

    def fail(event: str) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), "disk")

    with contextlib.ExitStack() as until_started:

        def stop_and_fail() -> None:
            stop()
            until_started.enter_context(at_step(1, board.releases.root, fail))

        monkeypatch.setattr(board.service, "stop", stop_and_fail)
        assert board.run("install", NEW) != 0
    assert board.service.running == OLD
