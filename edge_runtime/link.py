"""The edge runtime's end of the wire: what it publishes and answers, and that it is the only one.

Besides `phil/<id>/alive` each runtime declares `phil/<id>/alive/<claim>`, because Zenoh shows
equal tokens of two sessions as one. Of two runtimes with one vehicle id the younger claim gives
way; a claim is as old as the connection to the router, so a runtime that reconnects loses its
seniority.
"""

from __future__ import annotations

import ctypes
import json
import os
import threading
import time
from typing import Any, Callable, Dict, List, Optional, Set

import msgspec
import zenoh

from edge_runtime import __version__, log
from edge_runtime.manifest import Manifest
from edge_runtime.reach import Listener
from edge_runtime.transport import LEASE_MS, only_own
from edge_runtime.util import UserError
from edge_runtime.wire import Health, Message, Rejection, encode, key

OpenClient = Callable[[], zenoh.Session]

_POLL_S = 0.1
# Two looks so far apart: a claim that is seen in both is no leftover of a lost connection.
_FIRST_LOOKS_S = 0.3
_LOOK_S = 1.0
_CONNECT_S = 0.2
_JOIN_S = 0.5
_LEFTOVER_S = 1.5 * LEASE_MS / 1000.0


class Link:
    """Declares, sends and replies, and decides nothing. `listener` is None without TLS."""

    def __init__(
        self,
        session: zenoh.Session,
        vehicle_id: str,
        manifest: Manifest,
        listener: Optional[Listener] = None,
    ) -> None:
        self.vehicle_id, self.listener = vehicle_id, listener
        self.gave_way = False  # another runtime speaks for this vehicle
        self._session, self._manifest = session, manifest
        self._declared: List[Any] = []
        self._presence: Optional[Presence] = None
        self._publishers = {
            # DROP: a full queue must never hold the control loop, and the next message is better.
            topic: session.declare_publisher(
                key(vehicle_id, topic),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            for topic in ("command", "feedback", "health")
        }

    def declare(
        self,
        on_state: Callable[[bytes], None],
        health: Callable[[], Health],
        rearm: Callable[[], str],
        max_state_bytes: int,
    ) -> None:
        """Listen to states and answer queries. Call `appear` next, when it can answer."""

        def state_came(sample: zenoh.Sample) -> None:
            # One byte too many is enough to be rejected; a huge message is not copied.
            is_huge = len(sample.payload) > max_state_bytes
            on_state(bytes(max_state_bytes + 1) if is_huge else bytes(sample.payload))

        def status_asked(query: zenoh.Query) -> None:
            about = {"version": __version__, "manifest": self._manifest}
            _reply(query, msgspec.to_builtins({**msgspec.structs.asdict(health()), **about}))

        def rearm_asked(query: zenoh.Query) -> None:
            # `phil/**` asks what is there: a look at everything is no permission to move.
            if str(query.key_expr) != rearm_key:
                return
            refusal = rearm()
            _reply(query, {"accepted": not refusal, "detail": refusal, "mode": health().mode})

        session, state_key = self._session, key(self.vehicle_id, "state")
        rearm_key = key(self.vehicle_id, "rearm")
        self._declared = [
            session.declare_subscriber(state_key, _at_once(only_own(state_key, state_came))),
            session.declare_queryable(key(self.vehicle_id, "status"), status_asked),
            session.declare_queryable(rearm_key, rearm_asked),
        ]

    def appear(self, open_client: OpenClient, stop: Callable[[], None]) -> None:
        """Show that it is alive, and look for others with this vehicle id.

        It gives way to an elder one: it sends nothing more, and calls `stop`. `stop` is called,
        too, when its certificate has expired.
        """

        def give_way() -> None:
            self.gave_way = True
            stop()

        alive = key(self.vehicle_id, "alive")
        self._stop = stop
        self._presence = Presence(self._session, alive, open_client, give_way, self.listener)
        self._declared.append(self._presence)
        self._presence.thread.start()

    @property
    def rivals(self) -> int:
        """How many other runtimes were seen under this vehicle id."""
        return self._presence.rivals if self._presence else 0

    def send(self, topic: str, message: Message) -> None:
        """Publish a message. A failure is logged: the receiver's own watchdog handles it."""
        if self.gave_way:
            return
        if self._presence and self.listener and time.time() >= self.listener.own_until_s:
            self._stop()
        try:
            self._publishers[topic].put(encode(message))
        except zenoh.ZError as error:
            log.event("error", "not_sent", topic=topic, detail=error)

    def refusal(self, now_s: float) -> Optional[Rejection]:
        """Say why no state of this Unix time is taken, whatever it holds."""
        return self.listener.refusal(now_s) if self.listener else None

    def close(self) -> None:
        """Undeclare all, the token first, then close the session (it hangs at exit otherwise)."""
        try:
            for declared in [*reversed(self._declared), *self._publishers.values()]:
                declared.undeclare()
        finally:
            self._session.close()


def _at_once(callback: Callable[[zenoh.Sample], None]) -> Any:
    """Let Zenoh's own thread call: no second thread to wake, and no queue of old states between.

    The callback must be quick, for nothing else is received meanwhile. A native thread that calls
    into Python builds a Python state and takes it down for each call: tens of microseconds. One
    PyGILState_Ensure that is never released keeps it, as long as the thread and its session live.
    """
    thread = threading.local()

    def call(sample: zenoh.Sample) -> None:
        if not hasattr(thread, "keeps_its_state"):
            ctypes.pythonapi.PyGILState_Ensure()
            thread.keeps_its_state = True
        callback(sample)

    return zenoh.handlers.Callback(call, indirect=False)


def _reply(query: zenoh.Query, value: Dict[str, Any]) -> None:
    query.reply(query.key_expr, json.dumps(value).encode(), encoding="application/json")


def require_free(open_client: OpenClient, vehicle_id: str) -> bool:
    """Return whether a router answers. Raises UserError where another runtime has this vehicle id.

    Two peers do not hear each other through a router, so a client asks it. The token of a process
    that was just killed may stay for a lease, so a token counts only if it outlasts that.
    """
    selector = f"{key(vehicle_id, 'alive')}/**"
    found = _ask(open_client, selector)
    if found:
        time.sleep(_LEFTOVER_S)
        found = _ask(open_client, selector)
        if found:
            raise taken(vehicle_id)
    return found is not None


def taken(vehicle_id: str) -> UserError:
    """Make the error of a runtime that must give way."""
    found = f"another edge runtime is connected with vehicle id {vehicle_id}"
    return UserError(f"{found}; end that one first")


class Presence:
    """Declares the tokens, and again whenever the routers that this session sees have changed.

    Zenoh 1.5 (the board's) does not tell a router that comes later of a token declared before.
    It has a thread of its own, because all of this may wait for the network and the watchdog
    must not. `give_way` is called where an elder claim than this one's is found.
    """

    def __init__(
        self,
        session: zenoh.Session,
        alive_key: str,
        open_client: OpenClient,
        give_way: Callable[[], None],
        listener: Optional[Listener] = None,
    ) -> None:
        self.rivals = 0
        self._session, self._key, self._open_client = session, alive_key, open_client
        self._give_way, self._listener = give_way, listener
        self._known: Set[str] = set()
        self._seen_before: Set[str] = set()
        self._looks = 0
        self._tokens: List[Any] = []
        self._routers = self._seen_routers()
        self._declare()
        self._stopping = threading.Event()
        self.thread = threading.Thread(target=self._run, name="presence", daemon=True)

    def refresh(self) -> bool:
        """Declare the tokens again if other routers are there than the last time."""
        before, self._routers = self._routers, self._seen_routers()
        if not self._routers or self._routers == before:
            return False
        if self._listener:
            self._listener.look()  # before anybody sees the tokens, and sends
        try:
            self._declare()
        except zenoh.ZError:
            self._routers = []  # so that it is tried again
            raise
        return True

    def look(self) -> None:
        """Look for other claims; give way to an elder one that is seen for the second time."""
        found = _ask(self._open_client, f"{self._key}/*") or []
        claims = {key.rsplit("/", 1)[1] for key in found} - {self.claim}
        seen_twice = claims & self._seen_before
        for claim in sorted(seen_twice - self._known):
            self._known.add(claim)
            self.rivals += 1
            log.event("error", "another_edge", claim=claim, elder=claim < self.claim)
        self._seen_before = claims
        self._looks += 1
        if any(claim < self.claim for claim in seen_twice):
            self._give_way()

    def undeclare(self) -> None:
        """Stop looking and take the tokens away."""
        self._stopping.set()
        if self.thread.is_alive() and self.thread is not threading.current_thread():
            self.thread.join(_JOIN_S)
        self._take_back()

    def _declare(self) -> None:
        self._take_back()
        # Wall clock, because two boards compare it; the rest tells two of one moment apart.
        self.claim = f"{time.time_ns():016x}-{os.urandom(4).hex()}"
        self._seen_before, self._looks = set(), 0
        self._tokens = [
            self._session.liveliness().declare_token(key)
            for key in (self._key, f"{self._key}/{self.claim}")
        ]

    def _take_back(self) -> None:
        while self._tokens:
            self._tokens.pop(0).undeclare()

    def _seen_routers(self) -> List[str]:
        return sorted(map(str, self._session.info.routers_zid()))

    def _run(self) -> None:
        next_look_s = time.monotonic() + _FIRST_LOOKS_S
        while not self._stopping.wait(_POLL_S):
            try:
                if self.refresh():
                    next_look_s = time.monotonic() + _FIRST_LOOKS_S
                if self._routers and time.monotonic() >= next_look_s:
                    if self._listener and self._listener.refusal(time.time()):
                        self._listener.look()
                    self.look()
                    pause_s = _LOOK_S if self._looks > 1 else _FIRST_LOOKS_S
                    next_look_s = time.monotonic() + pause_s
            except zenoh.ZError as error:
                log.event("error", "token_not_declared", detail=error)


def wait_for_router(session: zenoh.Session) -> None:
    """Wait up to 0.2 s for the router that answered: before it is linked tokens go out twice."""
    end_s = time.monotonic() + _CONNECT_S
    while not session.info.routers_zid() and time.monotonic() < end_s:
        time.sleep(0.002)


def _ask(open_client: OpenClient, selector: str) -> Optional[List[str]]:
    """Return the tokens that a router knows, None where no router answers."""
    try:
        session = open_client()
    except UserError:
        return None
    try:
        replies = session.liveliness().get(selector, timeout=1.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
    finally:
        session.close()
