"""`run --vehicle ros2` as a process: a simulator's states in, ROS 2 out and back."""

from __future__ import annotations

import time

import pytest

from edge_runtime.config import load_config
from edge_runtime.errors import UserError
from edge_runtime.tests.harness import (
    PATIENCE_S,
    EdgeProcess,
    Simulator,
    make_state,
    run_command,
    wait_until,
)
from edge_runtime.tests.policies import write_policy
from edge_runtime.transport import free_endpoint
from edge_runtime.vehicles.ros2.tests.ros_hunter import RosHunter
from edge_runtime.wire import CONTROL_PERIOD_S


@pytest.fixture
def policy(tmp_path):
    path = tmp_path / "full.onnx"
    write_policy(path, "constant", 1.0)
    return path


def drive_until(simulator, step, condition, what):
    """Send states at 10 Hz, each answered, until the condition holds; return the next step."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, what
        simulator.ask(make_state(step))
        step += 1
        time.sleep(CONTROL_PERIOD_S)
    return step


class Drives:
    """Whether the Hunter is as quick; an operator beside it re-arms where that is asked."""

    def __init__(self, simulator, hunter, over_mps):
        self._simulator, self._hunter, self._over_mps = simulator, hunter, over_mps

    def __call__(self):
        if self._simulator.health[-1].needs_rearm:
            self._simulator.query("rearm")
        return self._hunter.speed_mps > self._over_mps


def test_it_drives_stops_with_the_link_and_drives_again_only_after_a_rearm(policy, tmp_path):
    endpoint, ros_endpoint = free_endpoint(), free_endpoint()
    settings = tmp_path / "edge.toml"
    settings.write_text(
        f'[ros2]\nlisten = "{ros_endpoint}"\ntwist_topic = "/cmd_vel"\nnamespace = "/any"\n'
        'odometry_topic = "/odom"\n'
    )
    flags = ("--policy", str(policy), "--allow-unsigned", "--vehicle", "ros2")
    arguments = (*flags, "--connect", endpoint, "--config", str(settings))
    with Simulator(endpoint) as simulator, EdgeProcess(*arguments) as edge, RosHunter(
        connect=ros_endpoint
    ) as hunter:
        simulator.wait_for_edge()
        wait_until(lambda: len(hunter.twists) > 10, "zeros")
        assert hunter.asked_mps == 0.0
        # Nobody may have been there for the first enabling.
        step = drive_until(simulator, 0, Drives(simulator, hunter, 0.5), "the Hunter to drive")
        wait_until(lambda: simulator.feedback[-1].speed_mps > 0.3, "its feedback")
        feedback = simulator.feedback[-1]
        assert feedback.vehicle == "ros2"
        assert feedback.scenario_speed_mps == pytest.approx(4 * feedback.speed_mps)
        # No more states: the runtime's safe stop.
        wait_until(lambda: hunter.speed_mps < 0.02, "the stop")
        # They come back, and it stands nevertheless.
        end_s = time.monotonic() + 1.0
        step = drive_until(simulator, step, lambda: time.monotonic() > end_s, "a second")
        assert hunter.asked_mps == 0.0
        step = drive_until(simulator, step, Drives(simulator, hunter, 0.3), "it to drive again")
        hunter.silent = True
        step = drive_until(simulator, step, lambda: hunter.asked_mps == 0.0, "the stop")
        drive_until(
            simulator,
            step,
            lambda: "no fresh odometry on /odom" in simulator.feedback[-1].faults,
            "the fault in words",
        )
        assert not simulator.query("rearm")["accepted"]
        assert edge.end() == 0


@pytest.mark.parametrize(
    ("table", "part"),
    [
        ('[ros2]\nconnect = "tls/127.0.0.1:7448"', "plain text"),
        ('[ros2]\ntwist_angular = "degrees"', "ros2.twist_angular 'degrees'"),
        (
            "[ros2]\ntopic = 1",
            "ros2: Object contains unknown field `topic`; known are model, listen,",
        ),
    ],
)
def test_wrong_settings_are_one_line(table, part, tmp_path):
    settings = tmp_path / "edge.toml"
    settings.write_text(table)
    with pytest.raises(UserError) as caught:
        load_config(settings, {"policy": "any.onnx", "vehicle": "ros2"})
    assert part in str(caught.value)


def test_a_busy_port_is_one_line(policy, tmp_path):
    busy = free_endpoint()
    settings = tmp_path / "edge.toml"
    settings.write_text(f'[ros2]\nlisten = "{busy}"')
    with RosHunter(listen=busy):
        flags = ("--policy", str(policy), "--allow-unsigned", "--vehicle", "ros2")
        result = run_command("run", *flags, "--config", str(settings))
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert "in use" in line
