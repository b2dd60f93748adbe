from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.latency.event_heap import EventHeap

times = st.lists(st.floats(0, 100, allow_nan=False), max_size=30)


def drain(heap, now_s):
    found = []
    while due := heap.pop_due(now_s):
        found.append(due)
    return found


@given(times, st.floats(0, 100, allow_nan=False))
def test_what_is_due_comes_out_in_order_of_time_then_of_arrival(arrivals, now_s):
    heap: EventHeap[int] = EventHeap()
    for number, arrival_s in enumerate(arrivals):
        heap.push(arrival_s, number)
    expected = sorted((arrival_s, n) for n, arrival_s in enumerate(arrivals) if arrival_s <= now_s)
    assert drain(heap, now_s) == expected
    rest = [arrival_s for arrival_s in arrivals if arrival_s > now_s]
    assert heap.next_arrival_s() == (min(rest) if rest else None)


def test_clear_forgets_everything():
    heap: EventHeap[str] = EventHeap()
    heap.push(1.0, "a")
    heap.clear()
    assert heap.pop_due(9.0) is None
