"""What the edge runtime rejected during a drive, whatever it had counted before."""

from __future__ import annotations

import msgspec
import pytest

from bridge.edge_counts import EdgeCounts
from bridge.report import rejections
from edge_runtime.wire import Health, encode


def health(sent_ns, uptime_s, vehicle="none", needs_rearm=False, **rejected):
    return Health(
        vehicle_id="v", vehicle=vehicle, mode="drive", reason="", needs_rearm=needs_rearm,
        accepted=1, superseded=0, rejected=rejected, deadline_misses=0, safe_stops=0, policy_id="p",
        inference_ms={}, uptime_s=uptime_s, sent_ns=sent_ns,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        ([], {}),
        ([health(1, 1.0, stale=7)], {}),
        ([health(1, 1.0, stale=7), health(2, 2.0, stale=9, schema=1)], {"stale": 2, "schema": 1}),
        # Restarted: it counts from zero, even where it has passed the old count.
        ([health(1, 9.0, stale=1), health(2, 0.5, stale=3)], {"stale": 3}),
        # The board's wall clock was set back in between.
        ([health(9, 1.0), health(2, 2.0, stale=1), health(3, 3.0, stale=2)], {"stale": 2}),
        # A message that an answer has overtaken is no restart.
        ([health(1, 1.0), health(3, 3.0, stale=2), health(2, 2.0, stale=1)], {"stale": 2}),
    ],
)
def test_growth_is_added_up(messages, expected):
    counts = EdgeCounts()
    for message in messages:
        counts.observe_message(encode(message))
    assert counts.rejected == expected


def test_the_status_answer_counts_as_a_message_and_junk_does_not():
    counts = EdgeCounts()
    counts.observe_message(encode(health(1, 1.0)))
    status = {**msgspec.to_builtins(health(2, 2.0, stale=1)), "version": "1", "manifest": {}}
    counts.observe_status(msgspec.json.encode(status))
    counts.observe_status(b"junk")
    counts.observe_message(b"junk")
    assert counts.rejected == {"stale": 1}


def test_the_report_joins_both_sides():
    report = rejections({"stale": 2}, {"stale": 1, "schema": 3})
    assert report["rejected"] == {"stale": 3, "schema": 3}
    assert report["rejected_by_edge"] == {"stale": 2}
    assert report["rejected_by_simulator"] == {"stale": 1, "schema": 3}


def test_health_that_cannot_be_read_is_counted_by_reason():
    counts = EdgeCounts()
    for payload in (b"junk", bytes(70_000), encode(health(1, 1.0))):
        counts.observe_message(payload)
    assert counts.unreadable == {"health_malformed": 1, "health_oversized": 1}
    assert counts.rejected == {}
