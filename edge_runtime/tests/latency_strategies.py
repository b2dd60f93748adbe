"""Specifications of the injected network, for hypothesis."""

from __future__ import annotations

from hypothesis import strategies as st

from edge_runtime.latency.model import DirectionSpec, LatencySpec, Outage
from edge_runtime.latency.spec import ORDERS, TAILS

milliseconds = st.floats(0.0, 10_000.0, allow_nan=False)
percent = st.floats(0.0, 100.0)
outages = st.one_of(
    st.builds(Outage, st.floats(0.0, 100.0), st.floats(0.0, 1000.0)),
    st.builds(Outage, st.floats(0.0, 0.5), st.floats(0.0, 1000.0), st.floats(0.6, 100.0)),
)
common = {
    "delay_ms": milliseconds,
    "jitter_ms": milliseconds,
    "tail": st.sampled_from(TAILS),
    "reorder_percent": percent,
    "reorder_by_ms": milliseconds,
    "order": st.sampled_from(ORDERS),
    "duplicate_percent": percent,
    "rate_kbps": st.one_of(st.just(0.0), st.floats(1.0, 1e6)),
    "queue_ms": milliseconds,
    "outages": st.lists(outages, max_size=3).map(tuple),
}
independent = st.builds(DirectionSpec, loss_percent=percent, **common)
bursty = st.builds(
    DirectionSpec,
    loss_percent=st.floats(5.0, 30.0),
    burst_messages=st.floats(1.0, 50.0),
    burst_loss_percent=st.floats(70.0, 100.0),
    clear_loss_percent=st.floats(0.0, 5.0),
    **common,
)
directions = st.one_of(independent, bursty)
specs = st.one_of(
    st.builds(LatencySpec, directions, directions), directions.map(lambda d: LatencySpec(d, d))
)
