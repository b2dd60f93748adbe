"""The runtime as a service, and its loop: real threads between a fake policy and a fake link."""

import contextlib
import math
import os
import signal
import socket
import sys
import threading
import time
from typing import Any

import numpy as np
import pytest
from hil_tests.processes import wait_until
from hil_tests.tests.shared.drives import run_edge
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import PEDAL, TASK, T

from edge_runtime import log, loop
from edge_runtime.controller import Controller, ControllerConfig, shared_limits
from edge_runtime.loop import ControlLoop
from edge_runtime.manifest import Layout
from edge_runtime.reach import free_endpoint
from edge_runtime.service import Notifier, look
from edge_runtime.tests.rigs import BrokenVehicle
from edge_runtime.vehicles.base import VehicleRunner
from edge_runtime.wire import encode


def test_a_line_holds_nothing_that_a_terminal_acts_upon(capfd):
    log.configure("info")
    log.event("debug", "unseen")
    log.event("info", "rejected", detail="\x1b[2J\x1b]0;owned\x07\x9b31m\u202e")
    log.event("warning", "mode", was="drive", detail="two words")
    log.close()
    hostile, text = capfd.readouterr().err.split("\n")[:-1]
    assert hostile.isprintable()
    assert "1b[2J" in hostile
    assert text.endswith("Z WARNING mode was=drive detail='two words'")


def test_a_stalled_reader_of_the_log_holds_nobody(monkeypatch):
    go_on = threading.Event()
    monkeypatch.setattr(log, "_FLUSH_S", 0.05)
    monkeypatch.setattr(log._Formatter, "format", lambda *_: str(go_on.wait(20.0)))
    log.configure("info")
    for _ in range(log._WAITING_LINES + 50):
        log.event("info", "line")
    assert not log.close()
    go_on.set()


def test_a_silent_sensor_does_not_count(tmp_path):
    for name, text in {"0": "41500\n", "1": "63250\n", "2": ""}.items():
        (tmp_path / f"thermal_zone{name}").mkdir()
        (tmp_path / f"thermal_zone{name}" / "temp").write_text(text)
    assert look(str(tmp_path)).temperature_c == 63.25
    assert look(str(tmp_path / "none")).temperature_c is None


class Systemd:
    """The other end of NOTIFY_SOCKET."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(name.replace("@", "\0"))

    def notifier(self) -> Notifier:
        return Notifier({"NOTIFY_SOCKET": self.name, "WATCHDOG_USEC": "100000"})

    def next(self, wait_s: float = 10.0) -> str:
        self.socket.settimeout(wait_s)
        return self.socket.recv(4096).decode()

    def until(self, start: str) -> str:
        """The first message from now on that begins so."""
        return next(text for text in iter(self.next, "") if text.startswith(start))

    def is_told_nothing(self, wait_s: float) -> bool:
        """Whether nothing more comes within this time."""
        with contextlib.suppress(socket.timeout):
            while True:
                self.next(0.001)
        with contextlib.suppress(socket.timeout):
            return not self.next(wait_s)
        return True


@pytest.fixture
def systemd():
    """Listens at an abstract address, which Linux frees by itself."""
    end = Systemd(f"@phil-test-{os.getpid()}")
    yield end
    end.socket.close()


def test_a_service_from_its_start_to_its_end(make_policy, systemd):
    signed = make_policy()
    environment = {"NOTIFY_SOCKET": systemd.name, "WATCHDOG_USEC": "400000"}
    flags = [*signed.flags, "--connect", free_endpoint()]
    with run_edge(*flags, environment=environment) as edge:
        assert edge.output.startswith("ready ")
        assert edge.output.rstrip().endswith(f" verified_by={signed.public_key}")
        assert systemd.until("READY") == "READY=1\nSTATUS=standby"
        assert [systemd.next() for _ in range(3)] == ["WATCHDOG=1"] * 3
        edge.send(signal.SIGSTOP)
        assert systemd.is_told_nothing(0.6)
        edge.send(signal.SIGCONT)
        assert systemd.next() == "WATCHDOG=1"
        assert edge.end() == 0
        assert systemd.until("STOPPING") == "STOPPING=1"
    (line,) = edge.errors.splitlines()
    assert " INFO ended accepted=0 " in line


def test_a_systemd_that_is_gone_or_full_holds_nobody(tmp_path):
    assert Notifier({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}).watchdog_period_s == math.inf
    end = Systemd(str(tmp_path / "notify"))
    notifier = end.notifier()
    for _ in range(2000):  # more than the socket takes
        notifier.tell("WATCHDOG=1")
    end.socket.close()
    notifier.tell("STOPPING=1")
    notifier.tell("STOPPING=1")


class FakePolicy:
    """Answers 0.5 at once, or waits while it is told to hang."""

    policy_id, manifest, layout = "p", TASK, Layout(TASK)

    def __init__(self) -> None:
        self.free = threading.Event()
        self.free.set()

    def act(self, observation: Any) -> np.ndarray:
        self.free.wait(20.0)
        return np.array([0.5], np.float32)


class FakeLink:
    """Keeps the handler of states, and the last message of a topic with how many came before."""

    vehicle_id, rivals = "hunter01", 0

    def __init__(self) -> None:
        self.sent: dict = {"command": (0, None), "health": (0, None)}

    def declare(self, on_state: Any, *_: Any) -> None:
        self.state_comes = on_state

    def refusal(self, now_s: float) -> None:
        return None

    def send(self, topic: str, message: Any) -> None:
        self.sent[topic] = self.sent[topic][0] + 1, message


@pytest.fixture
def running():
    """Starts a loop with its real threads between a fake policy and a fake link."""
    with contextlib.ExitStack() as ends:

        def start(notifier: Any, vehicle: Any = None, **decides: Any) -> Any:
            policy: Any = FakePolicy()
            link: Any = FakeLink()
            controller = Controller(ControllerConfig(shared_limits([PEDAL], {}), T, **decides))
            runner = vehicle and VehicleRunner(vehicle, ["pedal"], lambda feedback: None)
            control = ControlLoop(policy, controller, link, notifier, runner)
            control.start()
            main = threading.Thread(target=control.run)
            main.start()

            def end() -> None:
                policy.free.set()
                assert control.close()
                main.join(5.0)
                assert not main.is_alive()

            ends.callback(end)
            if vehicle:
                runner.start()
                ends.callback(runner.close)
                ends.callback(vehicle.released.set)
            return control, link, policy

        yield start


def test_a_policy_that_hangs_lets_systemd_step_in(running, systemd, monkeypatch):
    monkeypatch.setattr(loop, "_HUNG_S", 0.2)
    _, link, policy = running(systemd.notifier())
    assert systemd.next() == "WATCHDOG=1"
    policy.free.clear()
    link.state_comes(encode(make_state(0)))
    assert systemd.until("STATUS") == "STATUS=safe_stop inference_too_long"
    before, _ = link.sent["command"]
    wait_until(lambda: systemd.is_told_nothing(0.3), "no watchdog message for a while")
    assert link.sent["command"][0] > before  # the safe stops go on
    policy.free.set()
    assert systemd.next() == "WATCHDOG=1"


def test_the_end_of_an_episode_that_newer_states_overtake_is_remembered(running):
    control, link, policy = running(Notifier({}))
    policy.free.clear()
    link.state_comes(encode(make_state(0)))
    wait_until(lambda: control._busy_since_s is not None, "the inference")
    told = []
    for step in range(1, 5):
        link.state_comes(encode(make_state(step, final=step == 2)))
        told.append(control._slot.follows_final)
    assert told == [False, False, True, True]
    policy.free.set()
    wait_until(lambda: control._slot is None, "the newest to be taken")
    link.state_comes(encode(make_state(5)))
    wait_until(lambda: control._controller._newest.state.step == 5, "the next")
    assert not control._controller._newest.follows_final


@pytest.mark.parametrize(("each_episode", "asked"), [(True, "brake"), (False, "stand")])
def test_a_driver_is_latched_between_episodes_where_the_next_needs_a_re_arm(
    running, each_episode, asked
):
    vehicle = BrokenVehicle()
    decides = {"needs_rearm": True, "each_episode": each_episode}
    _, link, _ = running(Notifier({}), vehicle, **decides)
    link.state_comes(encode(make_state(0)))
    wait_until(lambda: "command" in vehicle.asked, "a drive")
    link.state_comes(encode(make_state(1, final=True)))
    wait_until(lambda: {"brake", "stand"} & {*vehicle.asked}, "the end of the episode")
    assert next(each for each in vehicle.asked if each in ("brake", "stand")) == asked


def test_no_late_answer_follows_the_last_safe_stop(running):
    control, link, policy = running(Notifier({}))
    link.state_comes(encode(make_state(0)))
    wait_until(lambda: link.sent["command"][0] == 1, "the first command")
    policy.free.clear()
    link.state_comes(encode(make_state(1)))
    wait_until(lambda: control._busy_since_s is not None, "the inference")
    control._controller.farewell = lambda: policy.free.set()  # It ends between the last two.
    control.close()
    control._worker.join(5.0)
    _, last = link.sent["command"]
    assert (last.step, control._worker.is_alive()) == (0, False)


def test_a_policys_thread_that_died_is_a_fault_and_lets_systemd_step_in(running, systemd):
    control, link, policy = running(systemd.notifier())
    link.state_comes(encode(make_state(0)))
    assert systemd.until("STATUS") == "STATUS=drive"
    policy.act = lambda observation: sys.exit("no exception that inference catches")
    link.state_comes(encode(make_state(1)))
    assert systemd.until("STATUS") == "STATUS=safe_stop policy_thread_dead"
    wait_until(lambda: systemd.is_told_nothing(0.3), "no watchdog message any more")
    before, _ = link.sent["command"]
    for step in range(2, 8):  # a simulator that lives on changes nothing
        link.state_comes(encode(make_state(step)))
        time.sleep(0.1)
    count, command = link.sent["command"]
    assert count > before  # the safe stops go on
    for said in (command, control.health()):
        assert (said.mode, said.reason) == ("safe_stop", "policy_thread_dead")
    assert control.health().deadline_misses == 0
    assert "restart" in control._rearm()


def test_a_driver_that_hangs_lets_systemd_step_in(running, systemd, monkeypatch):
    monkeypatch.setattr(loop, "_HUNG_S", 0.2)
    vehicle = BrokenVehicle()
    running(systemd.notifier(), vehicle)
    assert systemd.next() == "WATCHDOG=1"
    vehicle.hangs = "feedback"
    wait_until(lambda: systemd.is_told_nothing(0.3), "no watchdog message for a while")
    vehicle.go_on()
    assert systemd.until("WATCHDOG") == "WATCHDOG=1"
