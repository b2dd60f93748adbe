"""What the relay does with messages: the latency model in real time, and counts. No socket."""

from __future__ import annotations

import threading
import time
from collections import deque
from functools import partial
from typing import Any

import numpy as np

from bridge.clock import Publish
from bridge.delay_line import DelayLine
from edge_runtime.latency.model import LatencyModel, LatencySpec, make_link
from edge_runtime.wire import State, decode_state

UP = ("state",)
DOWN = ("command", "feedback", "health")
"""The topics that pass the model, by direction; queries and liveliness pass at once."""
LAG_WINDOW = 100_000


class TopicTraffic:
    """One topic on its way: what came in, what came out. The caller holds the lock."""

    def __init__(self, model: LatencyModel, deliver: Publish) -> None:
        self.model = model
        self.deliver = deliver
        self.received = self.bytes = self.lost = self.duplicated = self.delivered = 0

    def counts(self) -> dict[str, int]:
        """Return the counts for the report; messages still under way are in none but received."""
        names = ("received", "bytes", "lost", "duplicated", "delivered")
        return {name: getattr(self, name) for name in names}


class RelayTraffic:
    """Holds every message back, drops or doubles it, as the specification says.

    Each topic has a model of its own, so that states and commands meet the same luck as in
    ``bridge simulate --latency`` with the same seed, and a rate is each topic's. Time 0 of the
    models, and so of outage windows, is when the first state comes.
    """

    def __init__(self, spec: LatencySpec, seed: int, deliver: dict[str, Publish]) -> None:
        link = make_link(spec, seed)
        models = {"state": link.up, "command": link.down}
        for number, name in enumerate(DOWN[1:], start=1):
            models[name] = make_link(spec, seed + number).down
        self._topics = {name: TopicTraffic(models[name], deliver[name]) for name in (*UP, *DOWN)}
        self._lock = threading.Lock()
        self._up_line, self._down_line = DelayLine(), DelayLine()
        self._lags_s: deque[float] = deque(maxlen=LAG_WINDOW)
        self._first_state_s: float | None = None

    def handler(self, name: str) -> Publish:
        """Return what takes a payload of this topic, on any thread."""
        return self._take_state if name == "state" else partial(self._take, name)

    def close(self) -> None:
        """Stop delivering."""
        for line in (self._up_line, self._down_line):
            line.close()

    def report(self) -> dict[str, Any]:
        """Return the counts of each topic, and how late the timers were."""
        with self._lock:
            lags_ms = 1e3 * np.array(self._lags_s or [0.0])
            counts = {name: topic.counts() for name, topic in self._topics.items()}
        p50, p99, most = (float(value) for value in np.percentile(lags_ms, [50, 99, 100]))
        return {"topics": counts, "timer_lag_ms": {"p50": p50, "p99": p99, "max": most}}

    def _take_state(self, payload: bytes) -> None:
        state = decode_state(payload)
        if isinstance(state, State) and state.final:
            self._pass_final(payload)
            return
        with self._lock:
            if self._first_state_s is None:
                self._first_state_s = time.monotonic()
        self._take("state", payload)

    def _pass_final(self, payload: bytes) -> None:
        """As in `bridge simulate`: no radio link carries the end of a simulation.

        Nothing injected may delay or lose it, and states of the ended episode are forgotten.
        """
        self._up_line.clear()
        with self._lock:
            topic = self._topics["state"]
            topic.received += 1
            topic.bytes += len(payload)
            topic.delivered += 1
        topic.deliver(payload)

    def _take(self, name: str, payload: bytes) -> None:
        now_s = time.monotonic()
        line = self._up_line if name in UP else self._down_line
        with self._lock:
            topic = self._topics[name]
            start_s = now_s if self._first_state_s is None else self._first_state_s
            arrivals = topic.model.arrivals(now_s - start_s, len(payload))
            topic.received += 1
            topic.bytes += len(payload)
            topic.lost += not arrivals
            topic.duplicated += len(arrivals) > 1
        for arrival_s in arrivals:
            due_s = start_s + arrival_s
            line.push(due_s, partial(self._deliver, topic, payload, due_s))

    def _deliver(self, topic: TopicTraffic, payload: bytes, due_s: float) -> None:
        with self._lock:
            self._lags_s.append(time.monotonic() - due_s)
            topic.delivered += 1
        topic.deliver(payload)
