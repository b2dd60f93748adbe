"""Environments that are none of our two, from their spaces to a policy file and a person's keys."""

import hashlib
import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle

from bridge import environments as bridge
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError
from trainer import evaluate, export, load, train
from trainer.__main__ import main
from trainer.environments import (
    Adapted,
    check_foresight,
    expert_of,
    foresee,
    inner,
    make_environment,
    outer,
    task_of,
)
from trainer.evaluation import OnnxDriver, constant_driver, load_driver
from trainer.human import HumanModelConfig
from trainer.human.model import HumanModel, demonstrate
from trainer.learner.config import PHIL, LearnerConfig, find_algorithm
from trainer.learner.networks import Actor, CriticPair, tensors
from trainer.learner.replay import ReplayBuffer, ReplayLayout, Transition
from trainer.learner.td3 import TD3Learner
from trainer.person import Reading
from trainer.person import session as driving
from trainer.person.recording import Recorder, read_steps
from trainer.person.session import Sitting, drive
from trainer.person.tests.people import QUICK, Puppet
from trainer.person.web import controls_of, encode_view
from trainer.tests.odd import odd
from trainer.tests.rover import CAMERA, ROVER, Dark, Rover
from trainer.util import load_torch


@pytest.mark.parametrize("name", ["left_turn", "congestion", "examples.tasks:examples/Hill-v0"])
def test_what_is_foreseen_is_what_happens_and_foreseeing_changes_nothing(name):
    env, untouched = make_environment(name), make_environment(name)
    check_foresight(env)
    observation, _ = env.reset(seed=3)
    untouched.reset(seed=3)
    for action in np.array([[0.7], [-0.4], [1.0]], np.float32):
        ahead = foresee(env, observation, action, 4)
        other, real = (
            [observation, *(e.step(action)[0] for _ in range(4))] for e in (untouched, env)
        )
        found, *wanted = ([seen.tobytes() for seen in drive] for drive in (ahead, other, real))
        assert wanted == [found, found]
        assert len(set(found)) == 5
        observation = real[-1]
    assert 2 < len(foresee(env, observation, action, 1000)) < 500  # not beyond the end


@pytest.mark.filterwarnings("ignore:.*WARN")  # Gymnasium's
@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ((np.full(3, np.nan), 1.0), "a number .* that is not finite"),
        ((np.zeros(7), 1.0), r"is \(7,\), not \(3,\)"),
        ((np.zeros(3), np.inf), "reward is inf"),
    ],
)
def test_what_no_network_could_learn_from_is_the_environments_fault(changed, words, monkeypatch):
    env = make_environment("Pendulum-v1")
    env.reset(seed=0)
    monkeypatch.setattr(env.unwrapped, "step", lambda action: (*changed, False, False, {}))
    with pytest.raises(UserError, match=words):
        env.step(np.zeros(1, np.float32))


class Shared(Rover):
    def __deepcopy__(self, memo):
        raise TypeError("a socket cannot be copied")


def test_an_environment_that_cannot_be_copied_is_refused_at_the_start(tmp_path):
    gymnasium.register("test/Shared-v0", f"{__name__}:Shared")
    with pytest.raises(UserError, match="a socket cannot be copied"):
        train(f"{__name__}:test/Shared-v0", out=tmp_path, algorithm="ppl_td3", episodes=1)


class Brief(gymnasium.Env):
    """A coarse picture of a slow cart: one step does not show. A full action ends it, at once."""

    observation_space = Box(0, 255, (4, 4, 1), np.uint8)
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    metadata = Rover.metadata
    most = 0.9

    def __init__(self, render_mode=None):
        self.at, self.over = 0, False

    def reset(self, *, seed=None, options=None):
        self.at, self.over = 0, False
        return np.zeros((4, 4, 1), np.uint8), {}

    def step(self, action):
        assert not self.over, "step after the end"
        self.at, self.over = self.at + 1, bool(action[0] > self.most)
        return np.full((4, 4, 1), self.at // 8, np.uint8), 0.0, self.over, False, {}


class Forgetful(EzPickle, Brief):
    """The same without an end. Its copy begins anew."""

    most = 1.0

    def __init__(self, render_mode=None):
        EzPickle.__init__(self)
        Brief.__init__(self)


def test_an_environment_whose_copy_forgets_its_state_cannot_look_ahead(tmp_path):
    gymnasium.register("test/Forgetful-v0", f"{__name__}:Forgetful")
    gymnasium.register("test/Brief-v0", f"{__name__}:Brief")
    check_foresight(make_environment(f"{__name__}:test/Brief-v0"))
    with pytest.raises(UserError, match="drives differently"):
        train(f"{__name__}:test/Forgetful-v0", out=tmp_path, algorithm="ppl_td3", episodes=1)


def test_the_papers_networks_begin_as_ever():
    """Bit for bit: the first weights of fixed seeds are those of the released results."""
    with torch.random.fork_rng():
        torch.manual_seed(5)
        state = {**Actor(1, 2).state_dict(), **CriticPair(1, 2, 0.25, True).state_dict()}
    digest = hashlib.sha256(b"".join(value.numpy().tobytes() for value in state.values()))
    assert digest.hexdigest()[:16] == "b658a8f7c54f1abe"


def test_the_papers_shape_learns_as_ever():
    """Three updates from fixed seeds: numbers of the day before any other shape was known."""
    random = np.random.default_rng(4)
    buffer = ReplayBuffer(60, steps=8, gamma=0.95, overruled_value=-10.0)
    frames = random.integers(0, 255, (42, 45, 80), np.uint8)
    for i in range(40):
        action = random.uniform(-1, 1, 1).astype(np.float32)
        seen, human, penalised = frames[i + 1 : i + 3], i % 3 == 0, i % 9 == 0
        step = Transition(frames[i : i + 2], action, float(action[0]), seen, False, human=human)
        buffer.add(replace(step, overruled=-action, penalised=penalised))
    learner = TD3Learner(LearnerConfig(precision="float32"), PHIL, seed=2)
    losses = [learner.update(buffer.sample(32, random))[:4] for _ in range(3)][-1]
    assert losses == pytest.approx((90.22279, 1.52736, 0.43012, -1.525), rel=1e-4)


def test_an_observation_is_one_array_and_an_action_has_one_scale():
    env = make_environment(ROVER)
    seen, _ = env.reset(seed=1)
    assert (seen.dtype.names, seen["far"].dtype) == (("camera", "far", "wheels"), np.float32)
    env.step(np.array([-1.0, 1.0], np.float32))
    np.testing.assert_allclose(env.unwrapped.done, [-1.0, 1.0])
    assert inner(env.action_range, [3.0, 0.5]).tolist() == [1.0, 0.0]
    task = task_of(env)
    assert (task.control_period_s, [row.high for row in task.action]) == (0.05, [3.0, 1.0])
    ended = [env.step(np.ones(2, np.float32)) for _ in range(11)][-1]
    assert (ended[3], ended[4]["outcome"]) == (True, "goal")
    for space in (gymnasium.spaces.Discrete(2), Box(-np.inf, np.inf, (1,))):
        wrong: Any = Rover()
        wrong.action_space = space
        with pytest.raises(UserError, match=r"acts in .*Box with bounds"):
            Adapted(wrong, "wrong")


@pytest.mark.parametrize(
    "space", [CAMERA, Box(0, 255, (9, 7), np.uint8), Box(0, 9, ()), Rover.observation_space]
)
def test_a_learner_follows_any_observation_and_the_replay_keeps_its_bytes(space):
    env: Any = Rover()
    env.observation_space = space
    layout: ReplayLayout = Adapted(env, "any").layout
    random, buffer = np.random.default_rng(0), ReplayBuffer(50, 2, steps=3, layout=layout)
    size = layout.dtype.itemsize * int(np.prod(layout.shape))
    seen = np.frombuffer(random.bytes(41 * size), np.uint8) & 63  # no float that is not finite
    rows = seen.view(layout.dtype).reshape(41, *layout.shape)
    for before, after in pairwise(rows):
        human = bool(random.random() < 0.3)
        buffer.add(Transition(before, np.zeros(2, np.float32), 1.0, after, False, human=human))
    copy = ReplayBuffer(50, 2, steps=3, layout=layout)
    copy.load_state_dict(buffer.state_dict())
    batch, again = (each.sample(16, np.random.default_rng(1)) for each in (buffer, copy))
    assert batch.frames.tobytes() == again.frames.tobytes() == rows[batch.indices].tobytes()
    assert batch.next_frames.tobytes() == rows[batch.indices + batch.spans].tobytes()
    learner = TD3Learner(LearnerConfig(batch_size=16), PHIL, 0, 2, space=space)
    before = learner.actor.act(rows[:1])
    assert np.isfinite(learner.update(batch)[:4]).all()
    assert not np.array_equal(before, learner.actor.act(rows[:1]))
    assert [part.shape[0] for part in tensors(rows)] == [41] * len(tensors(rows))


def test_a_run_is_evaluated_exported_and_driven_in_the_environments_units(tmp_path):
    settings: dict[str, float] = {"batch_size": 8, "warmup_steps": 20, "evaluation_runs": 1}
    settings |= {"late_from_s": 0.05, "late_to_s": 0.1}  # Only together do they hold.
    row, threads = f"{__name__}:PHIL", torch.get_num_threads()
    steps: list[Any] = []
    run = train(
        ROVER, algorithm=row, episodes=4, settings=settings, out=tmp_path / "run",
        on_step=lambda seen, intervention, info: steps.append((seen.human, intervention)),
    )  # fmt: skip
    numbers = run.metrics
    assert numbers.human_steps.sum() == sum(human for human, _ in steps) > 0
    assert numbers.steps.sum() == len(steps) == numbers.total_steps.iloc[-1]
    assert torch.get_num_threads() == threads
    alone = evaluate(run, runs=2)
    made = export(run, tmp_path / "p.onnx")
    assert made.max_difference < 1e-5
    assert max(len(repr(each)) for each in (run, alone, alone.episodes, made)) < 1000
    policy = load_policy(tmp_path / "p.onnx", allow_unsigned=True)
    assert list(policy.manifest.observation) == ["camera", "far", "wheels"]
    with pytest.raises(UserError, match="is typed: give --scenario "):
        evaluate(tmp_path / "p.onnx")
    filed = evaluate(tmp_path / "p.onnx", ROVER, runs=2)
    assert filed.mean_return == pytest.approx(alone.mean_return, abs=1e-3)
    env = make_environment(ROVER)
    driver, _ = load_driver(str(tmp_path / "p.onnx"), env)
    assert isinstance(driver, OnnxDriver)
    seen = env.reset(seed=3)[0]
    raw = policy.act({name: seen[name] for name in seen.dtype.names})
    np.testing.assert_allclose(outer(env.action_range, driver.act(seen)), raw, atol=1e-5)
    ready = load(tmp_path / "p.onnx")
    action = ready.act({name: seen[name].astype(float) for name in ("far", "wheels")} | {
        "camera": seen["camera"]})  # fmt: skip
    np.testing.assert_allclose(action, raw, atol=1e-5)
    assert len(repr(ready)) < 300


@pytest.mark.parametrize(("words", "period_s"), [([], 0.1), (["--period", "0.25"], 0.25)])
def test_a_step_that_has_no_length_of_its_own_takes_the_period_that_is_asked_for(
    words, period_s, tmp_path, capsys
):
    bridge.say_once.cache_clear()
    command = ["train", "--scenario", f"{__name__}:test/Dark-v0", "--out", str(tmp_path / "run")]
    short = ["--episodes", "1", "--algorithm", "per_td3", "--set", "evaluate_every_steps=0"]
    assert main([*command, *short, *words]) == 0
    said = "Dark-v0 does not say how long a step is: 0.1 s is taken"
    assert (said in capsys.readouterr().err) == (not words)
    export(tmp_path / "run", tmp_path / "p.onnx", scenario=f"{__name__}:test/Dark-v0")
    assert (
        load_policy(tmp_path / "p.onnx", allow_unsigned=True).manifest.control_period_s == period_s
    )
    for policy in (tmp_path / "run", tmp_path / "p.onnx"):
        found = evaluate(policy, scenario=f"{__name__}:test/Dark-v0", runs=1)
        assert found.report["episode_time_s"]["mean"] == pytest.approx(12 * period_s)
    config = tmp_path / "run/config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "period_s": "long"}))
    with pytest.raises(UserError, match=r"period_s .* is no number: 'long'"):
        evaluate(tmp_path / "run", scenario=f"{__name__}:test/Dark-v0", runs=1)


SHORT: dict[str, float] = {"evaluation_runs": 2, "warmup_steps": 10, "batch_size": 8}


@pytest.mark.parametrize("every", [0, 20])
def test_a_simulator_that_lives_once_in_a_process_is_trained_evaluated_and_exported(
    tmp_path, every
):
    settings = {**SHORT, "evaluate_every_steps": every}
    run = train(odd("Single"), algorithm="per_td3", steps=40, settings=settings, out=tmp_path / "r")
    unknown = run.metrics[["validation_success", "confirmed_success"]]
    assert unknown.isna().all(axis=None)  # It does not say.
    assert run.metrics.validation_reward.isna().tolist() == [not every] * 2
    found = evaluate(run, runs=2)
    assert found.report["lateral_acceleration_mps2"] == {"mean": None, "std": None}
    assert [one.lateral_acceleration_mps2 for one in found.episodes] == [None, None]
    assert export(run, tmp_path / "p.onnx").max_difference < 1e-5
    make_environment(odd("Single")).close()  # Closed again


@pytest.mark.filterwarnings("ignore:.*WARN")  # Gymnasium's
def test_what_a_simulator_does_to_directory_and_observations_is_found_out(
    tmp_path, monkeypatch, capsys
):
    for command in (
        "train --algorithm per_td3 --steps 20 --out run --set warmup_steps=10",
        "evaluate run --runs 1 --out e.json",
        "export run --out p.onnx",
    ):
        monkeypatch.chdir(tmp_path)
        assert main([*command.split(), "--scenario", odd("Wanders")]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"run", "e.json", "p.onnx"}
    monkeypatch.chdir(tmp_path)
    bridge.say_once.cache_clear()
    with pytest.raises(UserError, match=r"holds 0\.89.* must be uint8"):
        make_environment(odd("FloatPicture")).reset(seed=0)
    for seed in (0, 1):
        make_environment(odd("Huge")).reset(seed=seed)
    assert capsys.readouterr().err.count("no network learns") == 1


def test_a_run_that_is_stopped_validates_only_where_that_is_due(tmp_path):
    settings = {**SHORT, "evaluate_every_steps": 35}
    asked: Any = {"algorithm": "per_td3", "settings": settings, "steps": 60, "out": tmp_path}
    first = train(odd("Tells"), **asked, max_minutes=1e-9).metrics
    assert first.validation_success.notna().tolist() == [False]
    rows = train(odd("Tells"), **asked, resume=True).metrics
    due = rows.episode[rows.validation_success.notna()]
    assert 0 not in due.tolist()
    assert load_torch(tmp_path / "best_actor.pt")["episode"] - 1 in due.tolist()


def test_a_period_that_was_asked_for_is_that_of_all_that_follows(tmp_path):
    def driven_at(scenario, policy):
        asked = {"recording": None, "at": None, "episode": None, "vehicle_id": None, "seed": 0}
        options: Any = SimpleNamespace(**asked, scenario=scenario, policy=policy, public_key=None)
        return driving._environment(options)[0].control_period_s

    for scenario in (odd("Says"), "left_turn"):
        name = tmp_path / scenario.rpartition("/")[2]
        settings = {"period_s": 0.5, "evaluate_every_steps": 0}
        run = train(scenario, algorithm="per_td3", episodes=1, settings=settings, out=name)
        made = export(run, name.with_suffix(".onnx"))
        assert onnx.load_from_string(made.model).metadata_props[0].value.count('_s":0.5')
        for policy in (run, name.with_suffix(".onnx")):
            (episode,) = evaluate(policy, scenario, runs=1).episodes
            assert episode.time_s == 0.5 * episode.steps
        assert driven_at(scenario, str(run.directory)) == 0.5 != driven_at(scenario, None)
        with pytest.raises(UserError, match=r"the control period is 0\.001"):
            make_environment(scenario, period_s=0.001)


def test_a_limit_of_steps_is_a_timeout_where_another_episode_tells():
    found = evaluate("constant:0", odd("Tells"), runs=4)
    assert [one.outcome for one in found.episodes] == ["timeout", "goal", "goal", "timeout"]
    assert found.success_rate == 0.5
    assert found.report["lateral_acceleration_mps2"] == {"mean": 2.0, "std": 0.0}
    found = evaluate("constant:0", odd("Says"), runs=2)
    assert ({one.outcome for one in found.episodes}, found.success_rate) == ({"truncated"}, None)


class Drawn(gymnasium.Wrapper[Any, Any, Any, Any]):
    metadata, render_mode = Rover.metadata, "rgb_array"


def test_what_a_wrapper_offers_is_found():
    kinds: Any = Rover(), Drawn(Dark())  # The first was made to draw nothing
    assert [Adapted(env, "any").can_be_seen for env in kinds] == [False, True]
    env = make_environment(odd("Offers"))
    assert (env.control_period_s, env.action_names, env.key_rate_per_s) == (0.2, ("pedal",), 2.0)
    assert (env.brake_action.tolist(), env.keys["w"].tolist()) == ([-1.0], [1.0])
    assert (env.scene(), env.can_be_seen) == ({"road_width_m": 4.0}, True)
    assert expert_of(env).act().tolist() == [0.5]
    env.press_brake(True)
    assert env.env.get_wrapper_attr("pressed") == [True]


def test_experts_rows_and_keys_are_found_by_name(monkeypatch):
    env = make_environment(ROVER)
    env.reset(seed=0)
    for expert in (expert_of(env), expert_of(env, "trainer.tests.rover:Careful")):
        assert expert.act().tolist() == [1.0, 0.0]
        assert expert.wants_control(np.array([-1.0, 0.0], np.float32)) == "slow"
        assert expert.may_return()
    with pytest.raises(UserError, match=r"offers no expert\(\)"):
        expert_of(make_environment("Pendulum-v1"))
    assert find_algorithm(f"{__name__}:PHIL") is PHIL
    for wrong in ("magic", f"{__name__}:Rover", "nowhere:ROW"):
        with pytest.raises(UserError):
            find_algorithm(wrong)
    with pytest.raises(UserError, match=r"a person cannot see .*no render\(\)"):
        controls_of(make_environment(f"{__name__}:test/Dark-v0"))
    controls = controls_of(env)
    assert controls.rest == pytest.approx((-0.5, -1.0))
    assert controls.keys == {"up": (1.5, 2.0), "a": pytest.approx((-0.5, 0.0))}
    for keys, says in (
        ({"KeyQ": (0.0, 0.0)}, "uses the keys q, which"),
        ({}, "several actions, and no keys"),
    ):
        monkeypatch.setattr(Rover, "keys", keys)
        with pytest.raises(UserError, match=says):
            controls_of(env)


def test_a_person_drives_two_numbers_and_is_recorded_and_imitated(tmp_path):
    env, hands = make_environment(ROVER), Reading((1.0, 0.5), engaged=True)
    controls = controls_of(env)
    off = Reading(controls.rest)
    person: Any = Puppet([off] * 3 + [hands] * 5, then=off)
    sitting = Sitting(person, env, Recorder(tmp_path), speed=QUICK)
    drive(sitting, constant_driver(0.0, 2), abs, 1)
    sitting.close()
    steps = list(read_steps(sitting.recorder.path))
    assert [step.action for step in steps[2:5]] == [(0.0, 0.0), (0.5, 0.5), (1.0, 0.5)]
    assert steps[4].next_observation.tobytes() == steps[5].observation.tobytes()
    assert json.loads(encode_view(person.views[4], 1, controls))["picture"]
    model = HumanModel(HumanModelConfig(batch_size=4), 0, 2, env.observation_space)
    assert demonstrate(model, [sitting.recorder.path], env) == 1
    assert np.isfinite(model.learn(2))
