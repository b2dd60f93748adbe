"""The live link against made-up networks: what is known of them is what must be estimated."""

import math
import random
from functools import partial
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from edge_runtime.link_quality import ARM_BELOW, LinkQuality, read_envelope
from edge_runtime.tests.harness import make_state
from edge_runtime.tests.policies import TASK, T
from edge_runtime.tests.rigs import a_manifest
from edge_runtime.util import UserError

MS = 1_000_000
LIMITS = {"delay_ms": 100.0, "jitter_ms": 40.0, "loss_percent": 10.0, "burst_messages": 4.0,
          "outage_s": 0.3}  # fmt: skip
ENVELOPE = {
    "policy_id": "p", "env": "left_turn", "condition": "nominal", "promised_success": 0.95,
    "confidence": 0.95, "control_period_s": T, "limits": LIMITS, "joint": 1.0,
}  # fmt: skip


def manifest(**changes):
    return a_manifest(envelope={**ENVELOPE, **changes})


class Network:
    """A simulator whose clock is `ahead_ms` before the edge's; delays and losses by functions."""

    def __init__(self, ahead_ms=0.0, judges=True, **changes):
        self.quality, self.ahead_ms = LinkQuality(manifest(**changes)), ahead_ms
        self.judges = judges  # It costs most, and estimates nothing.
        self.step, self.episode, self.session, self.heard = 0, 0, "a", {}
        self.lost = {"up": 0, "down": 0}

    def run(self, count, up_ms=lambda: 10.0, down_ms=lambda: 10.0, lose=lambda way: False):
        for _ in range(count):
            now_ms = 1e6 + 100.0 * self.step
            state = self.state(sent_ns=round((now_ms + self.ahead_ms) * MS), **self.heard)
            self.step += 1
            if lose("up"):
                self.lost["up"] += 1
                continue
            arrived_ns = round((now_ms + up_ms()) * MS)
            self.quality.note_state(state, arrived_ns)
            self.quality.note_command(self.episode, arrived_ns)
            if self.judges:
                self.quality.judge()
            if lose("down"):
                self.lost["down"] += 1
                continue
            heard_ns = arrived_ns + round((down_ms() + self.ahead_ms) * MS)
            number = self.heard.get("heard", 0) + 1
            self.heard = {"heard": number, "heard_sent_ns": arrived_ns, "heard_ns": heard_ns}
        return self.quality.health()["link"]

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
    assert link["delay_ms"] == pytest.approx((true_up + true_down) / 2.0, abs=0.01)
    assert abs(link["up_ms"] - true_up) <= link["error_ms"] + 0.01
    assert abs(link["down_ms"] - true_down) <= link["error_ms"] + 0.01
    least_ms = (min(made["up"]) + min(made["down"][:299])) / 2.0
    assert least_ms - 0.01 <= link["error_ms"] <= least_ms + spread_ms + 0.01
    assert link["jitter_ms"] == pytest.approx(spread_ms / math.sqrt(12.0), rel=0.15, abs=0.01)


def test_ways_that_are_alike_are_told_apart_from_their_jitter():
    chance = random.Random(1)
    link = Network(5000.0).run(300, lambda: 50 + chance.expovariate(0.05), lambda: 50.0)
    assert (link["up_ms"], link["down_ms"]) == (
        pytest.approx(70.0, abs=2.5), pytest.approx(50.0, abs=1.0),
    )  # fmt: skip


@settings(max_examples=20)
@given(up=st.floats(0.0, 0.3), down=st.floats(0.0, 0.3), seed=st.integers(0, 99))
@example(up=0.125, down=0.25, seed=38)  # by chance, some of the runs read as bursts
def test_the_share_lost_is_what_was_lost(up, down, seed):
    chance, network = random.Random(seed), Network(judges=False)
    link = network.run(900, lose=lambda way: chance.random() < (up if way == "up" else down))
    came = 900 - network.lost["up"]
    shares = network.lost["up"] / 900, network.lost["down"] / came
    # What the newest messages lost shows with the next that comes.
    expected = 100.0 * math.hypot(*shares) / math.sqrt(2.0)
    assert link["lost_percent"] == pytest.approx(expected, abs=0.7)
    if link["outage_s"] == 0.0:
        assert link["loss_percent"] == pytest.approx(expected, abs=0.7)
    else:  # where some runs read as bursts, they are told apart from the rest
        assert link["loss_percent"] < link["lost_percent"]


def test_independent_losses_read_as_bursts_only_by_a_rare_chance():
    def outage_s(seed):
        chance = random.Random(seed)
        share = chance.uniform(0.0, 0.3)
        return Network(judges=False).run(900, lose=lambda way: chance.random() < share)["outage_s"]

    assert sum(outage_s(seed) > 0.0 for seed in range(60)) <= 2  # of 400 such drives, 5 did


@pytest.mark.parametrize(
    ("length", "every", "burst", "outage_s"),
    [(5, 30, 4.0, 0.5), (2, 30, 1.0, 0.2), (1, 30, 0.0, 0.0), (20, 60, 19.0, 1.0)],
)
def test_runs_count_by_their_length_and_their_share(length, every, burst, outage_s):
    network, gap = Network(), every - length
    link = network.run(1200, lose=lambda way: way == "up" and network.step % every >= gap)
    share, run, lost = network.quality.up.losses(3, 1)
    assert (run, lost * 3.0) == (pytest.approx(burst), pytest.approx(outage_s, rel=0.05))
    assert link["burst_messages"] <= burst
    assert link["lost_percent"] == pytest.approx(100 * length / every / math.sqrt(2), rel=0.05)
    assert share == pytest.approx(3 / 1200 + (0.0 if outage_s else length / every), abs=0.002)


def test_a_run_stops_nothing_alone_but_arms_nothing_either():
    network = Network()
    network.run(300)
    network.run(12, lose=lambda way: way == "up")
    network.run(300)
    assert (network.quality.outside, network.quality.values()["burst_messages"]) == ("", 0.0)
    assert network.quality.refusal().endswith("add up to 2.90 of what they may")


@pytest.mark.parametrize("length", [50, 200, 5000])
def test_an_outage_alone_stops_nothing_however_long(length):
    network, states = Network(), []
    network.run(300)
    network.run(length, lose=lambda way: way == "up")
    for _ in range(300):
        network.run(1)
        states.append(network.quality.outside)
    assert set(states) == {""}
    assert network.quality.values()["loss_percent"] == 0.0


def test_late_states_fill_their_gaps_and_copies_count_once():
    network = Network()
    network.run(100)
    first, second, third = (make_state(100 + n, session="a", sent_ns=n) for n in range(3))
    for state in (third, first, first, third):
        network.quality.note_state(state, 0)
    assert sum(network.quality.up.gaps) == 1
    network.quality.note_state(second, 0)
    assert sum(network.quality.up.gaps) == 0


def test_what_the_end_of_an_episode_cuts_off_is_no_loss_and_another_simulator_begins_anew():
    network = Network()
    for _ in range(4):
        network.run(50)
        network.step += 3  # under way when it ends
        network.heard = dict(network.heard)
        for _ in range(2):  # commands that are never heard
            network.quality.note_command(network.episode, network.step)
        network.next_episode()
    network.run(50)
    assert sum(network.quality.up.gaps) == sum(network.quality.down.gaps) == 0
    network.session, network.step, network.heard = "b", 70, {}  # we come late to it
    network.quality.outside = "said of the simulator before"
    network.run(1)
    assert network.quality.outside == ""
    assert list(network.quality.up.gaps) == [0]
    assert network.quality.refusal().startswith("the link is not known yet")


def test_without_an_echo_nothing_is_known():
    quality = LinkQuality(manifest())
    for step in range(300):
        quality.note_state(make_state(step), 0)
        quality.note_command(0, step)
        quality.judge()
        if step == 100:
            assert quality.refusal().startswith(
                "the link is not known yet: that takes 200 messages"
            )
    assert (quality.outside, quality.health()["link"]) == ("", {})
    assert "does not say that it hears commands" in quality.refusal()


@pytest.mark.parametrize(
    ("delay_ms", "outside", "armable"),
    [(70.0, False, True), (81.0, False, False), (89.0, False, False), (91.0, True, False)],
)
def test_the_edge(delay_ms, outside, armable):
    network = Network()
    network.run(310, lambda: delay_ms, lambda: delay_ms)
    assert bool(network.quality.outside) == outside
    if outside:  # 91 of 100: no refusal may say that this is more
        words = "the link is too near the edge of the policy's envelope: delay_ms 91, 100 at most"
        assert network.quality.outside == words
    loss = 3 / 309 * 10  # what may have been missed counts, too
    assert (network.quality.refusal() == "") == (armable and delay_ms / 100 + loss < ARM_BELOW)


def test_what_stopped_stays_until_it_is_well_inside():
    network, found = Network(), []
    for delay_ms in (50.0, 95.0, 85.0, 75.0, 80.0):
        network.run(600, *[partial(float, delay_ms)] * 2)
        found.append(bool(network.quality.outside))
    assert found == [False, True, True, False, False]
    network.run(600, lambda: 110.0, lambda: 110.0)
    words = "the link is outside the policy's envelope:"
    assert network.quality.outside == f"{words} delay_ms 110, 100 at most"
    # What may have been missed counts where a vehicle is to be armed.
    assert network.quality.refusal() == f"{words} all axes add up to 1.12 of what they may"


@pytest.mark.parametrize(
    ("joint", "box", "load"),
    [(1.0, 0.0, 1.0), (0.5, 0.0, 2.0), (0.5, 0.75, 0.6667), (2.0, 0.1, 0.5)],
)
def test_axes_add_up(joint, box, load):
    """Delay at half of its limit, jitter too."""
    network, signs = Network(joint=joint, box=box), [20.0, -20.0]
    both = iter(signs * 2000)
    link = network.run(1200, lambda: 50 + next(both), lambda: 50.0 - signs[network.step % 2])
    assert (link["delay_ms"], link["jitter_ms"]) == (pytest.approx(50, abs=0.2), pytest.approx(20))
    assert link["load"] == pytest.approx(load, abs=0.01)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"limits": {"delay_ms": 1}}, "the envelope is not valid: Object missing required field"),
        ({"joint": "1"}, "the envelope is not valid: Expected `float`"),
        ({"schema": 2}, "the envelope has schema 2, not 1"),
        ({"joint": 0.0}, "its joint above 0"),
        ({"limits": {**LIMITS, "outage_s": -0.1}}, "must be 0 or more"),
        ({"limits": {**LIMITS, "outage_s": math.inf}}, "all finite"),
        ({"box": math.nan}, "all finite"),
        ({"control_period_s": 0.05}, "measured every 0.05 s, the policy drives every 0.1 s"),
    ],
)
def test_what_is_no_envelope_of_the_policy(changes, words):
    with pytest.raises(UserError, match=words):
        read_envelope({**ENVELOPE, **changes}, TASK)
    with pytest.raises(UserError, match=words):
        LinkQuality(manifest(**changes))


def test_a_late_state_of_the_simulator_before_begins_nothing_anew():
    network = Network()
    known = network.run(300)
    network.quality.note_state(make_state(5, session="before"), 0, is_new=False)
    assert network.quality.health()["link"] == known
