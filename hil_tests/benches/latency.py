"""State sent to command received on loopback, the edge runtime and the floor block by block."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hil_tests.benches.contenders import Contender, Floor, Ours
from hil_tests.benches.quantiles import compare

PERIOD_S = 0.004
_LAST_ANSWER_S = 0.2


def block_ms(contender: Contender, count: int) -> np.ndarray:
    """The latencies of a block's answers, ms; states without an answer are missing."""
    contender.begin_block()
    sent: dict[int, float] = {}
    next_s = time.perf_counter()
    for _ in range(count):
        step, payload = contender.prepare()
        next_s = max(next_s + PERIOD_S, time.perf_counter())
        time.sleep(max(0.0, next_s - time.perf_counter()))
        sent[step] = time.perf_counter()
        contender.put(payload)
    time.sleep(_LAST_ANSWER_S)
    arrivals = dict(contender.arrivals)
    contender.end_block()
    return np.array([(arrivals[s] - at_s) * 1e3 for s, at_s in sent.items() if s in arrivals])


def alternate(
    ours: Ours, floor: Floor, blocks: int, count: int, tick: Callable[[str], None]
) -> dict[str, Any]:
    """Blocks in turn, who begins a pair ends the next; one pair is not counted."""
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for number in range(blocks + 1):
        order: list[Contender] = [ours, floor] if number % 2 else [floor, ours]
        times = {contender.vehicle_id: block_ms(contender, count) for contender in order}
        if number:
            pairs.append((times[ours.vehicle_id], times[floor.vehicle_id]))
        tick(f"block {number} of {blocks}")
    mine, theirs = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    sent = blocks * count
    return {
        "period_ms": PERIOD_S * 1e3,
        "blocks": blocks,
        "states_per_block": count,
        "unanswered": {
            "ours": sent - sum(map(len, mine)),
            "floor": sent - sum(map(len, theirs)),
        },
        "latency_ms": compare(mine, theirs),
    }
