"""Real time without a network: the edge runtime is a function that answers at once."""

from __future__ import annotations

from bridge.command_check import CommandCheck
from bridge.realtime import RealTimeClock
from bridge.tests.commands import make_command
from edge_runtime.latency.model import parse_spec
from edge_runtime.tests.harness import make_state
from edge_runtime.wire import State, decode_state, encode

STEPS = 7


class Rig:
    """A clock whose first publication of each state is answered on the delay line's thread."""

    def __init__(self, spec: str) -> None:
        self.check = CommandCheck("here", action_size=1)
        self.clock = RealTimeClock(self.publish, self.check, parse_spec(spec))
        self.published: list[int] = []

    def publish(self, payload):
        state = decode_state(payload)
        assert isinstance(state, State)
        fresh = state.step not in self.published
        self.published.append(state.step)
        if fresh:
            self.clock.receive(encode(make_command(state.step)))

    def drive(self):
        self.clock.begin(0, seed=0)
        try:
            for step in range(STEPS):
                self.clock.exchange(make_state(step, session="here"))
        finally:
            self.clock.close()


def test_duplicates_come_out_twice_on_both_ways():
    rig = Rig("5ms,duplicate=100%")
    rig.drive()
    # The last command's copy may come after the last tick.
    assert rig.published == [step for step in range(STEPS) for _ in range(2)]
    assert STEPS - 1 <= rig.check.rejected["stale"] <= STEPS
    assert len(rig.clock.latencies_ms) == STEPS


def test_an_outage_is_timed_from_the_episodes_start():
    rig = Rig("up.outage=1000s@0.25s")
    rig.drive()
    assert rig.published[0] == 0
    assert STEPS - 1 not in rig.published
