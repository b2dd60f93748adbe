"""A safe stop where the action only steers: the steering is held, the simulator brakes."""

from __future__ import annotations

import pytest

from bridge.environments import make_environment
from bridge.episode import EpisodeRunner
from bridge.tests.commands import make_command
from edge_runtime.latency.command_hold import NO_COMMAND, Decision


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


def test_the_steering_is_held_and_the_car_stands(environment):
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


def test_after_the_safe_stop_it_drives_on(environment):
    clock = ScriptedClock()
    _, result = run(environment, clock)
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
