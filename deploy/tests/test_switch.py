"""The order of the installer's steps: real folders, and a service that notes what it is told."""

import contextlib
import errno
import fcntl
import functools
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy.installer import __main__ as installer
from deploy.installer.layout import CURRENT, PREVIOUS, Releases
from deploy.installer.systemd import HealthLimits, Systemd, UnhealthyError
from deploy.installer.verify import BundleManifest, to_json
from deploy.tests.boards import HERE
from edge_runtime.files import write_atomic
from hil_tests.testing.policies import public_pem

EARLIER, OLD, NEW = "0.1.0-earlier", "0.1.0-old", "0.1.0-new"


class Service(Systemd):
    """Runs the release that `current` names. The `bad` one does not get healthy."""

    def __init__(self, root: Path) -> None:
        self.releases = Releases(str(root))
        self.running: str | None = None
        self.told = 0
        self.bad: str | None = None
        self.error: BaseException = UnhealthyError("it ended")
        self.heard: list[str] = []
        """What ran at a moment when it could send commands."""

    def group(self) -> int:
        return os.getgid()

    def stop(self) -> None:
        self.told, self.running = self.told + 1, None

    def prepare(self, folder: Path) -> None:
        write_atomic(self.releases.root / "unit", folder.name.encode())

    def start(self, limits: HealthLimits) -> None:
        self.told, self.running = self.told + 1, self.releases.linked(CURRENT)
        with open(self.releases.hold) as hold, contextlib.suppress(BlockingIOError):
            fcntl.flock(hold, fcntl.LOCK_SH | fcntl.LOCK_NB)
            self.heard.append(str(self.running))
        if self.running == self.bad:
            if isinstance(self.error, KeyboardInterrupt):
                self.bad = None
            raise self.error

    def remove(self) -> None:
        self.running = None


@pytest.fixture
def board(tmp_path, monkeypatch):
    """A board on which OLD runs, and EARLIER is the release before it."""
    root = tmp_path / "root"
    service = Service(root)
    key = tmp_path / "key.pub"
    key.write_bytes(public_pem(Ed25519PrivateKey.generate()))

    def read_bundle(version: str, key: bytes) -> tuple[BundleManifest, dict[str, bytes]]:
        manifest = BundleManifest(version, HERE, "hunter01", "policy")
        return manifest, {"manifest.json": to_json(manifest)}

    monkeypatch.setattr(installer, "read_bundle", read_bundle)
    monkeypatch.setattr(installer, "choose", lambda *_: service)
    monkeypatch.setattr(installer.Installer, "_prove", lambda *_: None)
    for name in ("fsync", "sync"):
        monkeypatch.setattr(os, name, lambda *_: None)
    handlers = {one: signal.getsignal(one) for one in (*installer.SIGNALS, signal.SIGHUP)}

    def run(*words: str) -> int:
        more = ("--trust", str(key)) if words[0] == "install" else ()
        return installer.main([*words, "--root", str(root), *more])

    before = os.umask(0o022)
    assert [run("install", version) for version in (EARLIER, OLD)] == [0, 0]
    service.told = 0
    yield SimpleNamespace(run=run, releases=service.releases, service=service)
    os.umask(before)
    for one, handler in handlers.items():
        signal.signal(one, handler)


STEPS = {"os.rename": 1, "os.symlink": 1, "os.remove": 0, "os.rmdir": 0, "os.mkdir": 0, "open": 0}
"""What changes a disk, as audit events (PEP 578), and which argument is the path."""
MAKES = ("os.symlink", "os.mkdir", "open")
_interfere: Callable[[str, str], None] | None = None


def _watch(event: str, arguments: Any) -> None:
    if _interfere is None or event not in STEPS:
        return
    if event != "open" or (isinstance(arguments[2], int) and arguments[2] & os.O_CREAT):
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
    try:
        yield
    finally:
        _interfere = None
    assert number < 200


def kill(event: str) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def in_a_child(run: Callable[[], int]) -> int:
    """The status of a process that may be killed, as of `os.waitpid`."""
    child = os.fork()
    if child == 0:
        os._exit(run())
    return os.waitpid(child, 0)[1]


@pytest.mark.parametrize(("words", "target"), [(["install", NEW], NEW), (["rollback"], EARLIER)])
def test_killed_before_any_step_a_whole_release_is_current_and_the_same_command_completes(
    board, words, target
):
    releases, status, number = board.releases, -1, 0
    while status != 0:
        number += 1
        with at_step(number, releases.root, kill):
            status = in_a_child(lambda: board.run(*words))
        current = releases.linked(CURRENT)
        assert current in (OLD, target)
        assert releases.damage(current) == []
        linked = releases.linked(CURRENT), releases.linked(PREVIOUS)
        if status != 0 and linked != (target, OLD):
            assert board.run(*words) == 0
            linked = releases.linked(CURRENT), releases.linked(PREVIOUS)
        assert linked == (target, OLD)
        assert releases.damage(target) == []
        # As it was before, for the next step.
        assert [board.run("install", version) for version in (EARLIER, OLD)] == [0, 0]
        assert {path.name for path in (releases.root / "releases").iterdir()} == {EARLIER, OLD}
    assert number > 10


@pytest.mark.parametrize("trouble", ["full", "interrupt"])
@pytest.mark.parametrize("is_bad", [False, True], ids=["healthy", "bad"])
def test_on_a_full_disk_or_interrupted_a_whole_release_runs(board, trouble, is_bad):
    releases, service = board.releases, board.service
    service.bad = NEW if is_bad else None
    number, acted = 0, [""]

    def act(event: str) -> None:
        if (event in MAKES) if trouble == "full" else not acted:
            acted.append(event)
            if trouble == "full":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "disk")
            signal.raise_signal(signal.SIGINT)

    while acted:
        number += 1
        acted.clear()
        with at_step(number, releases.root, act):
            status = board.run("install", NEW)
        assert status == (1 if is_bad else 0) if not acted else status in (0, 1, 2, 130)
        assert releases.linked(CURRENT) == (OLD if status == 1 else service.running)
        assert releases.damage(releases.linked(CURRENT)) == []
        assert service.running == (NEW if status == 0 else OLD) or (not is_bad and status != 1)
        if service.running != OLD:
            assert [board.run("install", version) for version in (EARLIER, OLD)] == [0, 0]
    assert number > 10
    assert NEW not in service.heard


@pytest.mark.parametrize("is_cut_off", [False, True])
def test_a_first_release_that_is_bad_leaves_nothing(board, monkeypatch, is_cut_off):
    assert board.run("uninstall") == 0
    assert list(board.releases.root.iterdir()) == [board.releases.root / "unit"]
    if is_cut_off:
        cut_off(board, monkeypatch)
    board.service.bad = NEW
    assert board.run("install", NEW) == 1
    assert board.service.running is None
    assert board.releases.linked(CURRENT) is None
    assert list((board.releases.root / "releases").iterdir()) == []


def cut_off(board, monkeypatch):
    """Kill an upgrade as it starts the new release."""
    with monkeypatch.context() as patch:
        patch.setattr(board.service, "start", lambda limits: kill(""))
        in_a_child(lambda: board.run("install", NEW))
    assert board.releases.linked(CURRENT) == NEW


def test_what_was_good_is_known_however_often_it_is_cut_off(board, monkeypatch):
    cut_off(board, monkeypatch)
    releases, number = board.releases, 0
    while releases.linked(PREVIOUS) != OLD:
        number += 1
        with at_step(number, releases.root, kill):
            in_a_child(lambda: board.run("install", NEW))
        assert OLD in (releases.good(), releases.linked(PREVIOUS))
    assert number > 10


@pytest.mark.parametrize(("words", "status"), [(["rollback"], 0), (["install", NEW], 1)])
def test_an_upgrade_that_was_cut_off_is_undone(board, monkeypatch, words, status):
    cut_off(board, monkeypatch)
    board.service.bad = NEW
    assert board.run(*words) == status
    assert board.releases.linked(CURRENT) == board.service.running == OLD
    assert board.releases.linked(PREVIOUS) == EARLIER


@pytest.mark.parametrize("error", [UnhealthyError("it ended"), KeyboardInterrupt()])
@pytest.mark.parametrize(("words", "version"), [(["rollback"], EARLIER), (["install", OLD], OLD)])
def test_what_served_before_stays_when_it_fails(board, words, version, error):
    board.service.bad, board.service.error = version, error
    assert board.run(*words) == 1
    assert board.releases.linked(CURRENT) == OLD
    assert board.releases.linked(PREVIOUS) == EARLIER


@pytest.mark.parametrize("trouble", ["it does not stop", "signals", "nobody reads"])
def test_nothing_keeps_it_from_going_back(board, monkeypatch, trouble):
    service = board.service
    service.bad, stop = NEW, service.stop
    if trouble == "it does not stop":
        failing = mock.Mock(side_effect=[None, UnhealthyError(trouble)])
        monkeypatch.setattr(service, "stop", failing)
    elif trouble == "signals":
        service.error = KeyboardInterrupt()

        def stop_and_signal() -> None:
            stop()
            if service.releases.linked(CURRENT) == NEW:
                for number in (signal.SIGINT, signal.SIGHUP):
                    os.kill(os.getpid(), number)

        monkeypatch.setattr(service, "stop", stop_and_signal)
    else:  # as when an ssh link breaks in the middle
        read, write = os.pipe()
        os.close(read)
        monkeypatch.setattr(sys, "stdout", os.fdopen(write, "w"))
    assert board.run("install", NEW) == 1
    assert board.releases.linked(CURRENT) == service.running == OLD


def test_only_one_installer_is_at_work_and_only_the_group_can_hold(board):
    assert (board.releases.root / ".lock").stat().st_mode & 0o777 == 0o600
    assert board.releases.hold.stat().st_mode & 0o777 == 0o640
    with board.releases.locked():
        for words in (["install", NEW], ["rollback"], ["uninstall"]):
            status = in_a_child(functools.partial(board.run, *words))
            assert os.waitstatus_to_exitcode(status) == 2
    assert board.service.told == 0


def test_all_is_on_the_disk_before_a_release_has_its_name(board, monkeypatch):
    order = []
    folder = board.releases.folder(NEW)
    monkeypatch.setattr(os, "sync", lambda: order.append(("synced", folder.exists())))
    monkeypatch.setattr(
        installer.Releases, "prepare", lambda *_: order.append(("prepared", folder.exists()))
    )
    board.run("install", NEW)
    assert order[:2] == [("synced", False), ("prepared", True)]


def test_a_damaged_release_is_made_again_beside_the_service(board):
    (board.releases.folder(OLD) / "manifest.json").write_text("")
    assert board.releases.damage(OLD) == ["manifest.json"]
    assert board.run("rollback") == 0
    assert board.run("rollback") == 2
    assert board.releases.linked(CURRENT) == EARLIER
    assert board.run("install", OLD) == 0
    assert board.releases.damage(OLD) == []
