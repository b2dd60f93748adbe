"""Publishers and subscribers of ROS 2 messages on a Zenoh session, announced as a bridge does."""

from __future__ import annotations

import contextlib
from typing import Any, Callable, Dict, Iterator, List, Type, TypeVar

import zenoh

from edge_runtime.messages import Reason, Rejection
from edge_runtime.ros2 import cdr, names
from edge_runtime.ros2.messages import AckermannDriveStamped, Image, Odometry, Twist
from edge_runtime.transport import only_own

_M = TypeVar("_M", AckermannDriveStamped, Twist, Odometry, Image)


class Ros2Node:
    """Uses a session that somebody else opens and closes. `close` it before the session.

    `rejected` counts what arrived and could not be read, by reason; `sent` what was published, by
    key.
    """

    def __init__(self, session: zenoh.Session, namespace: str) -> None:
        self.rejected: Dict[str, int] = {}
        self.sent: Dict[str, int] = {}
        self._session = session
        self._namespace = namespace
        self._zid = str(session.info.zid())
        self._declared: List[Any] = []
        self._announce(names.member_token(self._zid))

    def publisher(self, topic: str, kind: Type[_M]) -> Callable[[_M], None]:
        """What publishes messages of that kind on that topic. It never waits for a subscriber."""
        key = names.key(self._namespace, topic)
        publisher = self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP
        )
        self._declared.append(publisher)
        self._announce_topic(names.PUBLISHER, key, kind, names.RELIABLE)
        self.sent[key] = 0

        def publish(message: _M) -> None:
            publisher.put(cdr.encode(message))
            self.sent[key] += 1

        return publish

    def subscribe(self, topic: str, kind: Type[_M], take: Callable[[_M], None]) -> None:
        """Call `take` with each message, in Zenoh's thread; what cannot be read is counted."""
        key = names.key(self._namespace, topic)

        def hear(sample: zenoh.Sample) -> None:
            # Something huge is not copied to be counted.
            if len(sample.payload) > cdr.MAX_PAYLOAD_BYTES:
                self._count(Reason.OVERSIZED)
                return
            message = cdr.decode(sample.payload.to_bytes(), kind)
            if isinstance(message, Rejection):
                self._count(message.reason)
            else:
                take(message)

        self._declared.append(self._session.declare_subscriber(key, only_own(key, hear)))
        self._announce_topic(names.SUBSCRIBER, key, kind, names.BEST_EFFORT)

    def close(self) -> None:
        """Withdraw everything; safe to call twice."""
        while self._declared:
            self._declared.pop().undeclare()

    def _announce_topic(self, role: str, key: str, kind: Any, qos: names.Qos) -> None:
        type_name = str(kind.__idl_typename__)
        self._announce(names.topic_token(self._zid, role, key, type_name, qos))

    def _announce(self, token: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(token))

    def _count(self, reason: Reason) -> None:
        self.rejected[reason.value] = self.rejected.get(reason.value, 0) + 1


@contextlib.contextmanager
def open_node(session: zenoh.Session, namespace: str) -> Iterator[Ros2Node]:
    """A node for the length of a block."""
    node = Ros2Node(session, namespace)
    try:
        yield node
    finally:
        node.close()
