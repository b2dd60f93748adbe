"""The installer as a process on a folder, with the real edge runtime."""

import contextlib
import itertools
import os
import random
import signal
import subprocess
import threading
import time

import pytest

from deploy.__main__ import main
from deploy.bundle import make_bundle
from deploy.certs import write_key_pair
from deploy.installer import systemd
from deploy.installer.__main__ import share_key
from deploy.installer.layout import CURRENT, PREVIOUS, Releases
from deploy.tests.boards import HERE, Board, changed_wheel
from edge_runtime.util import UserError
from hil_tests.processes import wait_until
from hil_tests.testing.drives import Simulator
from hil_tests.testing.messages import make_state

RUN = "edge_runtime/run.py"
MOCK = "edge_runtime/vehicles/mock.py"
RUNS = "self._loop.run()"
WITH_VEHICLE = f"self._parts.vehicle and threading.Timer(0.3, os._exit, (5,)).start(); {RUNS}"
FAULTS = {
    "it answers for a while, then ends": (RUN, RUNS, WITH_VEHICLE),
    "it cannot open the vehicle": (MOCK, "self._commanded_s = -math.inf", "1 / 0"),
    "it never says that it is ready": (RUN, "ready vehicle_id", "almost vehicle_id"),
    "it ends as soon as it is ready": (RUN, RUNS, "os._exit(3)"),
}


def refused(done, word: str = "") -> None:
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert word in line


@pytest.mark.parametrize(
    "faults",
    [dict(list(FAULTS.items())[:1]), pytest.param(FAULTS, marks=pytest.mark.board)],
    ids=["one fault", "all faults"],
)
def test_install_faulty_upgrades_good_upgrade_back_and_away(board, tmp_path, faults):
    """A simulator is driven all the while, and hears no command of a faulty release."""
    shop, ending, heard = board.workshop, threading.Event(), []
    good, better = shop.make(0.1), shop.make(0.2)
    board.runs_a_process()
    config = tmp_path / "mock.toml"
    config.write_text(f'connect = "{shop.endpoint}"\nvehicle = "mock"\n')
    with Simulator(shop.endpoint) as simulator, contextlib.ExitStack() as ends:

        def send() -> None:
            for step in itertools.takewhile(lambda _: not ending.wait(0.05), itertools.count()):
                simulator.send(make_state(step))

        def hears() -> bool:
            heard.extend(simulator.drain())
            return bool(heard)

        def drives(made) -> None:
            simulator.drain()  # Of what ran before.
            wait_until(hears, "commands")
            assert {command.policy_id for command in heard} == {made.manifest.policy_id}
            heard.clear()

        thread = threading.Thread(target=send)
        thread.start()
        ends.callback(thread.join)
        ends.callback(ending.set)
        done = board.install(good.path)
        assert (done.returncode, done.stderr) == (0, "")
        drives(good)
        for number, change in enumerate(faults.values()):
            wheel = changed_wheel(shop.edge_wheel, tmp_path / str(number), *change)
            bad = shop.make(0.5 + number / 10, wheels=[wheel, shop.host], config=config)
            done = board.install(bad.path, "--health-limit", "3", "--settle", "0.8")
            assert (done.returncode, len(done.stderr.splitlines())) == (1, 1), done.stderr
            shown = board.status()
            assert (shown["current"], shown["previous"]) == (good.manifest.version, "none")
            assert [p.name for p in (board.root / "releases").iterdir()] == [shown["current"]]
            hears()
            assert bad.manifest.policy_id not in {command.policy_id for command in heard}
            drives(good)
        # The mock's feedback names the command it took last: never one, for it never ran.
        assert {f.step for f in simulator.feedback} <= {-1}
        assert board.install(better.path).returncode == 0
        drives(better)
        shown = board.status()
        assert [shown[name] for name in ("current", "previous", "whole", "service")] == [
            better.manifest.version, good.manifest.version, "yes", "active",
        ]  # fmt: skip
        assert board.run("rollback", "--settle", "0.2").returncode == 0
        drives(good)
    (board.root / "diary.txt").write_text("not ours")
    assert board.run("uninstall").returncode == 0
    assert [path.name for path in board.root.iterdir()] == ["diary.txt"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("install {bundle}", "--trust"),
        ("install {bundle} --trust missing.pub", "missing.pub"),
        ("install {bundle} --trust {key}", "public key"),
        ("install missing.tar --trust {public}", "missing.tar"),
        *((command, "nothing is installed") for command in ("status", "rollback", "uninstall")),
        ("rollback --health-limit nan", "--health-limit"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_written(board: Board, workshop, words, named):
    names = {"bundle": workshop.make().path, "key": workshop.key, "public": workshop.public_key}
    refused(board.run(*words.format(**names).split()), named)
    assert not board.root.exists()


def test_a_bundle_of_another_key_is_refused_now_and_later(board: Board, workshop, tmp_path):
    private, public = write_key_pair(tmp_path / "other")
    foreign = workshop.make(0.2, key=private)
    refused(board.install(foreign.path))
    assert not board.root.exists()
    assert board.install(workshop.make(0.1).path).returncode == 0
    before = board.fingerprint()
    refused(board.run("install", foreign.path))
    refused(board.run("install", foreign.path, "--trust", public), "trusts another key")
    assert board.fingerprint() == before
    refused(board.run("rollback"), "no earlier release")


@pytest.mark.parametrize("change", [{"python": "3.7"}, {"machine": "riscv64"}, {"glibc": "9.99"}])
def test_a_bundle_for_another_computer_is_refused(board: Board, workshop, tmp_path, change):
    made = make_bundle(workshop.inputs(), HERE._replace(**change), tmp_path)
    refused(board.install(made.path), *change.values())
    assert not board.root.exists()


def test_a_policy_that_may_not_drive_there_changes_nothing_and_damage_is_said(
    board: Board, workshop, tmp_path
):
    good = workshop.make(0.1)
    assert board.install(good.path).returncode == 0
    change = ("edge_runtime/policy.py", "range(13, 22)", "range(18, 22)")
    wheel = changed_wheel(workshop.edge_wheel, tmp_path / "w", *change)
    done = board.install(workshop.make(0.2, wheels=[wheel, workshop.host]).path)
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert "opset" in done.stderr
    assert board.status()["current"] == good.manifest.version
    assert len(list((board.root / "releases").iterdir())) == 1
    (board.root / "current/site-packages/edge_runtime/safety.py").write_text("# nothing left\n")
    shown = board.run("status")
    assert shown.returncode == 1
    assert "edge_runtime/safety.py" in shown.stdout


def test_the_secret_is_the_owners_alone_or_the_services_too(board: Board, workshop, tmp_path):
    assert main(["certs", "--out", str(tmp_path / "certs")]) == 0
    config = tmp_path / "c.toml"
    config.write_text('connect = "tls/127.0.0.1:9"\n')
    made = workshop.make(tls=tmp_path / "certs" / "edge-hunter01", config=config)
    before = os.umask(0o077)  # the caller's must not lock the service's user out
    try:
        assert board.install(made.path).returncode == 0
    finally:
        os.umask(before)
    folder = board.root / "current"
    modes = {"tls/key.pem": 0o600, "bin/phil-edge": 0o755, "site-packages/edge_runtime": 0o755}
    assert {name: (folder / name).stat().st_mode & 0o777 for name in modes} == modes
    share_key(folder, os.getgid())
    assert (folder / "tls/key.pem").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize(
    ("service", "is_booted", "has_unit", "is_installed", "expected"),
    [
        (None, True, False, False, systemd.Systemd),
        (None, True, True, True, systemd.Systemd),
        (None, True, False, True, None),  # installed with --service none
        (None, False, False, False, None),
        ("none", True, False, False, None),
        ("none", True, True, True, UserError),  # nobody would stop the unit
        ("systemd", True, False, True, systemd.Systemd),
        ("systemd", False, False, False, UserError),
    ],
)
def test_who_runs_it_stays_as_it_was_installed(
    tmp_path, monkeypatch, service, is_booted, has_unit, is_installed, expected
):
    monkeypatch.setattr(systemd, "BOOTED", tmp_path / ("." if is_booted else "absent"))
    monkeypatch.setattr(systemd, "UNIT_FOLDER", tmp_path)
    for there, name in ((has_unit, systemd.MAIN_UNIT), (is_installed, "current")):
        if there:
            (tmp_path / name).touch()
    with pytest.raises(UserError) if expected is UserError else contextlib.nullcontext():
        assert isinstance(systemd.choose(service, tmp_path), expected or type(None))


@pytest.mark.board
@pytest.mark.timeout(1800)
def test_killed_at_40_random_moments_the_board_has_a_whole_release_and_completes(board):
    """With all that it has started, as a power cut would."""
    shop, choice = board.workshop, random.Random(7)
    # Of three in turn the next one is neither current nor previous, so it is unpacked anew.
    made = itertools.cycle([shop.make(value) for value in (0.1, 0.2, 0.3)])
    old, releases, cut_off = next(made), Releases(str(board.root)), 0
    begin_s = time.monotonic()
    assert board.install(old.path).returncode == 0
    limit_s = time.monotonic() - begin_s
    for _ in range(40):
        new = next(made)
        with subprocess.Popen(
            board.command("install", new.path), stdout=subprocess.DEVNULL, start_new_session=True
        ) as run:
            time.sleep(choice.uniform(0.0, limit_s))
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)
        cut_off += run.returncode != 0
        current = releases.linked(CURRENT) or ""
        assert current in (old.manifest.version, new.manifest.version)
        assert releases.damage(current) == []
        assert board.install(new.path).returncode == 0
        assert releases.linked(CURRENT) == new.manifest.version
        assert releases.linked(PREVIOUS) == old.manifest.version
        assert len(list((board.root / "releases").iterdir())) == 2
        old = new
    assert cut_off > 20
