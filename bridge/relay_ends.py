"""The relay's two ends: to the edge runtime it is the simulator's router, to the simulator a peer.

Zenoh calls the handlers on its own threads; they only push into delay lines and ask on.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import zenoh

from bridge.port import simulator_key
from bridge.relay_traffic import DOWN, RelayTraffic
from edge_runtime.latency.model import LatencySpec
from edge_runtime.transport import only_own, open_session
from edge_runtime.wire import key

REARM = "rearm"
QUERIES = ("status", REARM)
QUERY_S = 2.0
"""As long as the operator's commands wait for an answer."""


class Relay:
    """Carries one vehicle's topics between two Zenoh sessions."""

    def __init__(
        self,
        to_edge: zenoh.Session,
        to_simulator: zenoh.Session,
        vehicle_id: str,
        spec: LatencySpec,
        seed: int,
    ) -> None:
        self.queries = dict.fromkeys(QUERIES, 0)
        self._edge, self._simulator, self._vehicle_id = to_edge, to_simulator, vehicle_id
        self._lock = threading.Lock()
        self._mirrored: dict[str, Any] = {}
        publishers = {"state": self._publisher(to_edge, "state", express=False)}
        for topic in DOWN:
            publishers[topic] = self._publisher(to_simulator, topic, express=True)
        self._declared: list[Any] = list(publishers.values())
        self.traffic = RelayTraffic(
            spec, seed, {topic: publisher.put for topic, publisher in publishers.items()}
        )
        self._listen()

    def close(self) -> None:
        """Undeclare all, then stop the delay lines. The sessions are the caller's."""
        for declared in reversed(self._declared):
            declared.undeclare()
        # Nobody changes these any more: their listeners went first.
        for token in self._mirrored.values():
            token.undeclare()
        self.traffic.close()

    def _publisher(self, session: zenoh.Session, topic: str, express: bool) -> Any:
        # As the ends themselves publish: nobody is held up by a slow listener.
        return session.declare_publisher(
            key(self._vehicle_id, topic),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME if express else zenoh.Priority.DATA,
            express=express,
        )

    def _listen(self) -> None:
        self._declared.append(self._hear(self._simulator, "state"))
        for topic in DOWN:
            self._declared.append(self._hear(self._edge, topic))
        for topic in QUERIES:
            self._declared.append(self._answer(topic))
        self._mirror(self._edge, self._simulator, key(self._vehicle_id, "alive"))
        self._mirror(self._simulator, self._edge, simulator_key(self._vehicle_id))

    def _hear(self, session: zenoh.Session, topic: str) -> Any:
        take = self.traffic.handler(topic)
        own = key(self._vehicle_id, topic)
        hear = only_own(own, lambda sample: take(sample.payload.to_bytes()))
        return session.declare_subscriber(own, hear)

    def _answer(self, topic: str) -> Any:
        """Ask the edge runtime what the simulator's side asks; the query ends when it is freed."""
        asked = key(self._vehicle_id, topic)

        def came(query: zenoh.Query) -> None:
            # As the edge runtime itself: a look at everything (`phil/**`) re-arms nobody.
            if topic == REARM and str(query.key_expr) != asked:
                return
            with self._lock:
                self.queries[topic] += 1

            def replied(reply: zenoh.Reply) -> None:
                if reply.ok is not None:
                    query.reply(asked, reply.ok.payload, encoding=reply.ok.encoding)

            self._edge.get(asked, handler=replied, timeout=QUERY_S)

        return self._simulator.declare_queryable(asked, came)

    def _mirror(self, seen_by: zenoh.Session, shown_to: zenoh.Session, token_key: str) -> None:
        """Show a liveliness token on the other side for as long as it is seen on this one."""

        def changed(sample: zenoh.Sample) -> None:
            with self._lock:
                token = self._mirrored.pop(token_key, None)
                if token is not None:
                    token.undeclare()
                if sample.kind == zenoh.SampleKind.PUT:
                    self._mirrored[token_key] = shown_to.liveliness().declare_token(token_key)

        self._declared.append(
            seen_by.liveliness().declare_subscriber(token_key, changed, history=True)
        )


@contextlib.contextmanager
def open_relay(
    listen: str, connect: str, vehicle_id: str, spec: LatencySpec, seed: int
) -> Iterator[Relay]:
    """Listen for the edge runtime and connect to the simulator; UserError for a busy port."""
    with (
        contextlib.closing(open_session(listen=listen, mode="router")) as to_edge,
        contextlib.closing(open_session(connect=connect, mode="peer")) as to_simulator,
        contextlib.closing(Relay(to_edge, to_simulator, vehicle_id, spec, seed)) as relay,
    ):
        yield relay
