"""``python -m bridge simulate`` against real edge runtimes, and its episodes by themselves."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest

from bridge.environments import Adapter, describe, known_stops, make_environment, say_once, scene_of
from bridge.inbound import NO_COMMAND, Decision
from bridge.messages import Origin
from bridge.simulate import EpisodeRunner
from bridge.tests.odd import odd
from bridge.tests.recordings import bridge_status, record_drive, rerun
from edge_runtime.link import ask
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from hil_tests.processes import Process, operator, wait_until
from hil_tests.tests.shared.drives import TOY, make_policy, read, start_edge, start_simulate
from hil_tests.tests.shared.messages import make_command
from hil_tests.tests.shared.policies import STEERING, write_policy, write_rover


def drive_in_process(policy_path: Path, seed: int) -> tuple[str, np.ndarray]:
    policy = load_policy(str(policy_path), allow_unsigned=True)
    environment = gymnasium.make(TOY)
    seen, info = environment.reset(seed=seed)
    actions, ended = [], False
    while not ended:
        actions.append(policy.act({"frames": seen}))
        seen, _, terminated, truncated, info = environment.step(actions[-1])
        ended = terminated or truncated
    return info["outcome"], np.array(actions)


def drove_as_in_process(report, policy):
    for row in report["per_episode"]:
        outcome, actions = drive_in_process(policy, row["seed"])
        assert row["outcome"] == outcome
        np.testing.assert_allclose(row["actions"], actions, atol=1e-5)


def test_an_interrupted_run_reports_the_episodes_that_it_drove(tmp_path):
    endpoint, out = free_endpoint(), tmp_path / "part.json"
    policy, many = make_policy(tmp_path, "constant"), ("--episodes", "9999")
    with start_edge(endpoint, policy) as edge, start_simulate(endpoint, out, TOY, *many) as run:
        # The first standby comes before the simulator has counted its episode.
        wait_until(lambda: edge.errors.count("now=standby") > 1, "two episodes", 60.0)
        run.send(signal.SIGTERM)
        assert run.wait(10) == 130
        time.sleep(0.5)
        # The final state came: at rest, not stopped because a link seems to be lost.
        assert edge.end() == 0
    assert "now=safe_stop" not in edge.errors.split("now=standby")[-1]
    report = read(out)
    assert report["interrupted"]
    assert 1 <= report["episodes"] == len(report["per_episode"]) < 9999
    assert all(row["outcome"] for row in report["per_episode"])


def test_the_environment_stands_while_its_vehicle_waits_for_a_re_arm(tmp_path):
    """The drive is that without a vehicle, and so is its fork; lock-step, for that waits, too."""
    policy, endpoint, out = make_policy(tmp_path), free_endpoint(), tmp_path / "report.json"
    drive = tmp_path / "drive.mcap"
    with start_simulate(endpoint, out, TOY, "--episodes", "2", "--seed", "3") as simulate:
        record = ("record", "--out", drive, "--connect", endpoint, "--vehicle-id", "hunter01")
        with (
            Process("bridge", *record, ready="recording"),
            start_edge(endpoint, policy, "--vehicle", "mock") as edge,
        ):
            simulate.wait_for_line("episode 1: the vehicle waits for a re-arm (episode)")
            time.sleep(1.0)
            assert not simulate.has_ended
            assert ask(endpoint, "hunter01", "status")["reason"] == "episode"
            assert "waits_for_rearm after=episode" in edge.errors
            with operator(endpoint, "hunter01"):
                simulate.succeed()
    report = read(out)
    assert not [row for row in report["safe_stop_events"] if row["reason"] == "episode"]
    if not report["safe_stops"]:  # a busy machine may stop it once more
        drove_as_in_process(report, policy)
        found = tmp_path / "fork.json"
        words = ("fork", drive, "--out", found, "--episode", "1", "--at", "0.5", "--env", TOY)
        trust = ("--policy", policy, "--allow-unsigned")
        assert bridge_status([str(word) for word in (*words, *trust)]) == 0
        assert read(found)["fork"]["outcome"] == report["per_episode"][1]["outcome"]


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
                    runs.append(opened.enter_context(Process("bridge", *drive, *where)))
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
from gymnasium.spaces import Box, Dict

class Rover(gymnasium.Env):
    action_names = ("left", "right")
    metadata = {"render_fps": 5, "render_modes": ["rgb_array"]}
    observation_space = Dict({
        "camera": Box(0, 255, (4, 6, 3), np.uint8),
        "ranges": Box(-9.0, 9.0, (2,), np.float64),
        "lit": Box(0, 1, (), np.bool_),
    })
    action_space = Box(-40.0, 80.0, (2,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        seen = self.observation_space.sample()
        seen["ranges"] = np.array([self.steps / 10, -self.steps / 10])
        over = self.steps == 20
        return seen, float(action[0]), over, False, {"is_success": True} if over else {}

    def render(self):
        return np.full((30, 40, 3), self.steps, np.uint8)

def register():
    gymnasium.register("somebody/Rover-v0", entry_point="somebodys_envs:Rover")
"""


def test_somebodys_robot_of_another_kind_is_served_recorded_replayed_and_shown(tmp_path, capsys):
    """Several arrays, two wheels of -40 to 80, T of 0.2 s, no speed, and a picture by render()."""
    # A folder as pip leaves it: the module, and the entry point in the package's metadata.
    (tmp_path / "somebodys_envs.py").write_text(MODULE)
    about = tmp_path / "somebodys_envs-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: somebodys-envs\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[gymnasium.envs.__root__]\nany=somebodys_envs:register\n"
    )
    policy, env = tmp_path / "rover.onnx", "somebody/Rover-v0"
    write_rover(policy, task=env, control_period_s=0.2)
    path = {"PYTHONPATH": os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", "")))}
    drive = record_drive(tmp_path, env, policy, environment=path)
    report = read(tmp_path / "report.json")
    (row,) = report["per_episode"]
    assert (report["scenario"], report["success_rate"]) == (env, 1.0)
    assert (row["steps"], row["time_s"]) == (20, 4.0)
    assert row["actions"][9] == pytest.approx([9.0, -9.0])  # ten times the ranges of step 9
    shown = tmp_path / "drive.rrd"
    assert bridge_status(["replay", str(drive), "--policy", str(policy), "--allow-unsigned"]) == 0
    capsys.readouterr()
    assert bridge_status(["view", str(drive), "--save", str(shown)]) == 0
    assert capsys.readouterr() == (f"wrote {shown}\n", "")
    assert "road/picture" in rerun("rrd", "stats", str(shown))


def test_an_environment_that_draws_by_sdl_says_nothing_and_leaves_sigterm_alone():
    code = """
import os, signal, time
from bridge.environments import make_environment
print(make_environment("phil/Congestion-v0").unwrapped.scenario)  # not imported yet
environment = make_environment("racetrack-v0")
environment.reset(seed=0)
print(environment.render().std() > 1.0, flush=True)
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(9)
"""
    told = "XDG_RUNTIME_DIR DISPLAY WAYLAND_DISPLAY SDL_VIDEODRIVER SDL_NO_SIGNAL_HANDLERS"
    clean = {name: value for name, value in os.environ.items() if name not in told.split()}
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (
        -signal.SIGTERM,
        "congestion\nTrue\n",
        "",
    )


class ScriptedClock:
    """Drives for a while with one steering, brakes, and drives again."""

    drive, brake_until = 10, 32

    def begin(self, episode, seed):
        self.states = []

    def exchange(self, state):
        self.states.append(state)
        braking = self.drive <= state.step < self.brake_until
        reason = NO_COMMAND if braking else ""
        steering = 0.04 if state.step < self.drive else -0.02
        command = make_command(state.step, action=[steering])
        return Decision(command, fresh=True, brake_reason=reason)

    def newest_answer(self):
        return None

    def rejected(self):
        return {}

    def finish(self, state):
        self.states.append(state)


@pytest.fixture
def environment():
    environment = make_environment("congestion")
    yield environment
    environment.close()


def run(environment, clock, standing=False):
    told, task = (lambda *_: None), describe(environment)
    origin = Origin(
        session="here", environment="congestion", condition="nominal", seed=3, standing=standing,
        clock="lockstep", loop="policy", latency="none",
    )  # fmt: skip
    runner = EpisodeRunner(environment, clock, told, task, origin)
    return runner, runner.run(0, seed=3)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("action_names", ["a", "b"], ": 2 of name, and 1 actions"),
        ("brake_action", np.zeros(3), ": 3 of stop, and 1 actions"),
        ("car", {"throttle_mps2": 3.0}, ": its car is not valid: .*brake_mps2"),
        ("observation_name", "action", " observes 'action': "),  # A policy cannot use it.
    ],
)
def test_what_an_environment_says_wrongly_of_itself_is_one_line(monkeypatch, name, value, words):
    made = make_environment(TOY)
    monkeypatch.setattr(made.unwrapped, name, value, raising=False)
    with pytest.raises(UserError, match=f"^environment 'left_turn'{words}"):
        describe(made)


def test_what_an_environment_raises_is_one_line_and_in_close_costs_nothing(monkeypatch):
    made = make_environment(TOY)
    monkeypatch.setattr(made.unwrapped, "_goal_m", None)
    made.reset(seed=0)
    with pytest.raises(UserError, match=r"failed in step: TypeError: .* \(environments.py, line"):
        made.step(np.zeros(1, np.float32))
    gone = Mock(side_effect=RuntimeError("the viewer is gone"), __name__="close")
    monkeypatch.setattr(made.unwrapped, "close", gone)
    made.close()


def test_what_an_environment_does_not_know_may_be_none(environment, monkeypatch):
    known = environment.unwrapped.step

    def says(**info):
        def step(action):
            return *known(action)[:4], info

        monkeypatch.setattr(environment.unwrapped, "step", step)

    says(speed_mps=None, distance_m=None, longitudinal_acceleration_mps2=-3.0)
    clock = ScriptedClock()
    _, result = run(environment, clock)
    assert (clock.states[-1].speed_mps, result.distance_m) == (None, 0.0)
    felt = result.lateral_acceleration_mps2, result.longitudinal_acceleration_mps2
    assert felt == (None, 3.0)
    says(speed_mps="x")
    with pytest.raises(UserError, match="the environment's speed_mps is 'x'"):
        run(environment, ScriptedClock())


@pytest.mark.parametrize(
    ("name", "own_s", "says"),
    [
        ("Says", 0.25, ""),
        ("HasFrequency", 0.2, ""),
        ("HasDt", 0.05, ""),
        ("Guessed", 0.05, "0.05 s is guessed from its render_fps"),
    ],
)
def test_the_period_that_is_asked_for_wins_and_a_guess_comes_last(capsys, name, own_s, says):
    say_once.cache_clear()
    made = make_environment(odd(name))
    assert describe(made, 0.5, 0.1).control_period_s == 0.5
    assert capsys.readouterr().err == ""
    assert describe(made, None, 0.1).control_period_s == describe(made).control_period_s == own_s
    assert says in capsys.readouterr().err
    with pytest.raises(UserError, match="the control period is 7"):
        describe(made, 7.0)


def test_where_nothing_says_it_a_period_is_asked_for_or_taken_with_a_line(capsys, monkeypatch):
    say_once.cache_clear()
    made = make_environment(odd("Plain"))
    # Others use this name, too, for something else.
    monkeypatch.setattr(made.unwrapped, "dt", lambda: 3, raising=False)
    with pytest.raises(UserError, match="give it --period"):
        describe(made)
    assert describe(made, None, 0.1).control_period_s == 0.1
    assert "0.1 s is taken" in capsys.readouterr().err


def test_a_constructor_may_take_no_render_mode():
    assert make_environment(odd("NoRenderMode")).render_mode is None


def test_what_a_wrapper_offers_is_found_and_the_outermost_wins():
    inner = make_environment(odd("Offers"))
    task = describe(inner)
    assert (task.control_period_s, list(task.observation)) == (0.2, ["numbers"])
    assert [row.name for row in task.action] == ["pedal"]
    assert known_stops(inner) == [None]  # It has a brake.
    assert scene_of(inner) == {"road_width_m": 4.0}
    adapter = Adapter(inner, task)
    adapter.press_brake(True)
    assert inner.get_wrapper_attr("pressed") == [True]
    assert adapter.stop().tolist() == [-1.0]
    outer = gymnasium.Wrapper(inner)
    outer.control_period_s = 0.4  # type: ignore[attr-defined]
    assert describe(outer).control_period_s == 0.4
    assert list(Adapter(outer, task).pack(np.zeros(3, np.float32))) == ["numbers"]


@pytest.mark.filterwarnings("ignore:.*WARN")  # Gymnasium's
@pytest.mark.parametrize(
    ("given", "fits"),
    [
        (np.full((1, 16, 16), 1.0), False),  # It would be 0.9 in the next step.
        (np.full((1, 16, 16), -1, np.int8), False),
        (np.full((1, 16, 16), 255), True),
        ([[[True] * 16] * 16], True),
    ],
)
def test_an_observation_that_is_not_of_its_spaces_numbers_is_refused(monkeypatch, given, fits):
    made = make_environment(odd("FloatPicture"))
    monkeypatch.setattr(made.unwrapped, "shown", given)
    seen, _ = made.reset(seed=0)
    adapter = Adapter(made, describe(made))
    with contextlib.nullcontext() if fits else pytest.raises(UserError, match="it must be uint8"):
        assert adapter.pack(seen)["observation"] == np.array(given, np.uint8).tobytes()


class Steady(ScriptedClock):
    """Drives with one action, until another edge runtime is there."""

    change = 99

    def exchange(self, state):
        self.states.append(state)
        reason = "other_task" if state.step == self.change else ""
        command = make_command(state.step, action=[0.5])
        return Decision(command, fresh=True, brake_reason=reason)


def test_what_an_environment_does_to_its_action_is_its_own_affair():
    _, result = run(make_environment(odd("WritesAction")), Steady())
    assert result.actions == [[0.5]] * 20
    assert result.outcome == "truncated"


def test_another_runtime_in_the_middle_of_a_drive_ends_it(environment):
    clock = Steady()
    clock.change = 4
    with pytest.raises(UserError, match="another task"):
        run(environment, clock)
    assert [(state.step, state.final) for state in clock.states[-2:]] == [(4, False), (5, True)]


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
    assert result.actions[clock.brake_until] == pytest.approx([-0.02])
    assert clock.states[clock.brake_until + 10].speed_mps > 1.0
    # The next episode begins with the brake released, and holds no action of the last one.
    clock.drive, clock.brake_until = 0, 5
    result = runner.run(1, seed=3)
    assert result.actions[:1] == [[0.0]]
    assert clock.states[12].speed_mps > 3.5


def test_the_policy_of_another_scenario_is_refused_by_both_ends(tmp_path):
    policy, out, endpoint = tmp_path / "c.onnx", tmp_path / "never.json", free_endpoint()
    write_policy(policy, actions=(STEERING,), manifest_changes={"task": "congestion"})
    with start_edge(endpoint, policy) as edge:
        with start_simulate(endpoint, out, TOY) as run:
            assert run.wait() == 2
        assert len(run.errors.splitlines()) == 1
        assert "for another task" in run.errors
        assert not out.exists()
        assert edge.end() == 0
    assert "was=standby now=safe_stop reason=other_task" in edge.errors
    assert "now=drive" not in edge.errors
