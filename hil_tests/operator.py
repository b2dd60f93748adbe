"""The operator beside an unattended drive: re-arms the vehicle after a safe stop.

A runtime with a vehicle attached never drives again by itself. In the demo nobody sits there, so
this stands in for the person and says each time what it does.
"""

from __future__ import annotations

import contextlib
import threading

from edge_runtime.commands import ask
from edge_runtime.util import UserError

POLL_INTERVAL_S = 0.5


class Operator:
    """Watches one vehicle's status for the length of a ``with`` block and re-arms it."""

    def __init__(self, endpoint: str, vehicle_id: str) -> None:
        self.endpoint, self.vehicle_id = endpoint, vehicle_id
        self._end = threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._watch, name="operator")

    def __enter__(self) -> Operator:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _watch(self) -> None:
        try:
            self._poll()
        except Exception as error:
            # Nobody would re-arm any more: whoever waits for this drive must hear of it.
            self._failure = error

    def _poll(self) -> None:
        while not self._end.wait(POLL_INTERVAL_S):
            # Simulator or runtime not up yet, or already gone: nothing to re-arm.
            with contextlib.suppress(UserError):
                self._rearm_if_needed()

    def _rearm_if_needed(self) -> None:
        status = ask(self.endpoint, self.vehicle_id, "status")
        if not status["needs_rearm"] or status["mode"] != "safe_stop":
            return
        if ask(self.endpoint, self.vehicle_id, "rearm")["accepted"]:
            print(f"operator: re-armed {self.vehicle_id} after {status['reason']}", flush=True)
