"""``python -m bridge simulate`` against real edge runtimes, each in a process of its own."""

from __future__ import annotations

import contextlib
import signal
import time

import numpy as np
import pytest

from bridge.tests.harness import (
    SHORT_TOY,
    SLOW_TOY,
    TOY,
    BridgeProcess,
    drive_in_process,
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
from edge_runtime.transport import free_endpoint, open_session

CONTRACT_KEYS = {
    *("scenario", "condition", "episodes", "policy_id", "seed", "success_rate", "collision_rate"),
    *("surviving_distance_m", "episode_reward", "episode_time_s"),
    *("lateral_acceleration_mps2", "longitudinal_acceleration_mps2"),
    *("latency_ms", "deadline_misses", "safe_stops", "rejected"),
}


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
    assert set(report) >= CONTRACT_KEYS
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

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.travelled_m = 0.0
        return self.picture(), {"speed_mps": 1.0, "distance_m": 0.0}

    def step(self, action):
        self.travelled_m += 0.1
        ended = self.travelled_m > 1.95
        info = {"speed_mps": 1.0, "distance_m": self.travelled_m}
        return self.picture(), float(action[0]), ended, False, info

    def picture(self):
        return np.full((2, 45, 80), 7, np.uint8)

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
    (about / "entry_points.txt").write_text(
        "[gymnasium.envs]\nsomebody = somebodys_envs:register\n"
    )
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
