"""``python -m bridge simulate`` against real edge runtimes, and its episodes by themselves."""

import contextlib
import signal
import time

import numpy as np
import pytest

from bridge.environments import EpisodeRunner, make_environment, task_of
from bridge.tests.harness import (
    SHORT_TOY,
    SLOW_TOY,
    TOY,
    BridgeProcess,
    drive_in_process,
    make_command,
    make_policy,
    read,
    refused,
    simulate,
    simulate_undisturbed,
    start_edge,
    start_simulate,
    wait_until_driving,
    wait_until_driving_steadily,
)
from bridge.virtual_link import NO_COMMAND, Decision
from edge_runtime.policy import load_policy
from edge_runtime.tests.policies import PEDAL, STEERING, write_policy
from edge_runtime.transport import free_endpoint, open_session

CONTRACT_KEYS = """
scenario condition episodes policy_id seed success_rate collision_rate surviving_distance_m
episode_reward episode_time_s lateral_acceleration_mps2 longitudinal_acceleration_mps2
latency_ms deadline_misses safe_stops rejected
"""


def drove_as_in_process(report, policy):
    for row in report["per_episode"]:
        outcome, actions = drive_in_process(policy, row["seed"])
        assert row["outcome"] == outcome
        np.testing.assert_allclose(row["actions"], actions, atol=1e-5)


def test_lock_step_over_the_wire_is_the_same_drive_as_in_process(tmp_path):
    policy, endpoint = make_policy(tmp_path), free_endpoint()
    with start_edge(endpoint, policy):
        options = ["--episodes", "3", "--seed", "40"]
        report = simulate_undisturbed(tmp_path, endpoint, TOY, options)
        again = simulate_undisturbed(tmp_path, endpoint, TOY, options)
    assert set(report) >= set(CONTRACT_KEYS.split())
    assert report["rejected"] == {}
    assert report["safe_stops"] == report["deadline_misses"] == report["missed_ticks"] == 0
    assert report["command_age_ms"]["max"] == 0.0  # Virtual time, and no delay in it.
    drove_as_in_process(report, policy)
    assert [row["seed"] for row in report["per_episode"]] == [40, 41, 42]
    assert again["per_episode"] == report["per_episode"]


def test_real_time_with_latency(tmp_path):
    policy, endpoint = make_policy(tmp_path, "constant"), free_endpoint()
    options = ["--clock", "realtime", "--latency", "40ms+-2ms"]
    with start_edge(endpoint, policy):
        started_s = time.monotonic()
        report = simulate(tmp_path, endpoint, TOY, options)
        took_s = time.monotonic() - started_s
    assert report["per_episode"][0]["outcome"] == "goal"
    assert took_s > report["episode_time_s"]["mean"] - 0.2
    assert report["latency_spec"] == "delay=40ms,jitter=2ms"
    assert 70 < report["latency_ms"]["p50"] < 200
    # On the wire for 80 ms, so it acts in the next tick at the earliest, held from tick to tick.
    assert 80 < report["command_age_ms"]["p50"] < 250


def test_no_state_reaches_the_edge_so_the_simulator_brakes(tmp_path):
    policy, endpoint = make_policy(tmp_path, "constant"), free_endpoint()
    options = ["--clock", "realtime", "--latency", "up.loss=100%"]
    with start_edge(endpoint, policy):
        report = simulate(tmp_path, endpoint, SHORT_TOY, options)
    (event,) = report["safe_stop_events"]
    assert (event["reason"], event["resumed_after_s"]) == ("no_command", None)
    assert event["step"] <= 3
    assert event["stopped_after_s"] < 2.0
    assert set(report["latency_ms"].values()) == {None}
    assert report["per_episode"][0]["outcome"] == "timeout"


@pytest.mark.parametrize("clock", ["lockstep", "realtime"])
def test_a_killed_edge_is_braked_for_and_a_new_one_drives_on(tmp_path, clock):
    policy, endpoint = make_policy(tmp_path, "constant", 0.1), free_endpoint()
    out, log = tmp_path / "killed.json", tmp_path / "edge.log"
    with start_simulate(endpoint, out, SLOW_TOY, "--clock", clock) as run:
        with log.open("w") as errors, start_edge(endpoint, policy, stderr=errors) as edge:
            # One that had stopped by itself would not be missed.
            wait_until_driving_steadily(log)
            edge.process.send_signal(signal.SIGKILL)
            edge.process.wait()
        # The brake is due within 3 T; a new edge runtime may be there before.
        time.sleep(0.5)
        # Another board with another policy takes over in the same episode.
        with start_edge(endpoint, make_policy(tmp_path, "constant", 0.2)):
            assert run.wait() == 0, run.errors
    report = read(out)
    assert len(report["policy_ids"]) == 2
    assert report["edge_changes"] == 1
    # On a busy machine the edge runtime may have stopped for a reason of its own, too.
    event = next(row for row in report["safe_stop_events"] if row["reason"] == "no_command")
    # 2 T and one tick; the rest is for a busy machine.
    assert 0.15 <= event["brake_after_s"] <= 0.5
    assert event["resumed_after_s"] > 0
    braked, resumed = event["step"], event["step"] + round(event["resumed_after_s"] * 10)
    (row,) = report["per_episode"]
    assert row["actions"][braked:resumed] == [[-1.0]] * (resumed - braked)
    assert row["actions"][resumed] == pytest.approx([0.2])


def test_a_number_that_is_not_finite_is_one_line_and_status_2(tmp_path):
    policy, endpoint, out = make_policy(tmp_path), free_endpoint(), tmp_path / "never.json"
    env = "bridge.tests.toy:BridgeToyNan-v0"
    with start_edge(endpoint, policy), start_simulate(endpoint, out, env) as run:
        refused(run, out, "reward is nan")


def test_an_interrupted_run_writes_no_report(tmp_path):
    endpoint, out = free_endpoint(), tmp_path / "half.json"
    policy = make_policy(tmp_path, "constant")
    with start_edge(endpoint, policy) as edge, start_simulate(endpoint, out, SLOW_TOY) as run:
        wait_until_driving(edge)
        run.process.send_signal(signal.SIGTERM)
        assert run.wait(10) == 130
        time.sleep(0.5)
        # The final state came: at rest, not stopped because a link seems to be lost.
        assert edge.end() == 0
    assert "now=standby" in edge.log
    assert "now=safe_stop" not in edge.log.split("now=standby")[-1]
    assert list(tmp_path.glob("*half*")) == []


def test_two_vehicles_on_one_router_each_drive_as_if_alone(tmp_path):
    policies = make_policy(tmp_path, "mean", 0.0), make_policy(tmp_path, "constant", 0.25)
    endpoint, outs = free_endpoint(), [tmp_path / "car-0.json", tmp_path / "car-1.json"]
    with contextlib.closing(open_session(listen=endpoint, mode="router")):
        for _ in range(3):  # A busy machine may pause a process for over 2 T.
            with contextlib.ExitStack() as opened:
                runs = []
                for policy, out in zip(policies, outs, strict=True):
                    where = ("--connect", endpoint, "--vehicle-id", out.stem)
                    drive = ("simulate", "--env", TOY, "--episodes", "2", "--out", str(out))
                    runs.append(opened.enter_context(BridgeProcess(*drive, *where)))
                    opened.enter_context(start_edge(endpoint, policy, *where[2:]))
                assert [run.wait() for run in runs] == [0, 0]
            reports = list(map(read, outs))
            if not any(report["safe_stops"] or report["rejected"] for report in reports):
                break
    assert len({report["policy_id"] for report in reports}) == 2
    for report, policy in zip(reports, policies, strict=True):
        assert report["rejected"] == {}
        drove_as_in_process(report, policy)


MODULE = """
import gymnasium
import numpy as np

class Creep(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (2, 45, 80), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    picture = np.full((2, 45, 80), 7, np.uint8)

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self.picture, {"speed_mps": 1.0, "distance_m": 0.0}

    def step(self, action):
        self.steps += 1
        info = {"speed_mps": 1.0, "distance_m": 0.1 * self.steps}
        return self.picture, float(action[0]), self.steps == 20, False, info

def register():
    gymnasium.register("Creep-v0", entry_point="somebodys_envs:Creep")
"""


@pytest.fixture
def site(tmp_path):
    """A folder as pip leaves it: the module, and the entry point in the package's metadata."""
    (tmp_path / "somebodys_envs.py").write_text(MODULE)
    about = tmp_path / "somebodys_envs-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: somebodys-envs\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[gymnasium.envs]\nsomebody=somebodys_envs:register\n")
    return tmp_path


def test_an_installed_environment_is_served_by_its_id(site, tmp_path):
    endpoint, out = free_endpoint(), tmp_path / "r.json"
    arguments = ["simulate", "--env", "somebody/Creep-v0", "--listen", endpoint, "--out", str(out)]
    with (
        BridgeProcess(*arguments, environment={"PYTHONPATH": str(site)}) as run,
        start_edge(endpoint, make_policy(tmp_path, "constant")),
    ):
        assert run.wait() == 0, run.errors
    report = read(out)
    assert report["scenario"] == "somebody/Creep-v0"
    (row,) = report["per_episode"]
    assert (row["steps"], row["outcome"]) == (20, "ended")
    assert row["reward"] == pytest.approx(20 * 0.3, rel=1e-6)


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
            assert relay.process.stdout.readline().startswith("ready")
        edge = opened.enter_context(start_edge(near, policy))
        with start_simulate(endpoint, out, "congestion", "--clock", clock) as run:
            refused(run, out, "left_turn, pedal -1 to 1", "congestion, steering -1 to 1")
        assert edge.end() == 0
    assert "was=standby now=safe_stop reason=other_task" in edge.log
    assert "now=drive" not in edge.log


@pytest.mark.parametrize(
    ("env", "scenario", "actions", "same"),
    [
        ("left_turn", "left_turn", (PEDAL,), True),
        ("phil/LeftTurn-v0", "left_turn", (PEDAL,), True),
        ("congestion", "congestion", (STEERING,), True),
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
