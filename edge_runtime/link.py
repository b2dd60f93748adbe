"""The edge runtime's end of the wire: its publishers, subscriber, queryables and token."""

from __future__ import annotations

import json
from typing import Any, Callable, Dict, List, Optional

import msgspec
import zenoh

from edge_runtime import __version__, log
from edge_runtime.manifest import Manifest
from edge_runtime.native_thread import keep_state
from edge_runtime.presence import OpenClient, Presence
from edge_runtime.transport import only_own
from edge_runtime.wire import MAX_PAYLOAD_BYTES, Health, Message, encode, key

_PUBLISHED = ("command", "feedback", "health")


class Link:
    """Thin: it declares, sends and replies, and decides nothing."""

    def __init__(self, session: zenoh.Session, vehicle_id: str, manifest: Manifest) -> None:
        self.vehicle_id = vehicle_id
        self._session = session
        self._manifest = manifest
        self._declared: List[Any] = []
        self._publishers: Dict[str, Any] = {}
        self._presence: Optional[Presence] = None
        self._muted = False
        for topic in _PUBLISHED:
            # DROP: a full queue must never hold the control loop, and the next message is better.
            self._publishers[topic] = session.declare_publisher(
                key(vehicle_id, topic),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )

    def declare(
        self,
        on_state: Callable[[bytes], None],
        health: Callable[[], Health],
        rearm: Callable[[], str],
    ) -> None:
        """Listen to states and answer queries. Call `appear` next, when it can answer."""

        def state_came(sample: zenoh.Sample) -> None:
            # One byte too many is enough to be rejected; a huge message is not copied.
            payload = sample.payload
            size = len(payload)
            on_state(bytes(MAX_PAYLOAD_BYTES + 1) if size > MAX_PAYLOAD_BYTES else bytes(payload))

        def status_asked(query: zenoh.Query) -> None:
            _reply(query, self._status(health()))

        def rearm_asked(query: zenoh.Query) -> None:
            # `phil/**` asks what is there: a look at everything is nobody's permission to move.
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

    def appear(self, open_client: OpenClient, give_way: Callable[[], None]) -> None:
        """Show that it is alive, and look for others with this vehicle id (presence.py)."""
        alive = key(self.vehicle_id, "alive")
        self._presence = Presence(self._session, alive, open_client, give_way)
        self._declared.append(self._presence)
        self._presence.start()

    @property
    def rivals(self) -> int:
        """How many other runtimes were seen under this vehicle id."""
        return self._presence.rivals if self._presence else 0

    def mute(self) -> None:
        """Send nothing more: another runtime speaks for this vehicle."""
        self._muted = True

    def send(self, topic: str, message: Message) -> None:
        """Publish a message. A failure is logged: the receiver's own watchdog handles it."""
        if self._muted:
            return
        try:
            self._publishers[topic].put(encode(message))
        except zenoh.ZError as error:
            log.event("error", "not_sent", topic=topic, detail=error)

    def close(self) -> None:
        """Undeclare all, the token first, then close the session (it hangs at exit otherwise)."""
        try:
            for declared in [*reversed(self._declared), *self._publishers.values()]:
                declared.undeclare()
        finally:
            self._session.close()

    def _status(self, health: Health) -> Dict[str, Any]:
        status: Dict[str, Any] = msgspec.to_builtins(health)
        status["version"] = __version__
        status["manifest"] = msgspec.to_builtins(self._manifest)
        return status


def _at_once(callback: Callable[[zenoh.Sample], None]) -> Any:
    """Zenoh's own thread calls it: no second thread to wake, and no queue of old states between.

    The callback must be quick, for nothing else is received meanwhile.
    """

    def call(sample: zenoh.Sample) -> None:
        keep_state()
        callback(sample)

    return zenoh.handlers.Callback(call, indirect=False)


def _reply(query: zenoh.Query, value: Dict[str, Any]) -> None:
    query.reply(query.key_expr, json.dumps(value).encode(), encoding="application/json")
