"""A policy behind a network: what the vehicle does, and what a learner is told of it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bridge.network import LatencySpec, parse_spec
from trainer.environments import DelayedVehicle, make_environment, ticks_late
from trainer.evaluation import TogetherDriver, drive_episodes
from trainer.learner.replay import Transition
from trainer.tests.loops import CONFIG, ScriptedEnv, frames, number
from trainer.training.learning import LearningThread


def answer(observation):
    return np.array([number(observation) / 100.0], np.float32)


def driven(monkeypatch, spec, ticks=60, seed=0, human=(), ahead=0) -> tuple[list[float], Any]:
    """Drive over numbered observations; the actions carried out, and the transitions stored."""
    network, env, stored = parse_spec(spec), ScriptedEnv(ticks), list[Transition]()
    learning = LearningThread(replace(CONFIG, latency=spec), env)
    monkeypatch.setattr(learning.replay, "add", stored.append)
    vehicle = DelayedVehicle(env, network)
    observation, _ = vehicle.reset(seed=seed)
    act = vehicle.behind(answer)
    for tick in range(ticks):
        policy_action = action = act(observation)
        if tick in human:
            action = np.array([0.9], np.float32)
        seen, reward, terminated, truncated, _ = vehicle.step(action)
        foreseen = tuple(frames(tick + n) for n in range(ahead))
        transition = Transition(
            observation, action, reward, seen, terminated, truncated, tick in human, policy_action,
            foreseen=foreseen,
        )  # fmt: skip
        learning.add(transition)
        observation = seen
    learning.close()
    return env.actions, stored


brightness = TogetherDriver(lambda seen: seen.mean((1, 2, 3))[:, None].astype(np.float32) / 255)


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
def test_a_perfect_network_is_none_to_the_bit(scenario):
    env = make_environment(scenario)
    vehicle: Any = DelayedVehicle(env, LatencySpec())
    remote: Any = TogetherDriver(brightness.act_together)
    remote.act = vehicle.behind(brightness.act)
    assert drive_episodes(vehicle, remote, [0, 1]) == drive_episodes(env, brightness, [0, 1])


def test_a_reward_stands_beside_the_action_that_earned_it(monkeypatch):
    carried, stored = driven(monkeypatch, "100ms", 8)
    # Round trip 2 ticks: hands off in ticks 0 and 1; tick n obeys the answer to n - 2.
    assert carried == pytest.approx([0, 0, 0, 0.01, 0.02, 0.03, 0.04, 0.05])
    rows = [
        (number(row.observation), row.action[0], row.reward, number(row.next_observation))
        for row in stored
    ]
    assert rows == [(n, pytest.approx(n / 100), n + 3.0, n + 1) for n in range(6)]
    assert [row.terminal for row in stored] == [False] * 5 + [True]


def test_a_humans_action_stands_beside_what_the_policy_would_have_had_to_answer(monkeypatch):
    (row,) = (row for row in driven(monkeypatch, "100ms", 8, human=(4,))[1] if row.human)
    found = number(row.observation), row.action[0], row.reward, number(row.next_observation)
    assert found == (2, pytest.approx(0.9), 5.0, 3)


def test_what_is_foreseen_is_seen_as_late_as_all_else(monkeypatch):
    _, stored = driven(monkeypatch, "100ms", 6, ahead=4)
    assert [number(seen) for seen in stored[-1].foreseen] == [3, 4, 5, 6]


@pytest.mark.parametrize("spec", ["up.loss=30%", "60ms+-50ms", "down.loss=20%,delay=120ms"])
def test_every_tick_is_stored_with_what_was_carried_out(monkeypatch, spec):
    carried, stored = driven(monkeypatch, spec, 60, seed=1)
    late = ticks_late(parse_spec(spec), 0.1)
    assert [number(row.observation) for row in stored] == list(range(60 - late))
    assert [row.action[0] for row in stored] == pytest.approx(carried[late:])
    answers = np.arange(60 - late) / 100.0
    assert not np.allclose(carried[late:], answers)  # The network really spoils some of them.


@pytest.mark.parametrize(
    ("spec", "ticks"),
    [("none", 0), ("12ms", 0), ("12.5ms", 0), ("13ms", 1), ("100ms", 2), ("up.delay=0.3s", 3)],
)
def test_how_old_a_command_on_time_is_agrees_with_the_link(spec, ticks):
    assert ticks_late(parse_spec(spec), 0.1) == ticks
    vehicle = DelayedVehicle(ScriptedEnv(9), parse_spec(spec))
    vehicle.reset(seed=0)
    act = vehicle.behind(answer)
    for tick in range(8):
        act(frames(tick))
    assert vehicle.link.hold.newest_step == 7 - ticks
