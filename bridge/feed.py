"""What a listener hears: one Zenoh client, every topic, through a bounded queue.

Zenoh's threads only put into the queue; a listener that falls behind loses messages and never
holds up the vehicle.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import zenoh

from edge_runtime import tls as access
from edge_runtime.tls import TlsFiles
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_PAYLOAD_BYTES, check_vehicle_id

WIRE_TOPICS = ("state", "command", "feedback", "health", "scene")
TOKEN_TOPICS = ("alive", "simulator")
"""Liveliness tokens: of the edge runtime, and of the simulator (extension)."""
ANY_VEHICLE = "*"
RETRY_S = 0.2
TOKEN_S = 1.0
"""A simulator that is there has this time to say so, however short the wait asked for."""
QUEUE_MESSAGES = 2000
"""About a minute of real time, all topics together."""


class Heard(NamedTuple):
    """One message, or one change of a liveliness token, as it arrived here."""

    key: str
    topic: str
    payload: bytes
    """Of a token: 1 byte, 1 where it has come, 0 where it has gone."""
    arrived_ns: int
    """This process's clock: the wall's at the start, then monotonic, so that it never goes back."""
    size: int
    """Bytes on the wire; a payload over the contract's limit is not kept."""


class Feed:
    """The messages in order of arrival, and whether their simulators are there."""

    def __init__(self) -> None:
        self.simulator_gone = threading.Event()
        self.simulator_seen = threading.Event()
        self.dropped = 0
        self._simulators: set[str] = set()
        self._queue: queue.Queue[Heard] = queue.Queue(QUEUE_MESSAGES)
        self._zero_ns = time.time_ns() - time.monotonic_ns()

    @property
    def waiting(self) -> int:
        """Return how many messages wait in the queue."""
        return self._queue.qsize()

    def next(self, timeout_s: float) -> Heard | None:
        """Return the next message, None if there is none within ``timeout_s``."""
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def now_ns(self) -> int:
        """Return the clock of ``Heard.arrived_ns``."""
        return self._zero_ns + time.monotonic_ns()

    def hearer(self, topic: str) -> Callable[[zenoh.Sample], None]:
        """Return the subscriber callback of one topic."""

        def hear(sample: zenoh.Sample) -> None:
            if "*" in str(sample.key_expr):
                return  # put to many vehicles at once: it is nobody's own
            size = len(sample.payload)
            # A flood of huge messages must not fill the memory.
            payload = sample.payload.to_bytes() if size <= MAX_PAYLOAD_BYTES else b""
            self._put(Heard(str(sample.key_expr), topic, payload, self.now_ns(), size))

        return hear

    def watch(self, topic: str) -> Callable[[zenoh.Sample], None]:
        """Return the subscriber callback of one kind of token."""

        def change(sample: zenoh.Sample) -> None:
            key, here = str(sample.key_expr), sample.kind != zenoh.SampleKind.DELETE
            if topic == "simulator":
                self._note_simulator(key, here)
            self._put(Heard(key, topic, bytes([here]), self.now_ns(), 1))

        return change

    def _note_simulator(self, key: str, here: bool) -> None:
        if here:
            self._simulators.add(key)
            self.simulator_gone.clear()
            self.simulator_seen.set()
            return
        self._simulators.discard(key)
        if not self._simulators:
            self.simulator_gone.set()

    def _put(self, heard: Heard) -> None:
        try:
            self._queue.put_nowait(heard)
        except queue.Full:
            self.dropped += 1


@contextlib.contextmanager
def open_feed(
    connect: str, vehicle_id: str, wait_s: float = 0.0, tls: TlsFiles | None = None
) -> Iterator[Feed]:
    """Listen to one vehicle, or to ANY_VEHICLE.

    UserError if no simulator for it is at ``connect`` within ``wait_s``, and for a certificate that
    may not listen: from here that would look the same.
    """
    if tls is not None:
        access.check_name(tls.name, access.VIEWER)
    if vehicle_id != ANY_VEHICLE:
        check_vehicle_id(vehicle_id)
    give_up_s = time.monotonic() + wait_s
    session = connect_client(connect, wait_s, tls)
    try:
        feed = Feed()
        declared = [
            session.declare_subscriber(f"phil/{vehicle_id}/{topic}", feed.hearer(topic))
            for topic in WIRE_TOPICS
        ]
        liveliness = session.liveliness()
        for topic in TOKEN_TOPICS:
            token = f"phil/{vehicle_id}/{topic}"
            declared.append(liveliness.declare_subscriber(token, feed.watch(topic), history=True))
        try:
            _wait_for_simulator(feed, give_up_s, vehicle_id, connect)
            yield feed
        finally:
            for subscriber in declared:
                subscriber.undeclare()
    finally:
        session.close()


def _wait_for_simulator(feed: Feed, give_up_s: float, vehicle_id: str, endpoint: str) -> None:
    """Without it, a listener to a vehicle that is not there would never see it go, nor end."""
    if not feed.simulator_seen.wait(max(TOKEN_S, give_up_s - time.monotonic())):
        if vehicle_id == ANY_VEHICLE:
            raise UserError(f"no simulator at {endpoint}; start one: python -m bridge simulate")
        raise UserError(
            f"no simulator with vehicle id {vehicle_id} at {endpoint}; name it with --vehicle-id"
        )


def connect_client(endpoint: str, wait_s: float, tls: TlsFiles | None = None) -> zenoh.Session:
    """Open a client; try again for ``wait_s``: both ends are often started together."""
    give_up_s = time.monotonic() + wait_s
    while True:
        try:
            return open_session(connect=endpoint, mode="client", tls=tls)
        except UserError:
            if time.monotonic() >= give_up_s:
                raise
            time.sleep(RETRY_S)
