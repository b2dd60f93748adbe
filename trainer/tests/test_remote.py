from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.network import LatencySpec, parse_spec
from trainer.drivers import make_environment
from trainer.evaluate import drive_episodes
from trainer.tests.test_evaluate import brightness
from trainer.training.delayed import DelayedPolicy, DirectPolicy, VehicleEnd, behind, ticks_late


def frames(step):
    """The observation of a tick: its number and the one before as pictures."""
    return np.stack([np.full((45, 80), max(n, 0), np.uint8) for n in (step - 1, step)])


def number(observation):
    """The tick of an observation whose two pictures follow each other."""
    assert observation[1, 0, 0] - observation[0, 0, 0] in (0, 1)
    return int(observation[1, 0, 0])


def answer(observation):
    return np.array([number(observation) / 100.0], np.float32)


class Car:
    """A vehicle that only counts; its brake action cannot be mistaken for an answer."""

    brake_action = np.array([-1.0], np.float32)
    action_space = SimpleNamespace(shape=(1,))


class Kept:
    """Stands for ``LearningThread``: keeps what would be learned, as the replay's chain would."""

    def __init__(self):
        self.rows: list[tuple] = []
        self.current: Any = None

    def start_episode(self, observation):
        self.current = observation

    def add(self, action, reward, observation, *ends):
        seen = number(self.current), float(action[0]), reward, number(observation)
        self.rows.append((*seen, *ends))
        self.current = np.stack([self.current[1], observation[1]])


def drive_delayed(spec, ticks, seed=0, terminated=False, human=()):
    """Drive over numbered observations; the reward of tick n is n."""
    kept: Any = Kept()
    delayed = DelayedPolicy(kept, Car(), parse_spec(spec))
    delayed.start(frames(0), seed)
    actions = []
    for tick in range(ticks):
        actions.append(float(delayed.act(frames(tick), answer)[0]))
        end = terminated and tick == ticks - 1
        action = np.array([0.9 if tick in human else actions[-1]], np.float32)
        delayed.store(action, float(tick), frames(tick + 1), end, tick in human)
    return kept.rows, actions


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
def test_a_perfect_network_is_none_to_the_bit(scenario):
    env = make_environment(scenario)
    for seed in (0, 1):
        end = VehicleEnd(env, LatencySpec(), seed)
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
    rows, actions = drive_delayed("100ms", 8, terminated=True)
    # Round trip 2 ticks: hands off in ticks 0 and 1; tick n obeys the answer to n - 2.
    assert actions == pytest.approx([0, 0, 0, 0.01, 0.02, 0.03, 0.04, 0.05])
    wanted = [(n, pytest.approx(n / 100), n + 2.0, n + 1, n == 5, False) for n in range(6)]
    assert rows == wanted


def test_a_humans_action_stands_beside_what_the_policy_would_have_had_to_answer():
    rows, _ = drive_delayed("100ms", 8, human=(4,))
    assert [row for row in rows if row[5]] == [(2, pytest.approx(0.9), 4.0, 3, False, True)]


@pytest.mark.parametrize("spec", ["up.loss=30%", "60ms+-50ms", "down.loss=20%,delay=120ms"])
def test_every_tick_is_stored_with_what_was_carried_out(spec):
    rows, actions = drive_delayed(spec, 60, seed=1)
    late = ticks_late(parse_spec(spec))
    assert [row[0] for row in rows] == list(range(60 - late))
    assert all(row[3] == row[0] + 1 for row in rows)
    assert [row[1] for row in rows] == pytest.approx(actions[late:])
    answers = np.arange(60 - late) / 100.0
    assert not np.allclose(actions[late:], answers)  # The network really spoils some of them.


def test_a_car_that_hears_nothing_brakes_by_itself():
    end = VehicleEnd(Car(), parse_spec("up.loss=100%"), seed=0)
    braked = []
    for tick in range(4):
        end.tick(frames(tick), answer)
        braked.append(end.braking)
    assert braked == [False, False, True, True]


@pytest.mark.parametrize(
    ("spec", "ticks"),
    [("none", 0), ("12ms", 0), ("12.5ms", 0), ("13ms", 1), ("100ms", 2), ("up.delay=0.3s", 3)],
)
def test_how_old_a_command_on_time_is_agrees_with_the_link(spec, ticks):
    assert ticks_late(parse_spec(spec)) == ticks
    end = VehicleEnd(Car(), parse_spec(spec), seed=0)
    for tick in range(8):
        end.tick(frames(tick), answer)
    assert end.answered_step == 7 - ticks


def test_without_a_network_nothing_is_between():
    for spec, kind in (("none", DirectPolicy), ("1ms", DelayedPolicy)):
        between: Any = behind(parse_spec(spec), Kept(), Car())
        assert type(between) is kind
