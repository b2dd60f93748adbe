"""The installer as a process on a folder, with the real edge runtime and real Zenoh sessions."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
from collections import Counter

import pytest

from deploy.tests.boards import Board, changed_wheel
from edge_runtime.tests.harness import Simulator, make_state, wait_until

NOTIFY, RUN = "edge_runtime/service.py", "edge_runtime/run.py"
MOCK = "edge_runtime/vehicles/mock.py"
WITH_VEHICLE = """\
            if config.vehicle != "none":
                import threading

                threading.Timer(0.3, os._exit, (5,)).start()
            loop.run()"""
IN_TRIAL = {
    "it is ready and then silent": (NOTIFY, 'self._send("WATCHDOG=1")', "pass"),
    "it never says that it is ready": (NOTIFY, "READY=1\\n", ""),
    "it ends as soon as it is ready": (RUN, "            loop.run()", "            os._exit(3)"),
    "it has loaded another policy": (RUN, "policy_id={policy.policy_id}", "policy_id=0"),
}
AS_SERVICE = {
    "it answers for a while, then ends": (RUN, "            loop.run()", WITH_VEHICLE),
    "it cannot open the vehicle": (MOCK, "self._state = MockState()", "1 / 0"),
}
"""Faults that show only with the vehicle, which the trial does without."""


def lines(text: str) -> list[str]:
    return text.strip().splitlines()


def test_install_upgrade_back_and_away(board: Board):
    """A whole life on one board: each release answers the simulator with its own policy."""
    one, two = board.workshop.make(0.1), board.workshop.make(0.2)
    with Simulator(board.workshop.endpoint) as simulator:

        def drives(step: int) -> float:
            simulator.alive.clear()
            command = ask_until_answered(simulator, step)
            assert command.mode == "drive"
            return round(command.action[0], 3)

        done = board.install(one.path, "process")
        assert (done.returncode, done.stderr) == (0, "")
        assert drives(1) == 0.1
        assert board.install(two.path, "process").returncode == 0
        assert drives(2) == 0.2
        shown = board.status()
        assert (shown["current"], shown["previous"]) == (two.manifest.version, one.manifest.version)
        assert shown["service"] == "active restarts=0"
        # It ends, as by a fault of its own: the supervisor starts it again.
        state = board.root / "state" / "service.json"
        os.kill(json.loads(state.read_bytes())["pid"], signal.SIGKILL)
        wait_until(lambda: board.status()["service"] == "active restarts=1", "a new start")
        assert drives(3) == 0.2
        assert board.run("rollback", "--settle", "0.2").returncode == 0
        assert drives(4) == 0.1
    assert board.status()["current"] == one.manifest.version
    assert board.run("uninstall").returncode == 0
    assert not board.root.exists()


def ask_until_answered(simulator: Simulator, episode: int):
    """The running release's answer: states go out until one comes."""
    for step in range(200):
        state = make_state(step, session=f"simulator-{episode}", episode=episode, final=True)
        try:
            return simulator.ask(state, timeout_s=0.1)
        except queue.Empty:
            continue
    raise AssertionError("nobody answers")


class Listener:
    """A simulator that sends states all the time and counts whose commands come back."""

    def __init__(self, endpoint: str) -> None:
        self.simulator = Simulator(endpoint)
        self.by_policy: Counter[str] = Counter()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._drive)

    def _drive(self) -> None:
        step = 0
        while not self._ending.wait(0.05):
            self.simulator.send(make_state(step))
            step += 1
            while not self.simulator.commands.empty():
                self.by_policy[self.simulator.commands.get().policy_id] += 1

    def __enter__(self) -> Listener:
        self.simulator.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        self.simulator.__exit__()


@pytest.mark.parametrize(
    "faults",
    [
        dict(list(AS_SERVICE.items())[:1]),
        pytest.param(IN_TRIAL | AS_SERVICE, marks=pytest.mark.board),
    ],
    ids=["one fault", "all faults"],
)
def test_a_failing_release_goes_back_and_nobody_hears_a_command_of_it(
    board: Board, tmp_path, faults
):
    """Beside a good release that drives a simulator all the while; each fault in its own way."""
    shop = board.workshop
    good = shop.make(0.1)
    config = tmp_path / "mock.toml"
    config.write_text(f'connect = "{shop.endpoint}"\nvehicle = "mock"\n')
    with Listener(shop.endpoint) as listener:
        assert board.install(good.path, "process").returncode == 0
        wait_until(lambda: listener.by_policy[good.manifest.policy_id], "the good one drives")
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
            heard |= set(listener.by_policy)
            bad_ids.add(bad.manifest.policy_id)
            listener.by_policy.clear()
            wait_until(lambda: listener.by_policy, "commands again")
        assert len(bad_ids) == len(faults)
        assert heard | set(listener.by_policy) == {good.manifest.policy_id}
        # The mock's feedback names the command it took last: never one, for it never ran.
        assert {f.step for f in listener.simulator.feedback} <= {-1}


@pytest.mark.board
def test_ended_in_the_middle_of_a_switch_it_goes_back_and_a_link_that_breaks_does_not_end_it(
    board: Board,
):
    old, new = board.workshop.make(0.1), board.workshop.make(0.2)
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
    assert (shown["current"], shown["service"]) == (old.manifest.version, "active restarts=0")
