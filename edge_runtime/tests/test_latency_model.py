from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.cli import UserError
from edge_runtime.latency.model import (
    DirectionSpec,
    LatencyModel,
    LatencySpec,
    make_link,
    parse_spec,
)

milliseconds = st.floats(0.0, 10_000.0, allow_nan=False)
directions = st.builds(DirectionSpec, milliseconds, milliseconds, st.floats(0.0, 100.0))
specs = st.builds(LatencySpec, directions, directions)


@pytest.mark.parametrize(
    ("text", "up", "down"),
    [
        ("none", (0, 0, 0), (0, 0, 0)),
        ("50ms", (50, 0, 0), (50, 0, 0)),
        ("50ms+-10ms", (50, 10, 0), (50, 10, 0)),
        ("delay=50ms,jitter=10ms,loss=1%", (50, 10, 1), (50, 10, 1)),
        ("up.delay=30ms,down.loss=2%", (30, 0, 0), (0, 0, 2)),
        ("up.delay=30ms,delay=0.1s,loss=2.5%", (30, 0, 2.5), (100, 0, 2.5)),
        ("up.500us+-1ms, down.20ms", (0.5, 1, 0), (20, 0, 0)),
    ],
)
def test_the_grammar(text, up, down):
    assert parse_spec(text) == LatencySpec(DirectionSpec(*up), DirectionSpec(*down))


BAD_NUMBERS = ("50", "delay=50", "delay=-5ms", "delay=nanms", "delay=2e9s", "jitter=5%")
BAD_LOSSES = ("loss=101%", "loss=0.1", "loss=5", "loss=-1%")
BAD_GRAMMAR = ("lag=3ms", "delay=1ms,delay=2ms", "up.up.delay=1ms", "50ms+-", ",", "side.loss=1%")


@pytest.mark.parametrize("text", [*BAD_NUMBERS, *BAD_LOSSES, *BAD_GRAMMAR])
def test_a_bad_specification_is_one_line(text):
    with pytest.raises(UserError) as error:
        parse_spec(text)
    assert "\n" not in str(error.value)


@given(specs)
def test_a_specification_reads_back_from_its_text(spec):
    assert parse_spec(str(spec)) == spec


@given(directions, st.integers(0, 2**32), st.floats(0.0, 1e6))
def test_no_message_arrives_before_it_was_sent(spec, seed, now_s):
    model = LatencyModel(spec, np.random.default_rng(seed))
    arrivals = [model.sample(now_s) for _ in range(20)]
    assert all(arrival is None or arrival >= now_s for arrival in arrivals)


@given(specs, st.integers(0, 2**32))
def test_the_same_seed_draws_the_same(spec, seed):
    first, second = make_link(spec, seed), make_link(spec, seed)
    for _ in range(20):
        assert first.up.sample(1.0) == second.up.sample(1.0)
        assert first.down.sample(1.0) == second.down.sample(1.0)


@given(st.floats(0.0, 100.0), st.integers(0, 2**32))
def test_the_loss_rate_is_the_one_asked_for(loss_percent, seed):
    model = make_link(LatencySpec(up=DirectionSpec(loss_percent=loss_percent)), seed).up
    draws = 2000
    lost = sum(model.sample(0.0) is None for _ in range(draws))
    rate = loss_percent / 100
    # Six standard deviations: by chance once in a billion examples.
    assert abs(lost / draws - rate) <= 6 * np.sqrt(rate * (1 - rate) / draws) + 1e-3


def test_loss_does_not_change_the_delays_of_what_arrives():
    clean = make_link(parse_spec("50ms+-10ms"), seed=1).up
    lossy = make_link(parse_spec("50ms+-10ms,loss=30%"), seed=1).up
    pairs = [(clean.sample(0.0), lossy.sample(0.0)) for _ in range(200)]
    assert all(b is None or a == b for a, b in pairs)
    assert any(b is None for _, b in pairs)


def test_delay_and_jitter_are_the_ones_asked_for():
    model = make_link(parse_spec("50ms+-10ms"), seed=0).up
    arrivals_s = [model.sample(7.0) or 0.0 for _ in range(5000)]
    delays_ms = 1e3 * (np.array(arrivals_s) - 7.0)
    assert np.mean(delays_ms) == pytest.approx(50, abs=1)
    assert np.std(delays_ms) == pytest.approx(10, abs=1)


def test_up_and_down_have_luck_of_their_own():
    link = make_link(parse_spec("50ms+-10ms"), seed=0)
    assert link.up.sample(0.0) != link.down.sample(0.0)
