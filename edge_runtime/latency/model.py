"""The injected network: what becomes of a message between two ends, drawn from a seed.

Pure: no clock, no socket, no global. The caller passes the time in and gets the times at which the
message comes out at the other end: none if it is lost, two if it is duplicated. The same model
serves lock-step and training (virtual time), real time (timers), the relay, and the bridge of two
TUN devices. `grammar.py` says how a specification is written, `spec.py` what each number means.

The way of a message: queue and line (`line.py`), outage, loss (`loss.py`), time under way
(`delay.py`), held back or not, duplicated or not, and in order if order is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Tuple

import numpy as np

from edge_runtime.latency.delay import SHAPES
from edge_runtime.latency.grammar import GRAMMAR, parse_spec
from edge_runtime.latency.line import Line
from edge_runtime.latency.loss import BurstLoss, IndependentLoss
from edge_runtime.latency.spec import DIRECTIONS, DirectionSpec, LatencySpec, Outage

__all__ = [
    "DIRECTIONS",
    "GRAMMAR",
    "DirectionSpec",
    "LatencyModel",
    "LatencySpec",
    "Link",
    "Outage",
    "make_link",
    "parse_spec",
]


class LatencyModel:
    """One direction of the link. Not thread-safe; time must not run backwards.

    Each feature draws from a stream of its own, for every message, so that two specifications with
    the same seed meet the same luck and differ only in what was specified.
    """

    def __init__(self, spec: DirectionSpec, seed: np.random.SeedSequence) -> None:
        self.spec = spec
        bursts, reorder, duplicate = seed.spawn(3)
        self._rng = np.random.default_rng(seed)
        self._reorder_rng = np.random.default_rng(reorder)
        self._duplicate_rng = np.random.default_rng(duplicate)
        self._loss = (
            BurstLoss(spec, np.random.default_rng(bursts))
            if spec.burst_messages
            else IndependentLoss(spec)
        )
        self._shape = SHAPES[spec.tail]
        self._line = Line(spec)
        self._newest_arrival_s = float("-inf")

    def arrivals(self, now_s: float, size_bytes: int) -> Tuple[float, ...]:
        """When a message handed over at ``now_s`` arrives (s, same clock), earliest first.

        Empty if it is lost, two times if it is duplicated. ``size_bytes`` matters with a rate.
        """
        lost = self._rng.random() * 100.0 < self._loss.percent()
        draws = [self._rng.standard_normal()]
        held_back = self._reorder_rng.random() * 100.0 < self.spec.reorder_percent
        duplicated = self._duplicate_rng.random() * 100.0 < self.spec.duplicate_percent
        second_draw = self._duplicate_rng.standard_normal()
        if duplicated:
            draws.append(second_draw)
        left_s = self._line.send(now_s, size_bytes)
        if left_s is None or lost or any(outage.covers(left_s) for outage in self.spec.outages):
            return ()
        extra_s = self.spec.reorder_by_ms * 1e-3 if held_back else 0.0
        times = sorted(left_s + self._under_way_s(draw) + extra_s for draw in draws)
        return self._in_order(times) if self.spec.order == "kept" else tuple(times)

    def _under_way_s(self, draw: float) -> float:
        under_way_ms = self.spec.delay_ms + self.spec.jitter_ms * self._shape(draw)
        return max(0.0, under_way_ms) * 1e-3

    def _in_order(self, times: list[float]) -> Tuple[float, ...]:
        """Nobody overtakes: what would arrive before an earlier message arrives with it."""
        kept = tuple(max(arrival_s, self._newest_arrival_s) for arrival_s in times)
        self._newest_arrival_s = kept[-1]
        return kept


@dataclass(frozen=True)
class Link:
    """The two directions of one episode."""

    up: LatencyModel
    down: LatencyModel


def make_link(spec: LatencySpec, seed: int) -> Link:
    """Make both directions, each with its own stream of the seed."""
    up, down = np.random.SeedSequence(seed).spawn(2)
    return Link(LatencyModel(spec.up, up), LatencyModel(spec.down, down))
