"""Specifications of the injected network, for hypothesis."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.network import (
    ORDERS,
    SETTINGS,
    SHAPES,
    DirectionSpec,
    LatencyModel,
    LatencySpec,
    Outage,
    make_network,
    parse_spec,
)
from edge_runtime.util import UserError

milliseconds = st.floats(0.0, 10_000.0, allow_nan=False)
percent = st.floats(0.0, 100.0)
outages = st.one_of(
    st.builds(Outage, st.floats(0.0, 100.0), st.floats(0.0, 1000.0)),
    st.builds(Outage, st.floats(0.0, 0.5), st.floats(0.0, 1000.0), st.floats(0.6, 100.0)),
)
common = {
    "delay_ms": milliseconds, "jitter_ms": milliseconds, "tail": st.sampled_from(list(SHAPES)),
    "reorder_percent": percent, "reorder_by_ms": milliseconds, "order": st.sampled_from(ORDERS),
    "duplicate_percent": percent, "rate_kbps": st.one_of(st.just(0.0), st.floats(1.0, 1e6)),
    "queue_ms": milliseconds, "outages": st.lists(outages, max_size=3).map(tuple),
}  # fmt: skip
independent = st.builds(DirectionSpec, loss_percent=percent, **common)
bursty = st.builds(
    DirectionSpec,
    loss_percent=st.floats(5.0, 30.0),
    burst_messages=st.floats(1.0, 50.0),
    clear_loss_percent=st.floats(0.0, 5.0),
    **common,
)
directions = st.one_of(independent, bursty)
specs = st.one_of(
    st.builds(LatencySpec, directions, directions), directions.map(lambda d: LatencySpec(d, d))
)


JITTERY = {"delay_ms": 50, "jitter_ms": 10}


@pytest.mark.parametrize(
    ("text", "up", "down"),
    [
        ("none", {}, {}),
        ("up.loss=0%,queue=200ms", {}, {}),
        ("rate=1Mbit/s,queue=50ms", *[{"rate_kbps": 1000, "queue_ms": 50}] * 2),
        ("rate=800bit/s", *[{"rate_kbps": 0.8}] * 2),
        ("50ms+-10ms", JITTERY, JITTERY),
        ("delay=50ms,jitter=10ms,loss=1%", *[{**JITTERY, "loss_percent": 1}] * 2),
        ("up.delay=30ms,down.loss=2%", {"delay_ms": 30}, {"loss_percent": 2}),
        ("up.delay=30ms,delay=0.1s", {"delay_ms": 30}, {"delay_ms": 100}),
        ("up.delay=3ms,loss=2.5%", {"delay_ms": 3, "loss_percent": 2.5}, {"loss_percent": 2.5}),
        ("up.500us+-1ms, down.20ms", {"delay_ms": 0.5, "jitter_ms": 1}, {"delay_ms": 20}),
        ("reorder=1%,reorder_by=0.3s", *[{"reorder_percent": 1, "reorder_by_ms": 300}] * 2),
        ("outage=0.5s/10s", *[{"outages": (Outage(0.5, 10.0, 10.0),)}] * 2),
        ("outage=0.5s/10s@0s", *[{"outages": (Outage(0.5, 0.0, 10.0),)}] * 2),
        ("outage=1s@2s+0.2s/1e+1s", *[{"outages": (Outage(1, 2), Outage(0.2, 10, 10))}] * 2),
    ],
)
def test_each_way_has_its_own_settings_and_units_are_taken(text, up, down):
    spec = parse_spec(f" {text} ")
    assert spec == LatencySpec(DirectionSpec(**up), DirectionSpec(**down))
    assert parse_spec(str(spec)) == spec


BAD = """
50 delay=50 delay=-5ms delay=nanms delay=2e9s jitter=5% loss=101% loss=0.1 loss=5 loss=-1%
loss=5,burst=3 lag=3ms delay=1ms,delay=2ms up.up.delay=1ms 50ms+- , side.loss=1% tail=fat order=
burst=0.5 burst=5% rate=0Mbit/s rate=1MB/s outage=1s outage=1s@ outage=10s/1s outage=1s@2s+
outage=1s@2s@3s loss=90%,burst=5 loss=2%,clear_loss=3%,burst=5
"""


@pytest.mark.parametrize("text", BAD.split())
def test_a_bad_specification_is_one_line_that_names_it(text):
    with pytest.raises(UserError) as error:
        parse_spec(text)
    assert "\n" not in str(error.value)
    assert text.split(",", 1)[0].split("=")[-1] in str(error.value)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_wrong_value_is_answered_with_an_example_that_is_right(name):
    with pytest.raises(UserError, match=rf"write it like {name}="):
        parse_spec(f"{name}=wrong")
    example = SETTINGS[name].metadata["example"]
    assert parse_spec(f"{name}={example}") != LatencySpec()


SIZE_BYTES = 7_300
PERIOD_S = 0.1
seeds = st.integers(0, 2**32)


def one_way(text, seed=0):
    return make_network(parse_spec(text), seed).up


def run(model, count, start_s=0.0, period_s=PERIOD_S):
    """The arrivals of ``count`` messages that are sent ``period_s`` apart."""
    return [model.arrivals(start_s + k * period_s, SIZE_BYTES) for k in range(count)]


def delays_ms(text, count=20_000):
    """Time under way of messages sent at time 0, one by one."""
    return 1e3 * np.array([times[0] for times in run(one_way(text), count, period_s=0.0)])


def test_delay_jitter_and_loss_draw_what_they_drew_before_there_was_more():
    link = make_network(parse_spec("50ms+-10ms,loss=20%"), seed=7)
    assert run(link.up, 8) == [
        (0.0646508463442135,), (0.17136357283613712,), (0.2567519285192703,), (), (),
        (0.5545275421404332,), (0.6446744988827918,), (0.7331908891114509,),
    ]  # fmt: skip
    assert run(link.down, 4) == [
        (0.058534203299688004,), (0.14942976486668522,), (), (0.332280715406916,),
    ]  # fmt: skip


@given(directions, seeds, st.floats(0.0, 1e6))
def test_none_comes_early_or_thrice_and_none_overtakes_where_order_is_kept(spec, seed, start_s):
    model = LatencyModel(spec, np.random.SeedSequence(seed))
    sent = run(model, 30, start_s)
    for number, times in enumerate(sent):
        assert all(arrival_s >= start_s + number * PERIOD_S for arrival_s in times)
        assert list(times) == sorted(times)
        assert len(times) <= 2
    arrivals = [time for times in sent for time in times]
    assert spec.order != "kept" or arrivals == sorted(arrivals)
    perfect = make_network(LatencySpec(), seed)
    assert run(perfect.up, 2, start_s) == [(start_s,), (start_s + PERIOD_S,)]


@given(specs, seeds)
def test_the_same_seed_draws_the_same_and_another_way_something_else(spec, seed):
    first, second = make_network(spec, seed), make_network(spec, seed)
    assert run(first.up, 20) == run(second.up, 20)
    assert run(first.down, 20) == run(second.down, 20)
    each = make_network(parse_spec("50ms+-10ms"), seed)
    assert run(each.up, 1) != run(each.down, 1)  # Each way has luck of its own.


@pytest.mark.parametrize(
    ("tail", "shape", "floor"),
    [
        # By hand: 0.01 ** (-1/3), less the mean, over the standard deviation.
        ("normal", 2.3263, 5.0),
        ("pareto", (4.6416 - 1.5) / math.sqrt(0.75), 0.578),
    ],
)
def test_delay_jitter_tail_and_floor_are_the_ones_asked_for(tail, shape, floor):
    delays = delays_ms(f"50ms+-10ms,tail={tail}")
    assert np.percentile(delays, 99) == pytest.approx(50 + 10 * shape, rel=0.05)
    assert delays.min() > 50 - floor * 10
    assert np.mean(delays) == pytest.approx(50, abs=0.5 if tail == "pareto" else 0.3)
    assert tail == "pareto" or np.std(delays) == pytest.approx(10, abs=0.5)


@pytest.mark.parametrize(
    ("text", "length", "error"), [("loss=5%,burst=4", 4, 0.2), ("loss=5%", 1 / 0.95, 0.02)]
)
def test_losses_have_the_rate_and_bursts_the_mean_length_asked_for(text, length, error):
    lost = [times == () for times in run(one_way(text), 100_000)]
    assert np.mean(lost) == pytest.approx(0.05, abs=0.004)
    bursts = "".join("x" if one else " " for one in lost).split()
    assert np.mean(list(map(len, bursts))) == pytest.approx(length, abs=error)


def test_a_held_back_message_is_overtaken_by_the_one_after_it():
    arrivals = [times[0] for times in run(one_way("50ms,reorder=10%"), 2000)]
    late = np.array([arrival - 0.05 - k * PERIOD_S > 1e-6 for k, arrival in enumerate(arrivals)])
    assert np.mean(late) == pytest.approx(0.1, abs=0.02)
    overtaken = np.diff(arrivals) < 0
    assert (overtaken == (late[:-1] & ~late[1:])).all()


def test_duplicates_come_as_often_as_asked_and_with_luck_of_their_own():
    arrivals = run(one_way("50ms+-10ms,duplicate=10%"), 5000)
    single = run(one_way("50ms+-10ms"), 5000)
    twice = [times for times in arrivals if len(times) == 2]
    assert len(twice) / 5000 == pytest.approx(0.1, abs=0.015)
    assert all(first < second for first, second in twice)
    assert all(one[0] in times for one, times in zip(single, arrivals, strict=True))
    # What is lost is lost with its duplicate.
    assert set(map(len, run(one_way("loss=30%,duplicate=100%"), 200))) == {0, 2}


@given(st.floats(0.0, 5.0), st.floats(0.0, 50.0), seeds)
def test_an_outage_drops_all_that_is_sent_in_it_and_nothing_else(length_s, start_s, seed):
    length_s, start_s = round(length_s, 6), round(start_s, 6)
    model = one_way(f"outage={length_s:.6f}s@{start_s:.6f}s", seed)
    for number, times in enumerate(run(model, 600)):
        now_s = number * PERIOD_S
        inside = start_s <= now_s and now_s - start_s < length_s
        assert (times == ()) == inside


def test_an_outage_comes_again_after_its_period():
    lost = [k for k, times in enumerate(run(one_way("outage=0.2s/1s"), 45)) if not times]
    assert {10, 11, 21, 31, 41} <= set(lost)
    assert not {k for k in lost if k < 10 or k % 10 > 2}
    lost_from_0 = run(one_way("outage=0.25s/1s@0s"), 12)
    assert [bool(times) for times in lost_from_0[:4]] == [False, False, False, True]


def test_a_feature_does_not_change_the_luck_of_the_others():
    clean, plain = run(one_way("50ms+-10ms"), 300), run(one_way("50ms+-10ms,loss=10%"), 300)
    assert all(b in (a, ()) for a, b in zip(clean, plain, strict=True))
    more = run(one_way("50ms+-10ms,loss=10%,duplicate=20%,reorder=20%"), 300)
    assert [bool(times) for times in plain] == [bool(times) for times in more]


def test_jitter_overtakes_where_order_is_free_and_is_waited_for_where_it_is_kept():
    free = [times[0] for times in run(one_way("200ms+-100ms"), 200)]
    kept = [times[0] for times in run(one_way("200ms+-100ms,order=kept"), 200)]
    assert free != sorted(free)
    assert kept == list(np.maximum.accumulate(free))


def test_a_full_queue_drops_and_drains():
    model = one_way("rate=1Mbit/s,queue=25ms")
    came = [model.arrivals(0.0, 1250) for _ in range(5)]
    assert came[:3] == [pytest.approx((time,)) for time in (0.01, 0.02, 0.03)]
    assert came[3:] == [(), ()]
    assert model.arrivals(0.011, 1250) == pytest.approx((0.04,))


def test_what_waits_for_the_line_is_lost_if_the_outage_begins_before_it_leaves():
    model = one_way("rate=100kbit/s,queue=1s,outage=1s@0.15s")
    assert [bool(model.arrivals(0.0, 1250)) for _ in range(3)] == [True, False, False]
