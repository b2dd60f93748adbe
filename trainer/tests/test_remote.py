from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.network import LatencySpec, parse_spec
from trainer.environments import make_environment
from trainer.evaluation import drive_episodes
from trainer.tests.test_evaluate import brightness
from trainer.training.delayed import DelayedPolicy, VehicleEnd, ticks_late


def frames(step):
    """The observation of a tick: its number and the one before as pictures."""
    return np.stack([np.full((45, 80), max(n, 0), np.uint8) for n in (step - 1, step)])


def number(seen):
    """The tick of an observation whose two pictures follow each other."""
    assert seen[1, 0, 0] - seen[0, 0, 0] in (0, 1)
    return int(seen[1, 0, 0])


def answer(observation):
    return np.array([number(observation) / 100.0], np.float32)


class Car:
    """A vehicle that only counts; its brake action cannot be mistaken for an answer."""

    brake_action, rest_action = np.array([[-1.0], [0.0]], np.float32)
    control_period_s = 0.1


class Driven:
    """A policy behind a network, driven over numbered observations; the reward of tick n is n.

    Keeps what was ``carried`` out, and what would be learned: what was ``stored``, and as ``rows``:
    observation, action, reward, next observation, ends.
    """

    def __init__(self, spec, seed=0):
        self.spec, self.env = parse_spec(spec), Car()
        self.carried, self.stored, self.rows = [], [], list[Any]()
        learner: Any = self  # as far as it is asked
        self.delayed = DelayedPolicy(learner, self.env, self.spec)
        self.delayed.start(frames(0), seed)

    def start_episode(self, observation):
        self.stored.append(observation)

    def add(self, action, reward, observation, *ends, overruled=None, foreseen=()):
        self.foreseen = [number(each) for each in foreseen]
        seen = number(self.stored[-1]), float(action[0]), reward, number(observation)
        self.rows.append((*seen, *ends))
        self.stored.append(observation)

    def drive(self, ticks, terminated=False, human=(), **guidance):
        for tick in range(ticks):
            action = self.delayed.act(frames(tick), answer)
            action = np.array([0.9], np.float32) if tick in human else action
            end = terminated and tick == ticks - 1
            done = action, float(tick), frames(tick + 1), end, tick in human
            more = {name: of(tick) for name, of in guidance.items()}
            self.delayed.store(*done, **more)
            self.carried.append(float(action[0]))
        return self


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
def test_a_perfect_network_is_none_to_the_bit(scenario):
    env = make_environment(scenario)
    for seed in (0, 1):
        end = VehicleEnd(env, LatencySpec(), seed, frames(0))
        remote: Any = SimpleNamespace(
            reset=brightness.reset, act=lambda seen, end=end: end.tick(seen, brightness.act)
        )
        assert drive_episodes(env, remote, [seed]) == drive_episodes(env, brightness, [seed])


def test_a_delayed_driver_is_another_and_the_same_each_time():
    env, spec = make_environment("left_turn"), parse_spec("100ms+-40ms,loss=5%")
    first, again = (drive_episodes(env, brightness, [3], latency=spec) for _ in range(2))
    assert first == again
    assert first[0].actions != drive_episodes(env, brightness, [3])[0].actions


def test_a_reward_stands_beside_the_action_that_earned_it():
    driven = Driven("100ms").drive(8, terminated=True)
    # Round trip 2 ticks: hands off in ticks 0 and 1; tick n obeys the answer to n - 2.
    assert driven.carried == pytest.approx([0, 0, 0, 0.01, 0.02, 0.03, 0.04, 0.05])
    wanted = [(n, pytest.approx(n / 100), n + 2.0, n + 1, n == 5, False) for n in range(6)]
    assert driven.rows == wanted


def test_a_humans_action_stands_beside_what_the_policy_would_have_had_to_answer():
    rows = Driven("100ms").drive(8, human=(4,)).rows
    assert [row for row in rows if row[5]] == [(2, pytest.approx(0.9), 4.0, 3, False, True)]


def test_what_is_foreseen_is_seen_as_late_as_all_else():
    driven = Driven("100ms").drive(
        6,
        overruled=lambda tick: np.ones(1, np.float32),
        foreseen=lambda tick: [frames(each) for each in range(tick, tick + 4)],
    )
    assert driven.foreseen == [3, 4, 5, 6]


@pytest.mark.parametrize("spec", ["up.loss=30%", "60ms+-50ms", "down.loss=20%,delay=120ms"])
def test_every_tick_is_stored_with_what_was_carried_out(spec):
    driven = Driven(spec, seed=1).drive(60)
    rows, actions = driven.rows, driven.carried
    late = ticks_late(parse_spec(spec), Car.control_period_s)
    assert [row[0] for row in rows] == list(range(60 - late))
    assert all(row[3] == row[0] + 1 for row in rows)
    assert [row[1] for row in rows] == pytest.approx(actions[late:])
    answers = np.arange(60 - late) / 100.0
    assert not np.allclose(actions[late:], answers)  # The network really spoils some of them.


@pytest.mark.parametrize(
    ("spec", "ticks"),
    [("none", 0), ("12ms", 0), ("12.5ms", 0), ("13ms", 1), ("100ms", 2), ("up.delay=0.3s", 3)],
)
def test_how_old_a_command_on_time_is_agrees_with_the_link(spec, ticks):
    assert ticks_late(parse_spec(spec), Car.control_period_s) == ticks
    end = VehicleEnd(Car(), parse_spec(spec), 0, frames(0))
    for tick in range(8):
        end.tick(frames(tick), answer)
    assert end._link.hold.newest_step == 7 - ticks
