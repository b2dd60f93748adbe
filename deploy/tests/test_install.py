"""The installer as a process on a folder, with the real edge runtime."""

import contextlib
import itertools
import json
import os
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest

import edge_runtime
from deploy.bundle import TARGETS
from deploy.certs import write_key_pair
from deploy.installer import systemd
from deploy.installer.release import CURRENT, PREVIOUS, Releases
from deploy.tests.boards import HERE, Board
from edge_runtime.util import UserError
from hil_tests.tests.shared.drives import Simulator
from hil_tests.tests.shared.messages import make_state

RUN = "edge_runtime/run.py"
MOCK = "edge_runtime/vehicles/mock.py"
RUNS = "self._loop.run()"
WITH_VEHICLE = f"self._parts.vehicle and threading.Timer(0.3, os._exit, (5,)).start(); {RUNS}"
FAULTS = {
    "it answers for a while, then ends": (RUN, RUNS, WITH_VEHICLE),
    "it cannot open the vehicle": (MOCK, "self._latched = True  # until it is enabled", "1 / 0"),
    "it never says that it is ready": (RUN, "ready vehicle_id", "almost vehicle_id"),
    "it ends as soon as it is ready": (RUN, RUNS, "os._exit(3)"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_boards_suite_is_still_to_be_made(fault):
    member, old, _ = FAULTS[fault]
    assert old in (Path(edge_runtime.__file__).parents[1] / member).read_text()


def fails(done, status: int, word: str = "") -> None:
    assert done.returncode == status, done.stderr
    (line,) = done.stderr.splitlines()
    assert word in line


@pytest.mark.parametrize(
    "faults",
    [dict(list(FAULTS.items())[:1]), pytest.param(FAULTS, marks=pytest.mark.board)],
    ids=["one fault", "all faults"],
)
def test_install_faulty_upgrades_good_upgrade_back_and_away(board, tmp_path, faults):
    """A simulator is driven all the while, and no faulty release moves a vehicle."""
    shop, mock = board.workshop, tmp_path / "mock.toml"
    mock.write_text(f'connect = "{shop.endpoint}"\nvehicle = "mock"\n')
    (first, good), (second, better) = shop.make(0.1), shop.make(0.2)
    board.runs_a_process()
    with Simulator(shop.endpoint) as simulator:

        def install(bundle, expected: int) -> set[str]:
            """Install it; return the policies that drove meanwhile."""
            words = board.command("install", bundle, "--trust", shop.public_key)
            with subprocess.Popen(words) as process:
                while process.poll() is None:
                    simulator.send(make_state(next(simulator.steps)))
                    time.sleep(0.05)
            assert process.returncode == expected
            return {each.policy_id for each in simulator.drain() if each.mode == "drive"}

        def drives() -> str:
            return simulator.ask(make_state(next(simulator.steps))).policy_id

        install(first, 0)
        assert drives() == good.policy_id
        for number, change in enumerate(faults.values()):
            bad, _ = shop.make_faulty(0.5 + number / 10, *change, config=mock)
            assert install(bad, 1) <= {good.policy_id}
            shown = board.status()
            assert (shown["current"], shown["previous"]) == (good.version, None)
            assert [p.name for p in (board.root / "releases").iterdir()] == [good.version]
            assert drives() == good.policy_id
        assert {each.mode for each in simulator.feedback} <= {"standby", "safe_stop"}
        install(second, 0)
        assert drives() == better.policy_id
        shown = board.status()
        assert [shown[name] for name in ("current", "previous", "is_whole", "service")] == [
            better.version, good.version, True, "active",
        ]  # fmt: skip
        assert board.run("rollback").returncode == 0
        assert drives() == good.policy_id
    (board.root / "diary.txt").write_text("not ours")
    assert board.run("uninstall").returncode == 0
    assert [path.name for path in board.root.iterdir()] == ["diary.txt"]


def test_a_mistake_is_one_line_and_nothing_is_written(board: Board, workshop):
    bundle, _ = workshop.make()
    for trust in ([], ["--trust", "missing.pub"], ["--trust", workshop.key]):
        fails(board.run("install", bundle, *trust), 2)
    for command in ("status", "rollback", "uninstall"):
        fails(board.run(command), 2)
    assert not board.root.exists()


def test_a_bundle_of_another_key_is_refused_now_and_later(board: Board, workshop, tmp_path):
    private, public = write_key_pair(tmp_path / "other")
    foreign, _ = workshop.make(0.2, key=private)
    fails(board.install(foreign), 2)
    assert not board.root.exists()
    assert board.install(workshop.make(0.1)[0]).returncode == 0
    before = board.status()
    fails(board.run("install", foreign), 2)
    fails(board.run("install", foreign, "--trust", public), 2, "trusts another key")
    fails(board.run("rollback"), 2)
    assert board.status() == before


def test_a_bundle_for_another_computer_is_refused(board: Board, workshop, monkeypatch):
    for number, other in enumerate(("3.7", "riscv64", "9.99")):
        target = [other if place == number else word for place, word in enumerate(HERE)]
        monkeypatch.setitem(TARGETS, "other", tuple(target))
        fails(board.install(workshop.make(target="other")[0]), 2, other)
    assert not board.root.exists()


def test_a_policy_that_may_not_drive_there_changes_nothing_and_damage_is_said(board, workshop):
    good, manifest = workshop.make(0.1)
    assert board.install(good).returncode == 0
    change = ("edge_runtime/policy.py", "range(13, 22)", "range(18, 22)")
    fails(board.install(workshop.make_faulty(0.3, *change)[0]), 1, "opset")
    assert board.status()["current"] == manifest.version
    assert len(list((board.root / "releases").iterdir())) == 1
    (board.root / "current/manifest.json").write_text("# nothing left\n")
    shown = board.run("status")
    assert shown.returncode == 1
    assert json.loads(shown.stdout)["is_whole"] is False


@pytest.mark.parametrize(
    ("option", "is_installed", "is_systemd"),
    [(None, False, True), (None, True, False), ("none", False, False)],
)
def test_who_runs_it_stays_as_it_was_installed(
    tmp_path, monkeypatch, option, is_installed, is_systemd
):
    monkeypatch.setattr(systemd, "BOOTED", tmp_path)
    monkeypatch.setattr(systemd, "UNIT_FOLDER", tmp_path)
    if is_installed:
        (tmp_path / "current").touch()
    assert isinstance(systemd.choose(option, tmp_path), systemd.Systemd) is is_systemd
    (tmp_path / systemd.MAIN_UNIT).touch()
    assert isinstance(systemd.choose(None, tmp_path), systemd.Systemd)
    with pytest.raises(UserError):  # nobody would stop the unit
        systemd.choose("none", tmp_path)


@pytest.mark.board
@pytest.mark.timeout(1800)
def test_killed_at_40_random_moments_the_board_has_a_whole_release_and_completes(board):
    """With all that it has started, as a power cut would."""
    shop, choice = board.workshop, random.Random(7)
    # Of three in turn the next one is neither current nor previous, so it is unpacked anew.
    made = itertools.cycle([shop.make(value) for value in (0.1, 0.2, 0.3)])
    (path, old), releases, cut_off = next(made), Releases(str(board.root)), 0
    begin_s = time.monotonic()
    assert board.install(path).returncode == 0
    limit_s = time.monotonic() - begin_s
    for _ in range(40):
        path, new = next(made)
        with subprocess.Popen(
            board.command("install", path), stdout=subprocess.DEVNULL, start_new_session=True
        ) as run:
            time.sleep(choice.uniform(0.0, limit_s))
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)
        cut_off += run.returncode != 0
        current = releases.linked(CURRENT) or ""
        assert current in (old.version, new.version)
        assert releases.is_whole(current)
        assert board.install(path).returncode == 0
        assert releases.linked(CURRENT) == new.version
        assert releases.linked(PREVIOUS) == old.version
        assert len(list((board.root / "releases").iterdir())) == 2
        old = new
    assert cut_off > 20
