"""Says what the runtime waits for until its first state: for a link, and why, or for a state."""

from __future__ import annotations

import math
import threading
import time
from typing import Callable, Optional

import zenoh

from edge_runtime import log
from edge_runtime.link_probe import why_no_link
from edge_runtime.tls import TlsFiles

PERIOD_S = 5.0
_POLL_S = 0.1


class Waiting:
    """`look` says it where that is due; `start` has a thread look: a name server takes its time."""

    def __init__(self, has_heard: Callable[[], bool], why: Callable[[], str]) -> None:
        self._has_heard = has_heard
        self._why = why
        self._next_s = -math.inf
        self._ended = threading.Event()

    def look(self, now_s: float) -> bool:
        """Say what is waited for, at once and every 5 s; False once a state was heard."""
        if self._has_heard():
            return False
        if now_s >= self._next_s:
            self._next_s = now_s + PERIOD_S
            why = self._why()
            if why and not self._has_heard():
                log.event("info", "waiting", why=why)
        return True

    def start(self, is_linked: bool) -> None:
        """Look until a state comes, or `stop`. One that is linked has 5 s for its first state."""
        if is_linked:
            self._next_s = time.monotonic() + PERIOD_S
        threading.Thread(target=self._run, name="waiting", daemon=True).start()

    def stop(self) -> None:
        """Say nothing more. Waits for nobody."""
        self._ended.set()

    def _run(self) -> None:
        while self.look(time.monotonic()) and not self._ended.wait(_POLL_S):
            pass


def why_no_state(
    session: zenoh.Session, connect: str, vehicle_id: str, tls: Optional[TlsFiles]
) -> str:
    """What keeps states away, on one line."""
    if not session.info.routers_zid():
        refusal = why_no_link(connect, tls)
        if not session.info.routers_zid():  # it may have come meanwhile
            return refusal or f"{connect} gives no link yet"
    return f"{connect} is there, and has sent no state for vehicle id {vehicle_id} yet"
