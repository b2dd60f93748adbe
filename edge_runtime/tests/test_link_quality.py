"""The live link against made-up networks: what is known of them is what must be estimated."""

import math
import random
from typing import Any

import pytest
from hil_tests.tests.shared.messages import make_state
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.link import FIELDS, KNOWN, LinkQuality, is_poor

MS = 1_000_000
GOOD = dict.fromkeys(FIELDS, 1.0)


class Network:
    """A simulator whose clock is `ahead_ms` before the edge's; delays and losses by functions."""

    def __init__(self, ahead_ms=0.0):
        self.quality, self.ahead_ms = LinkQuality(), ahead_ms
        self.step, self.episode, self.session, self.heard = 0, 0, "a", {}
        self.sent, self.lost = {"up": 0, "down": 0}, {"up": 0, "down": 0}

    def run(self, count, up_ms=lambda: 10.0, down_ms=lambda: 10.0, lose=lambda way: False):
        for _ in range(count):
            now_ms = 1e6 + 100.0 * self.step
            state = self.state(sent_ns=round((now_ms + self.ahead_ms) * MS), **self.heard)
            self.step += 1
            if self.loses("up", lose):
                continue
            arrived_ns = round((now_ms + up_ms()) * MS)
            self.quality.note_state(state, arrived_ns)
            self.quality.note_command(self.episode, arrived_ns)
            if self.loses("down", lose):
                continue
            heard_ns = arrived_ns + round((down_ms() + self.ahead_ms) * MS)
            number = self.heard.get("heard", 0) + 1
            self.heard = {"heard": number, "heard_sent_ns": arrived_ns, "heard_ns": heard_ns}
        return self.quality.measured()

    def loses(self, way, lose):
        lost = lose(way)
        self.sent[way] += 1
        self.lost[way] += lost
        return lost

    def state(self, **changes):
        return make_state(self.step, session=self.session, episode=self.episode, **changes)

    def next_episode(self):
        self.quality.note_state(self.state(sent_ns=0, final=True), 0)
        self.step, self.episode = 0, self.episode + 1


@settings(max_examples=30)
@given(
    ahead_ms=st.floats(-1e5, 1e5), up_ms=st.floats(0, 300), down_ms=st.floats(0, 300),
    spread_ms=st.floats(0, 50), seed=st.integers(0, 99),
)  # fmt: skip
def test_delays_are_within_their_error_whatever_the_clocks_say(
    ahead_ms, up_ms, down_ms, spread_ms, seed
):
    chance = random.Random(seed)
    made: Any = {"up": [], "down": []}

    def way(name, least_ms):
        def draw():
            made[name].append(least_ms + chance.uniform(0.0, spread_ms))
            return made[name][-1]

        return draw

    link = Network(ahead_ms).run(300, way("up", up_ms), way("down", down_ms))
    true_up = math.fsum(made["up"]) / 300
    true_down = math.fsum(made["down"][:299]) / 299  # the last one's echo is yet to come
    assert link["up_ms"] + link["down_ms"] == pytest.approx(true_up + true_down, abs=0.02)
    assert abs(link["up_ms"] - true_up) <= link["error_ms"] + 0.01
    assert abs(link["down_ms"] - true_down) <= link["error_ms"] + 0.01
    least_ms = (min(made["up"]) + min(made["down"][:299])) / 2.0
    assert least_ms - 0.01 <= link["error_ms"] <= least_ms + spread_ms + 0.01
    for name in ("up_jitter_ms", "down_jitter_ms"):
        assert link[name] == pytest.approx(spread_ms / math.sqrt(12.0), rel=0.15, abs=0.01)


@settings(max_examples=20)
@given(up=st.floats(0.0, 0.3), down=st.floats(0.0, 0.3), seed=st.integers(0, 99))
def test_the_share_lost_is_what_was_lost(up, down, seed):
    chance, network = random.Random(seed), Network()
    link = network.run(900, lose=lambda way: chance.random() < (up if way == "up" else down))
    for way in ("up", "down"):  # what the newest messages lost shows with the next that comes
        expected = 100.0 * network.lost[way] / network.sent[way]
        assert link[f"{way}_lost_percent"] == pytest.approx(expected, abs=0.8)
    good = network.run(1300)  # the window moves on
    assert good["up_lost_percent"] == good["down_lost_percent"] == 0.0


def test_what_the_end_of_an_episode_cuts_off_is_no_loss_and_another_simulator_begins_anew():
    network = Network()
    for _ in range(4):
        network.run(50)
        network.step += 3  # under way when it ends
        network.heard = dict(network.heard)
        for _ in range(2):  # commands that are never heard
            network.quality.note_command(network.episode, network.step)
        network.next_episode()
    link = network.run(50)
    assert link["up_lost_percent"] == link["down_lost_percent"] == 0.0
    network.session, network.step, network.heard = "b", 70, {}  # we come late to it
    assert network.run(KNOWN) == {}
    assert network.run(2)["up_lost_percent"] == 0.0


@pytest.mark.parametrize("name", ["up_ms", "down_ms", "up_lost_percent", "down_lost_percent"])
def test_a_poor_link_is_poor_until_it_is_well_within_the_limits(name):
    limit = 200.0 if name.endswith("_ms") else 5.0
    found, poor = [], False
    for share in (0.99, 1.01, 0.9, 0.81, 0.79, 0.99):
        poor = is_poor({**GOOD, name: share * limit}, 0.1, poor)
        found.append(poor)
        assert is_poor({}, 0.1, poor) is poor  # an unknown one is as it was
    assert found == [False, True, True, True, False, False]
