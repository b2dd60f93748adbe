"""How long updates take, on a processor or on an accelerator that nobody waits for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class UpdateClock:
    """Adds up the time of updates; on CUDA between events, which are read once an episode.

    Args:
        device: where the updates run.
    """

    def __init__(self, device: torch.device) -> None:
        self._on_cuda = device.type == "cuda"
        self._events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []
        self._timed = 0
        self._total_s = 0.0

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Time what is started within."""
        if not self._on_cuda:
            began_s = time.perf_counter()
            yield
            self._total_s += time.perf_counter() - began_s
            return
        began, ended = self._next_events()
        began.record()
        yield
        ended.record()

    def take_total_s(self) -> float:
        """Seconds since the last call. Only once the updates are done."""
        if self._on_cuda:
            used = self._events[: self._timed]
            self._total_s = 1e-3 * sum(began.elapsed_time(ended) for began, ended in used)
        total_s, self._total_s, self._timed = self._total_s, 0.0, 0
        return total_s

    def _next_events(self) -> tuple[torch.cuda.Event, torch.cuda.Event]:
        if self._timed == len(self._events):
            began, ended = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            self._events.append((began, ended))
        self._timed += 1
        return self._events[self._timed - 1]
