"""A safe stop where the action only steers: the steering is held, the simulator brakes."""

from __future__ import annotations

import contextlib

import pytest

from bridge.environments import EpisodeRunner, make_environment, scenario_of, task_of
from bridge.tests.harness import (
    TOY,
    BridgeProcess,
    make_command,
    refused,
    start_edge,
    start_simulate,
    wait_until_driving,
)
from bridge.virtual_link import NO_COMMAND, Decision
from edge_runtime.policy import load_policy
from edge_runtime.tests.policies import PEDAL, STEERING, write_policy
from edge_runtime.transport import free_endpoint


class ScriptedClock:
    """Drives for a while with one steering, brakes, and drives again."""

    latencies_ms: tuple = ()
    drive, brake_until = 10, 32

    def begin(self, episode, seed):
        self.states = []

    def exchange(self, state):
        self.states.append(state)
        braking = self.drive <= state.step < self.brake_until
        reason = NO_COMMAND if braking else ""
        steering = 0.04 if state.step < self.drive else -0.02
        command = make_command(state.step, action=[steering])
        return Decision(command, fresh=True, brake_reason=reason, undriven_s=0.0)

    def newest_answer(self):
        return None

    def finish(self, state):
        self.states.append(state)


@pytest.fixture
def environment():
    environment = make_environment("congestion")
    yield environment
    environment.close()


def run(environment, clock, **options):
    runner = EpisodeRunner(environment, clock, "here", lambda *_: None, lambda *_: None, **options)
    return runner, runner.run(0, seed=3)


def test_the_steering_is_held_and_the_car_stands_and_drives_on(environment):
    clock = ScriptedClock()
    runner, result = run(environment, clock)
    held = [action[0] for action in result.actions[clock.drive : clock.brake_until]]
    assert held == pytest.approx([0.04] * len(held))
    speeds = [state.speed_mps for state in clock.states]
    assert speeds[clock.drive] > 3.5
    # At 4 m/s2 from at most 6 m/s.
    assert speeds[clock.drive + 16] == 0.0
    (event,) = runner.safe_stops.events
    assert event.reason == NO_COMMAND
    assert event.stopped_after_s is not None
    assert event.stopped_after_s <= 1.6
    assert event.resumed_after_s == pytest.approx(2.2)
    assert result.actions[clock.brake_until] == pytest.approx([-0.02])
    assert clock.states[clock.brake_until + 10].speed_mps > 1.0


def test_a_new_episode_starts_with_the_brake_released(environment):
    clock = ScriptedClock()
    clock.brake_until = 10_000
    run(environment, clock)
    clock.drive = 10_000
    run(environment, clock)
    assert clock.states[10].speed_mps > 3.5


@pytest.mark.parametrize(("options", "speed_mps"), [({}, 5.0), ({"standing": True}, 0.0)])
def test_an_episode_starts_from_a_stand_where_that_is_asked_for(environment, options, speed_mps):
    clock = ScriptedClock()
    run(environment, clock, **options)
    assert clock.states[0].speed_mps == pytest.approx(speed_mps, abs=1.0)


HALF_PEDAL = type(PEDAL)(name="pedal", meaning="m", unit="u", low=-1.0, high=0.5)


def policy_of(folder, scenario, *actions):
    path = folder / f"{scenario}-{len(actions)}.onnx"
    write_policy(path, actions=actions, manifest_changes={"scenario": scenario})
    return path


@pytest.mark.parametrize(
    ("clock", "relayed"), [("lockstep", False), ("realtime", False), ("realtime", True)]
)
def test_the_policy_of_another_scenario_is_refused_by_both_ends(tmp_path, clock, relayed):
    policy, out = policy_of(tmp_path, "left_turn", PEDAL), tmp_path / "never.json"
    endpoint = near = free_endpoint()
    with contextlib.ExitStack() as opened:
        if relayed:
            near = free_endpoint()
            link = ("--listen", near, "--connect", endpoint, "--latency", "50ms")
            relay = opened.enter_context(BridgeProcess("relay", *link))
            assert relay.process.stdout is not None
            assert relay.process.stdout.readline().startswith("ready")
        edge = opened.enter_context(start_edge(near, policy))
        with start_simulate(endpoint, out, "congestion", "--clock", clock) as run:
            refused(run, out, "left_turn, pedal -1 to 1", "congestion, steering -1 to 1")
        assert edge.end() == 0
    assert "was=standby now=safe_stop reason=other_task" in edge.log
    assert "now=drive" not in edge.log


def test_a_scenario_is_found_by_word_and_by_id():
    for word, name in (("left_turn", "phil/LeftTurn-v0"), ("congestion", "phil/Congestion-v0")):
        assert scenario_of(word) == scenario_of(name) == word
        make_environment(name).close()


@pytest.mark.parametrize(
    ("env", "scenario", "actions", "same"),
    [
        ("left_turn", "left_turn", (PEDAL,), True),
        ("phil/Congestion-v0", "congestion", (STEERING,), True),
        ("left_turn", "congestion", (PEDAL,), False),
        ("left_turn", "left_turn", (STEERING,), False),
        ("left_turn", "left_turn", (HALF_PEDAL,), False),
        ("left_turn", "left_turn", (PEDAL, STEERING), False),
        (TOY, "left_turn", (PEDAL,), True),
        (TOY, "anything", (STEERING,), True),
        (TOY, "left_turn", (HALF_PEDAL,), False),
        (TOY, "left_turn", (PEDAL, STEERING), False),
    ],
)
def test_what_is_known_of_both_is_compared(tmp_path, env, scenario, actions, same):
    policy = policy_of(tmp_path, scenario, *actions)
    manifest = load_policy(policy, allow_unsigned=True).manifest
    environment = make_environment(env)
    assert (task_of(environment, env, manifest) == manifest.task) is same
    known = env != TOY  # The toy tells neither scenario nor names, so its states say nothing.
    assert bool(task_of(environment, env)) is known
    environment.close()


def test_a_foreign_environment_refuses_another_number_of_actions(tmp_path):
    policy = policy_of(tmp_path, "left_turn", PEDAL, STEERING)
    endpoint, out = free_endpoint(), tmp_path / "never.json"
    with start_edge(endpoint, policy), start_simulate(endpoint, out, TOY) as run:
        refused(run, out, "('left_turn, pedal -1 to 1')", "steering")


def test_another_runtime_in_the_middle_of_a_drive_ends_it(tmp_path):
    own, other = (
        policy_of(tmp_path, "left_turn", PEDAL), policy_of(tmp_path, "congestion", STEERING),
    )  # fmt: skip
    endpoint, out = free_endpoint(), tmp_path / "never.json"
    options = ("--clock", "realtime", "--episodes", "20")
    with start_simulate(endpoint, out, "left_turn", *options) as run:
        with start_edge(endpoint, own) as edge:
            wait_until_driving(edge)
            edge.process.kill()
        with start_edge(endpoint, other):
            refused(run, out, "another task", "left_turn, pedal -1 to 1")
