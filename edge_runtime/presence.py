"""The liveliness token, kept visible to simulators that start after the edge runtime."""

from __future__ import annotations

import threading
from typing import Any, List, Optional

import zenoh

from edge_runtime import log
from edge_runtime.wire import TOPICS

_PERIOD_S = 1.0 / TOPICS["health"].rate_hz


class Presence:
    """Declares the token, and again whenever the routers that this session sees have changed.

    Zenoh 1.5 (the board's) does not tell a router that comes later of a token declared before.
    It has a thread of its own, because a declaration may wait for the network and the watchdog
    must not.
    """

    def __init__(self, session: zenoh.Session, token_key: str) -> None:
        self._session = session
        self._key = token_key
        self._routers = self._seen_routers()
        self._token: Any = session.liveliness().declare_token(token_key)
        self._stopping = threading.Event()
        self._thread: Optional[threading.Thread] = None

    def start(self) -> None:
        """Begin to look for changes."""
        self._thread = threading.Thread(target=self._run, name="presence", daemon=True)
        self._thread.start()

    def refresh(self) -> None:
        """Declare the token again if other routers are there than the last time."""
        routers = self._seen_routers()
        changed, self._routers = routers != self._routers, routers
        if changed and routers:
            self._token.undeclare()
            self._token = self._session.liveliness().declare_token(self._key)

    def undeclare(self) -> None:
        """Stop looking and take the token away."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(_PERIOD_S)
        self._token.undeclare()

    def _seen_routers(self) -> List[str]:
        return sorted(map(str, self._session.info.routers_zid()))

    def _run(self) -> None:
        while not self._stopping.wait(_PERIOD_S):
            try:
                self.refresh()
            except zenoh.ZError as error:
                log.event("error", "token_not_declared", detail=error)
