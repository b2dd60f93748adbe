"""How the injected network is written."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.latency.grammar import SETTINGS
from edge_runtime.latency.model import DirectionSpec, LatencySpec, Outage, parse_spec
from edge_runtime.tests.latency_strategies import specs
from edge_runtime.util import UserError


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
def test_delay_jitter_and_loss(text, up, down):
    assert parse_spec(text) == LatencySpec(DirectionSpec(*up), DirectionSpec(*down))


@pytest.mark.parametrize(
    ("text", "changes"),
    [
        ("tail=pareto", {"tail": "pareto"}),
        ("loss=2%,burst=5", {"loss_percent": 2, "burst_messages": 5}),
        ("burst=2.5,burst_loss=80%", {"burst_messages": 2.5, "burst_loss_percent": 80}),
        ("reorder=1%,reorder_by=0.3s", {"reorder_percent": 1, "reorder_by_ms": 300}),
        ("order=kept,duplicate=3%", {"order": "kept", "duplicate_percent": 3}),
        ("rate=1Mbit/s,queue=50ms", {"rate_kbps": 1000, "queue_ms": 50}),
        ("rate=800bit/s", {"rate_kbps": 0.8}),
        ("outage=500ms@2s", {"outages": (Outage(0.5, 2.0),)}),
        ("outage=0.5s/10s", {"outages": (Outage(0.5, 10.0, 10.0),)}),
        ("outage=0.5s/10s@0s", {"outages": (Outage(0.5, 0.0, 10.0),)}),
        ("outage=1s@2s+0.2s/1e+1s", {"outages": (Outage(1, 2), Outage(0.2, 10, 10))}),
    ],
)
def test_each_further_setting(text, changes):
    direction = DirectionSpec(**changes)
    assert parse_spec(text) == LatencySpec(direction, direction)


BAD_NUMBERS = ("50", "delay=50", "delay=-5ms", "delay=nanms", "delay=2e9s", "jitter=5%")
BAD_LOSSES = ("loss=101%", "loss=0.1", "loss=5", "loss=-1%", "loss=5,burst=3")
BAD_GRAMMAR = ("lag=3ms", "delay=1ms,delay=2ms", "up.up.delay=1ms", "50ms+-", ",", "side.loss=1%")
BAD_CHOICES = ("tail=fat", "order=", "burst=0.5", "burst=5%", "rate=0Mbit/s", "rate=1MB/s")
BAD_OUTAGES = ("outage=1s", "outage=1s@", "outage=10s/1s", "outage=1s@2s+", "outage=1s@2s@3s")
IMPOSSIBLE = ("loss=90%,burst=5", "loss=2%,clear_loss=3%,burst=5", "burst=5,burst_loss=0%")


@pytest.mark.parametrize(
    "text", [*BAD_NUMBERS, *BAD_LOSSES, *BAD_GRAMMAR, *BAD_CHOICES, *BAD_OUTAGES, *IMPOSSIBLE]
)
def test_a_bad_specification_is_one_line_that_names_it(text):
    with pytest.raises(UserError) as error:
        parse_spec(text)
    assert "\n" not in str(error.value)
    assert text.split(",", 1)[0].split("=")[-1] in str(error.value)


@pytest.mark.parametrize("row", SETTINGS, ids=lambda row: row.name)
def test_a_wrong_value_is_answered_with_an_example_that_is_right(row):
    with pytest.raises(UserError, match=rf"write it like {row.name}="):
        parse_spec(f"{row.name}=wrong")
    assert parse_spec(f"{row.name}={row.example.split('|')[-1]}") != LatencySpec()


def test_every_number_of_a_direction_can_be_written():
    assert [row.field for row in SETTINGS] == list(DirectionSpec.__dataclass_fields__)


@given(specs)
def test_a_specification_reads_back_from_its_text(spec):
    assert parse_spec(str(spec)) == spec


@given(specs, st.sampled_from(["", " "]))
def test_the_canonical_text_is_its_own(spec, space):
    text = str(spec)
    assert str(parse_spec(text.replace(",", f",{space}"))) == text


def test_defaults_are_left_out():
    assert str(parse_spec("delay=0.05s,loss=0%,queue=200ms,outage=0.5s/10s@10s")) == (
        "delay=50ms,outage=0.5s/10s"
    )
    assert str(parse_spec("up.loss=0%")) == "none"
