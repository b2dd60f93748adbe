"""Sends 50 times a second from a thread of its own, and at once when it is woken.

A chassis takes a stream that pauses for a lost link, so its deadlines are absolute and its thread
does nothing else. The thread inherits the priority that `realtime` gave the process.
"""

from __future__ import annotations

import threading
import time
from typing import Callable, Dict, Optional

from edge_runtime.latency_window import LatencyWindow

PERIOD_S = 0.02
_JOIN_S = 0.5


class Stream:
    """A thread around `send`, which tells whether anything was sent and never raises.

    `late_at_s` says when the newest command becomes too old (monotonic; inf where there is none):
    the stop does not wait for the next period. Both are called without any lock held.
    """

    def __init__(self, name: str, send: Callable[[], bool], late_at_s: Callable[[], float]) -> None:
        self._send, self._late_at_s = send, late_at_s
        self._wake = threading.Event()
        self._stopping = False
        self._sent_s: Optional[float] = None
        self._gaps = LatencyWindow()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin; nothing where it has begun."""
        if self._thread.ident is None:
            self._thread.start()

    def wake(self) -> None:
        """Send now: somebody brakes."""
        self._wake.set()

    def is_alive(self) -> bool:
        """Whether its thread runs."""
        return self._thread.is_alive()

    def run_until(self, condition: Callable[[], bool], limit_s: float) -> None:
        """Go on streaming until the condition holds, no longer than the limit."""
        end_s = time.monotonic() + limit_s
        while self.is_alive() and time.monotonic() < end_s and not condition():
            time.sleep(PERIOD_S)

    def stop(self) -> None:
        """End the thread; one that hangs in `send` is left alone."""
        self._stopping = True
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)

    def gaps_ms(self) -> Dict[str, float]:
        """Quantiles of the times between two sendings, as words for the log; none, none."""
        if self._sent_s is None:
            return {}
        return {f"gap_{name}_ms": round(ms, 2) for name, ms in self._gaps.summary_ms().items()}

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopping:
            self._wake.clear()
            began_s = time.monotonic()
            sent = self._send()
            now_s = time.monotonic()
            if sent:
                self._note_sent(now_s)
            if sent and now_s - began_s > PERIOD_S:
                # A process that was stopped in between has said what was asked for before it was.
                # The vehicle cannot tell, and may have control again: the next does not wait.
                self._wake.set()
            if now_s >= next_s:
                # After a pause one sending, not one for each missed period.
                next_s += (int((now_s - next_s) / PERIOD_S) + 1) * PERIOD_S
            self._wake.wait(max(0.0, min(next_s, self._late_at_s()) - time.monotonic()))

    def _note_sent(self, now_s: float) -> None:
        if self._sent_s is not None:
            self._gaps.add(int((now_s - self._sent_s) * 1e9))
        self._sent_s = now_s
