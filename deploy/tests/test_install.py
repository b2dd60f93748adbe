"""The installer as a process on a folder, with the real edge runtime and real Zenoh sessions."""

import contextlib
import fcntl
import io
import itertools
import os
import platform
import queue
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest

from deploy.bundle import make_bundle
from deploy.certs import write_key_pair
from deploy.installer import __main__ as installer
from deploy.installer import layout as layout_module
from deploy.installer import systemd
from deploy.installer.layout import Layout, why_not_whole
from deploy.installer.verify import UnhealthyError, UserError, read_bundle
from deploy.tests.boards import HERE, Board, changed_wheel
from hil_tests.processes import wait_until
from hil_tests.testing.edge import Simulator
from hil_tests.testing.messages import make_state

RUN = "edge_runtime/run.py"
MOCK = "edge_runtime/vehicles/mock.py"
WITH_VEHICLE = """\
            if config.vehicle != "none":
                threading.Timer(0.3, os._exit, (5,)).start()
            loop.run()"""
RUNS = "            loop.run()"
FAULTS = {
    "it answers for a while, then ends": (RUN, RUNS, WITH_VEHICLE),
    "it cannot open the vehicle": (MOCK, "self._commanded_s = -math.inf", "1 / 0"),
    "it never says that it is ready": (RUN, "ready vehicle_id", "almost vehicle_id"),
    "it ends as soon as it is ready": (RUN, RUNS, RUNS.replace("loop.run()", "os._exit(3)")),
}


def lines(text: str) -> list[str]:
    return text.strip().splitlines()


def refused(done, *words: str) -> None:
    said = lines(done.stderr)
    assert (done.returncode, len(said)) == (2, 1), done.stderr
    assert all(word in said[0] for word in words), said


def test_install_upgrade_back_and_away(board: Board):
    one, two = board.workshop.make(0.1), board.workshop.make(0.2)
    board.runs_a_process()
    with Simulator(board.workshop.endpoint) as simulator:

        def drives(episode: int) -> float:
            simulator.alive.clear()
            for step in range(200):
                with contextlib.suppress(queue.Empty):
                    state = make_state(step, session=f"s-{episode}", episode=episode, final=True)
                    command = simulator.ask(state, timeout_s=0.1)
                    assert command.mode == "drive"
                    return round(command.action[0], 3)
            raise AssertionError("nobody answers")

        done = board.install(one.path, "process")
        assert (done.returncode, done.stderr) == (0, "")
        assert drives(1) == 0.1
        assert board.install(two.path, "process").returncode == 0
        assert drives(2) == 0.2
        shown = board.status()
        assert (shown["current"], shown["previous"]) == (two.manifest.version, one.manifest.version)
        assert shown["service"] == "active"
        broken = board.root / "releases" / one.manifest.version
        broken /= "site-packages/edge_runtime/safety.py"
        whole = broken.read_bytes()
        broken.write_bytes(b"")
        refused(board.run("rollback"), one.manifest.version, "is damaged")
        broken.write_bytes(whole)
        assert board.run("rollback", "--settle", "0.2").returncode == 0
        assert drives(3) == 0.1
    assert board.status()["current"] == one.manifest.version
    assert board.run("uninstall").returncode == 0
    assert not board.root.exists()


@contextlib.contextmanager
def heard_by(endpoint: str):
    """A simulator that sends states all the time and counts whose commands come back."""
    by_policy: Counter[str] = Counter()
    ending = threading.Event()

    def drive() -> None:
        for step in itertools.count():
            if ending.wait(0.05):
                return
            simulator.send(make_state(step))
            while not simulator.commands.empty():
                by_policy[simulator.commands.get().policy_id] += 1

    with Simulator(endpoint) as simulator:
        thread = threading.Thread(target=drive)
        thread.start()
        try:
            yield by_policy, simulator
        finally:
            ending.set()
            thread.join()


@pytest.mark.parametrize(
    "faults",
    [dict(list(FAULTS.items())[:1]), pytest.param(FAULTS, marks=pytest.mark.board)],
    ids=["one fault", "all faults"],
)
def test_a_failing_release_goes_back_and_nobody_hears_a_command_of_it(board, tmp_path, faults):
    """Beside a good release that drives a simulator all the while; each fault in its own way."""
    shop = board.workshop
    good = shop.make(0.1)
    board.runs_a_process()
    config = tmp_path / "mock.toml"
    config.write_text(f'connect = "{shop.endpoint}"\nvehicle = "mock"\n')
    with heard_by(shop.endpoint) as (by_policy, simulator):
        assert board.install(good.path, "process").returncode == 0
        wait_until(lambda: by_policy[good.manifest.policy_id], "the good one drives")
        bad_ids, heard = set(), set()
        for number, (fault, change) in enumerate(faults.items()):
            wheel = changed_wheel(shop.edge_wheel, tmp_path / str(number), *change)
            bad = shop.make(0.5 + number / 10, wheels=[wheel, shop.host], config=config)
            done = board.install(bad.path, "process", "--health-limit", "3", "--settle", "0.8")
            assert (done.returncode, len(lines(done.stderr))) == (1, 1), (fault, done.stderr)
            assert good.manifest.version in done.stderr
            shown = board.status()
            assert (shown["current"], shown["previous"]) == (good.manifest.version, "none")
            assert [p.name for p in (board.root / "releases").iterdir()] == [shown["current"]]
            heard |= set(by_policy)
            bad_ids.add(bad.manifest.policy_id)
            by_policy.clear()
            wait_until(lambda: by_policy, "commands again")
        assert len(bad_ids) == len(faults)
        assert heard | set(by_policy) == {good.manifest.policy_id}
        # The mock's feedback names the command it took last: never one, for it never ran.
        assert {f.step for f in simulator.feedback} <= {-1}


@pytest.mark.board
def test_ended_in_mid_switch_it_goes_back_and_a_link_that_breaks_does_not_end_it(board):
    old, new = board.workshop.make(0.1), board.workshop.make(0.2)
    board.runs_a_process()
    assert board.install(old.path, "process").returncode == 0
    line = board.command("install", new.path, "--service", "process", "--settle", "2")
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        wait_until(lambda: board.status()["current"] == new.manifest.version, "the switch", 60.0)
        run.send_signal(signal.SIGHUP)
        assert run.poll() is None
        run.send_signal(signal.SIGTERM)
        _, said = run.communicate(timeout=60)
    assert (run.returncode, len(lines(said))) == (1, 1), said
    assert f"went back to {old.manifest.version}: interrupted" in said
    shown = board.status()
    assert (shown["current"], shown["service"]) == (old.manifest.version, "active")


def test_an_empty_board_must_be_told_whom_to_trust_and_has_nothing_to_undo(board: Board, workshop):
    bundle = workshop.make().path
    for words, says in (
        (("install", bundle), "trusts no key yet"),
        (("install", bundle, "--trust", "missing.pub"), "missing.pub"),
        (("install", bundle, "--trust", workshop.key), "not a PEM public"),
        (("status",), "nothing is installed"),
        (("uninstall",), "nothing is installed"),
    ):
        refused(board.run(*words), says)
    if not systemd.is_there():
        refused(board.install(bundle, "systemd"), "no systemd runs this computer")
    refused(subprocess.run(board.command("")[:3], capture_output=True, text=True, timeout=60))
    refused(board.run("rollback"), "nothing is installed")
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
    board.runs_a_process()
    good = workshop.make(0.1)
    assert board.install(good.path).returncode == 0
    change = ("edge_runtime/policy.py", "range(13, 22)", "range(18, 22)")
    wheel = changed_wheel(workshop.edge_wheel, tmp_path / "w", *change)
    done = board.install(workshop.make(0.2, wheels=[wheel, workshop.host]).path, "process")
    assert done.returncode == 1
    assert "edge_runtime check" in done.stderr
    assert "opset" in done.stderr
    assert board.status()["current"] == good.manifest.version
    assert Layout(str(board.root)).versions() == [good.manifest.version]
    assert (board.root / "state/way").read_text() == "none"  # for the next one, too


def test_the_services_group_reads_a_key_that_was_unpacked_for_its_owner_alone(tmp_path):
    key = tmp_path / "tls" / "key.pem"
    key.parent.mkdir()
    key.touch(0o600)
    for group, mode in ((None, 0o600), (os.getgid(), 0o640)):
        layout_module.let_read_key(tmp_path, group)
        assert key.stat().st_mode & 0o777 == mode


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


def test_one_installer_at_a_time_to_its_end_and_uninstall_takes_only_ours(board, workshop):
    made = workshop.make(0.1)
    line = board.command("install", made.path, "--trust", workshop.public_key)
    # An ssh link that broke: nobody reads what it says.
    with subprocess.Popen([*line, "--service", "none"], stdout=subprocess.PIPE) as run:
        assert run.stdout is not None
        run.stdout.close()
    assert run.returncode == 0
    assert board.status()["current"] == made.manifest.version
    refused(board.run("rollback"), "no earlier release")
    before = board.fingerprint()
    with open(board.root / ".lock", "r+") as other:
        fcntl.lockf(other, fcntl.LOCK_EX)
        refused(board.install(made.path), "another installer is at work")
        refused(board.run("rollback"), "another installer is at work")
    assert [row[0] for row in board.fingerprint()] == [row[0] for row in before]
    (board.root / "diary.txt").write_text("not ours")
    (board.root / ".trusted.pub.new").touch()  # Of a first install that was cut off.
    done = board.run("uninstall")
    assert (done.returncode, "stays" in done.stdout) == (0, True)
    assert [p.name for p in board.root.iterdir()] == ["diary.txt"]
    shutil.rmtree(board.root)


def test_all_is_on_the_disk_before_a_release_has_its_name(workshop, tmp_path, monkeypatch):
    """The order that a SIGKILL cannot show: written, synced, and only then renamed."""
    order: list[tuple[str, bool]] = []
    layout = Layout(str(tmp_path / "root"))
    bundle = read_bundle(str(workshop.make(0.1).path), workshop.public_key.read_bytes())
    folder = layout.release(bundle.manifest.version)

    def synced() -> None:
        made = layout.making(bundle.manifest.version)
        order.append(("synced", (made / "contents.json").exists() and not folder.exists()))

    with layout.locked():
        monkeypatch.setattr(os, "sync", synced)
        monkeypatch.setattr(
            layout_module, "sync_folder", lambda path: order.append(("named", folder.exists()))
        )
        assert layout_module.make_release(bundle, layout, None) == folder
    assert order == [("synced", True), ("named", True)]
    assert layout_module.why_not_whole(folder) == ""


MISTAKES = {
    **dict.fromkeys(("install", "fly", "status --service cron", "install missing.tar"), ""),
    **{
        f"rollback {option} {value}": f"argument {option}: {value!r} is not a number of seconds"
        for option in ("--health-limit", "--settle")
        for value in ("soon", "0", "-1", "nan", "inf")
    },
}
"""Above all a number of seconds that would wait for ever."""


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_one_line(board: Board, words):
    refused(board.run(*words.split()), MISTAKES[words])
    assert not board.root.exists()


def test_the_secret_is_the_owners_alone(board: Board, workshop, tmp_path):
    from deploy.__main__ import main

    assert main(["certs", "--out", str(tmp_path / "certs")]) == 0
    config = tmp_path / "c.toml"
    config.write_text('connect = "tls/127.0.0.1:9"\n')
    made = workshop.make(tls=tmp_path / "certs" / "edge-hunter01", config=config)
    board.runs_a_process()
    before = os.umask(0o077)  # the caller's must not lock the service's user out
    try:
        assert board.install(made.path, "process").returncode == 0
    finally:
        os.umask(before)
    folder = board.root / "current"
    modes = {
        str(path.relative_to(folder)): path.stat().st_mode & 0o777
        for path in [folder / "tls/key.pem", folder / "config.toml", folder / "bin/phil-edge"]
    }
    assert modes == {"tls/key.pem": 0o600, "config.toml": 0o644, "bin/phil-edge": 0o755}
    assert (folder / "site-packages/edge_runtime").stat().st_mode & 0o777 == 0o755


def test_nobody_else_can_keep_the_service_silent(tmp_path, monkeypatch):
    """The hold is a lock: it is for the service's group to read, and asked for with a limit."""
    monkeypatch.setattr(layout_module, "_HOLD_LIMIT_S", 0.05)
    layout = Layout(str(tmp_path))
    with layout.locked():
        assert (tmp_path / ".lock").stat().st_mode & 0o777 == 0o600
        with layout.holding():
            assert layout.hold.stat().st_mode & 0o777 == 0o600
        with layout.holding(os.getgid()):
            assert layout.hold.stat().st_mode & 0o777 == 0o640
        with open(layout.hold) as other:
            fcntl.flock(other, fcntl.LOCK_SH)
            with pytest.raises(UserError, match="another process holds"), layout.holding():
                raise AssertionError("it has the lock")


def test_what_may_not_be_read_or_named_in_a_unit_is_said(board, workshop, monkeypatch, capsys):
    assert board.install(workshop.make(0.1).path).returncode == 0

    def may_not(folder: Path) -> str:
        raise PermissionError(13, "Permission denied", str(folder / "tls" / "key.pem"))

    monkeypatch.setattr(installer, "why_not_whole", may_not)
    assert installer.main(["status", "--root", str(board.root)]) == 0
    assert "not known: this user may not read" in capsys.readouterr().out
    monkeypatch.setattr(systemd, "is_there", lambda: True)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    for root in ("/opt/two words", "/opt/100%"):
        with pytest.raises(UserError, match="may hold only letters"):
            systemd.choose("systemd", Path(root))
    (board.root / "state/way").write_text("systemd")
    with pytest.raises(UserError, match="systemd runs this board"):  # Its unit would be nobody's.
        systemd.choose("none", board.root)
    (board.root / "state/way").unlink()


OLD, NEW = "0.1.0-old", "0.1.0-new"


class Service(systemd.NoService):
    """Runs whatever `current` names; its watch of the new release ends with an error."""

    name = "fake"

    def __init__(self, layout: Layout, error: BaseException) -> None:
        self.layout = layout
        self.error = error
        self.runs = ""
        self.heard: list[str] = []  # What ran at a moment when commands could leave

    def start(self, release) -> None:
        self.runs = release.name

    def watch(self, limits) -> None:
        if self.runs == NEW:
            raise self.error

    def stop(self) -> None:
        if self.runs and not self._is_held():
            self.heard.append(self.runs)
        self.runs = ""

    def _is_held(self) -> bool:
        with open(self.layout.hold) as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False


@pytest.fixture
def layout(tmp_path, monkeypatch):
    """A board on which the old release is current, and the new one lies beside it, proven."""
    layout = Layout(str(tmp_path))
    for version in (OLD, NEW):
        layout.release(version).mkdir(parents=True)
    layout.state.mkdir()
    layout.link("current", OLD)
    monkeypatch.setattr(installer.Installer, "_prove", lambda self, version: None)
    return layout


@pytest.mark.parametrize(
    "error",
    [
        UnhealthyError("it ended"),
        UserError("systemctl cannot be run: No such file or directory"),
        OSError(28, "No space left on device", "/etc/systemd/system/phil-edge.service"),
        KeyboardInterrupt(),
    ],
    ids=lambda error: type(error).__name__,
)
@pytest.mark.parametrize("reader", ["there", "gone"])
def test_whatever_cuts_the_watch_off_the_old_release_runs_again(layout, monkeypatch, error, reader):
    """Also where nobody reads any more what the installer says: an ssh link that broke."""
    service = Service(layout, error)
    if reader == "gone":
        closed = io.StringIO()
        broken = mock.Mock(side_effect=BrokenPipeError(32, "Broken pipe"))
        monkeypatch.setattr(closed, "write", broken, raising=False)
        monkeypatch.setattr(sys, "stdout", closed)
    with pytest.raises(UnhealthyError, match=f"went back to {OLD}"):
        installer.Installer(layout, service).activate(NEW)
    assert (layout.linked("current"), service.runs) == (OLD, OLD)
    assert layout.versions() == [OLD]
    assert service.heard == []


def test_a_damaged_current_release_is_made_again_beside_the_service(layout, monkeypatch):
    bundle: Any = SimpleNamespace(manifest=SimpleNamespace(version=OLD), files={"a": b"1"})
    service = Service(layout, KeyboardInterrupt())
    service.start(layout.release(OLD))
    board = installer.Installer(layout, service)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=0))
        with pytest.raises(UserError, match="not enough room"):
            board._unpack(bundle)
    assert why_not_whole(layout.release(OLD)) != ""
    board._unpack(bundle)
    assert (why_not_whole(layout.release(OLD)), service.runs) == ("", OLD)
    assert not list(layout.releases.glob(".*"))


def test_an_interrupted_roll_back_or_stop_leaves_the_old_release_running(layout, monkeypatch):
    layout.link("previous", NEW)
    service = Service(layout, KeyboardInterrupt())
    with pytest.raises(UnhealthyError, match=f"went back to {OLD}"):
        installer.Installer(layout, service).activate(NEW)
    assert (layout.linked("current"), layout.linked("previous"), service.runs) == (OLD, NEW, OLD)
    stops = [KeyboardInterrupt]

    def stop() -> None:
        service.runs = ""
        if stops:
            raise stops.pop()

    monkeypatch.setattr(service, "stop", stop)
    with pytest.raises(UnhealthyError, match=f"went back to {OLD}: interrupted"):
        installer.Installer(layout, service).activate(NEW)
    assert (layout.linked("current"), service.runs) == (OLD, OLD)


def test_a_second_signal_while_it_goes_back_changes_nothing(layout, monkeypatch):
    service = Service(layout, KeyboardInterrupt())

    def start(release: Path) -> None:
        service.runs = release.name
        if release.name == OLD:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(service, "start", start)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(UnhealthyError, match=f"went back to {OLD}: interrupted"):
        installer.Installer(layout, service).activate(NEW)
    assert (layout.linked("current"), service.runs) == (OLD, OLD)
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.parametrize("error", [UnhealthyError("it ended"), KeyboardInterrupt()])
def test_the_running_release_installed_again_stays_whatever_happens(layout, monkeypatch, error):
    layout.link("previous", OLD)
    layout.link("current", NEW)
    layout.served.write_text(NEW)
    service, errors = Service(layout, error), [error]

    def watch(limits: object) -> None:
        if errors:
            raise errors.pop()

    monkeypatch.setattr(service, "watch", watch)
    with pytest.raises(UnhealthyError, match=f"went back to {NEW}"):
        installer.Installer(layout, service).activate(NEW)
    assert (layout.linked("current"), layout.linked("previous"), service.runs) == (NEW, OLD, NEW)
    assert sorted(layout.versions()) == [NEW, OLD]
    installer.Installer(layout, service).activate(OLD)
    assert layout.served.read_text() == OLD


KILLER = """\
import os, runpy, signal, sys
_, where, number, *sys.argv = sys.argv
left = int(number)
STEPS = ("os.rename", "os.symlink", "os.remove", "os.rmdir", "os.mkdir")

def watch(event, arguments):
    global left
    if event in STEPS and str(arguments[event in STEPS[:2]]).endswith(where):
        left -= 1
        if left == 0:
            os.killpg(0, signal.SIGKILL)

sys.addaudithook(watch)
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Kills itself and its children before the step of that number among those whose path ends so."""


def killed(board: Board, bundle, where: str, number: int) -> bool:
    words = (bundle, "--trust", board.workshop.public_key, "--service", "none")
    python, _, *line = board.command("install", *words)
    line = [python, "-c", KILLER, where, str(number), *line]
    done = subprocess.run(line, start_new_session=True, capture_output=True, text=True, timeout=60)
    assert done.returncode in (0, -signal.SIGKILL), done.stderr
    return done.returncode != 0


def whole(board: Board) -> str | None:
    """The current version, when every release that bears a name is whole."""
    layout = Layout(str(board.root))
    for version in layout.versions():
        assert why_not_whole(layout.release(version)) == "", version
    return layout.linked("current")


def complete(board: Board, made) -> None:
    assert board.install(made.path).returncode == 0
    assert whole(board) == made.manifest.version
    assert not [p for p in (board.root / "releases").iterdir() if p.name.startswith(".")]


def test_killed_before_each_step_of_the_switch(board, workshop):
    old, new = workshop.make(0.1), workshop.make(0.2)
    complete(board, old)
    for where in (f"releases/{new.manifest.version}", ".previous", "/previous", "/current"):
        assert killed(board, new.path, where, 1), where
        assert whole(board) == old.manifest.version
    complete(board, new)


@pytest.mark.board
@pytest.mark.timeout(1800)
def test_killed_before_every_step(board, workshop):
    # Of three in turn the next one is neither current nor previous, so it is unpacked anew.
    made = [workshop.make(value) for value in (0.1, 0.2, 0.3)]
    complete(board, made[0])
    for number in range(1, 1000):
        old, new = made[(number - 1) % 3], made[number % 3]
        was_killed = killed(board, new.path, "", number)
        assert whole(board) in (old.manifest.version, new.manifest.version)
        complete(board, new)
        print(number, flush=True)
        if not was_killed:
            break
    assert number > 20
