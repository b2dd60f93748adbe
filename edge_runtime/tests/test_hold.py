"""A release that is being tried is silent: on the wire, and towards its vehicle."""

from __future__ import annotations

import fcntl
import time

import pytest

from edge_runtime.errors import UserError
from edge_runtime.hold import Hold
from edge_runtime.operator_commands import ask
from edge_runtime.tests.harness import EdgeProcess, Simulator, make_state, wait_until
from edge_runtime.transport import free_endpoint


def test_without_a_lock_nothing_is_held(tmp_path):
    file = tmp_path / "hold"
    assert not Hold(None).is_on()
    assert not Hold(str(file)).is_on()
    file.touch()
    assert not Hold(str(file)).is_on()


def test_one_that_cannot_be_read_is_not_taken_for_free(tmp_path):
    with pytest.raises(UserError, match="cannot be read: Is a directory"):
        Hold(str(tmp_path))


def test_it_is_free_when_the_lock_is_and_stays_so(tmp_path):
    with open(tmp_path / "hold", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        hold = Hold(str(tmp_path / "hold"))
        assert hold.is_on()
        assert hold.refusal()
    assert not hold.is_on()
    with open(tmp_path / "hold", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert not hold.is_on()
        assert hold.refusal() == ""


def test_a_runtime_on_hold_hears_and_says_nothing(make_policy, tmp_path):
    endpoint, settings = free_endpoint(), tmp_path / "edge.toml"
    settings.write_text(f"hold = '{tmp_path / 'hold'}'\n")
    flags = [*make_policy().flags, "--connect", endpoint, "--config", str(settings)]
    lock = open(tmp_path / "hold", "w")  # noqa: SIM115 - closing it is what the test is about
    fcntl.flock(lock, fcntl.LOCK_EX)
    with Simulator(endpoint) as simulator, EdgeProcess(*flags, "--vehicle", "mock") as edge:
        simulator.wait_for_edge()
        steps = iter(range(1000))

        def fed(end_s: float) -> None:
            while time.monotonic() < end_s:
                simulator.send(make_state(next(steps)))
                time.sleep(0.05)

        fed(time.monotonic() + 0.5)
        assert wait_until(lambda: simulator.health[-1].accepted, "accepted states")
        assert simulator.commands.empty()
        # The vehicle has taken no command: its feedback names the last one.
        assert {feedback.step for feedback in simulator.feedback} == {-1}
        answer = ask(endpoint, "hunter01", "rearm")
        assert not answer["accepted"]
        assert "installer" in answer["detail"]
        lock.close()
        fed(time.monotonic() + 0.3)
        assert simulator.next_command().session == "simulator-a"
        assert wait_until(lambda: simulator.feedback[-1].step >= 0, "a command at the vehicle")
        assert edge.end() == 0
