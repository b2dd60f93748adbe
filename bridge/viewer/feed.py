"""What a viewer hears: one Zenoh client, every topic of one vehicle, through a bounded queue.

Zenoh's threads only put into the queue; a viewer that falls behind loses messages and never
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

from bridge.port import simulator_key
from bridge.scene import scene_key
from edge_runtime.cli import UserError
from edge_runtime.tls import TlsFiles
from edge_runtime.transport import open_session
from edge_runtime.wire import check_vehicle_id, key

WIRE_TOPICS = ("state", "command", "feedback", "health")
RETRY_S = 0.2
TOKEN_S = 1.0
"""A simulator that is there has this time to say so, however short the wait asked for."""
QUEUE_MESSAGES = 2000
"""About a minute of real time, all topics together."""


class Heard(NamedTuple):
    """One message as it arrived here."""

    topic: str
    payload: bytes
    arrived_ns: int
    """This process's wall clock."""


class Feed:
    """The messages of one vehicle in order of arrival, and whether its simulator is there."""

    def __init__(self) -> None:
        self.simulator_gone = threading.Event()
        self.simulator_seen = threading.Event()
        self.dropped = 0
        self._queue: queue.Queue[Heard] = queue.Queue(QUEUE_MESSAGES)

    def next(self, timeout_s: float) -> Heard | None:
        """Return the next message, None if there is none within ``timeout_s``."""
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def hearer(self, topic: str) -> Callable[[zenoh.Sample], None]:
        """Return the subscriber callback of one topic."""

        def hear(sample: zenoh.Sample) -> None:
            try:
                self._queue.put_nowait(Heard(topic, sample.payload.to_bytes(), time.time_ns()))
            except queue.Full:
                self.dropped += 1

        return hear

    def watch(self, sample: zenoh.Sample) -> None:
        """Take a change of the simulator's liveliness token."""
        if sample.kind == zenoh.SampleKind.DELETE:
            self.simulator_gone.set()
        else:
            self.simulator_gone.clear()
            self.simulator_seen.set()


@contextlib.contextmanager
def open_feed(
    connect: str, vehicle_id: str, wait_s: float = 0.0, tls: TlsFiles | None = None
) -> Iterator[Feed]:
    """Listen to one vehicle; UserError if its simulator is not at ``connect`` within ``wait_s``."""
    check_vehicle_id(vehicle_id)
    give_up_s = time.monotonic() + wait_s
    session = _connect(connect, wait_s, tls)
    try:
        feed = Feed()
        keys = {topic: key(vehicle_id, topic) for topic in WIRE_TOPICS}
        keys["scene"] = scene_key(vehicle_id)
        declared = [session.declare_subscriber(keys[topic], feed.hearer(topic)) for topic in keys]
        liveliness = session.liveliness()
        token = simulator_key(vehicle_id)
        declared.append(liveliness.declare_subscriber(token, feed.watch, history=True))
        try:
            _wait_for_simulator(feed, give_up_s, vehicle_id, connect)
            yield feed
        finally:
            for subscriber in declared:
                subscriber.undeclare()
    finally:
        session.close()


def _wait_for_simulator(feed: Feed, give_up_s: float, vehicle_id: str, endpoint: str) -> None:
    """Without it, a view of a vehicle that is not there would never see it go, and never end."""
    if not feed.simulator_seen.wait(max(TOKEN_S, give_up_s - time.monotonic())):
        raise UserError(
            f"no simulator with vehicle id {vehicle_id} at {endpoint}; name it with --vehicle-id"
        )


def _connect(endpoint: str, wait_s: float, tls: TlsFiles | None) -> zenoh.Session:
    """Try again until the simulator listens: it and its viewer are often started together."""
    give_up_s = time.monotonic() + wait_s
    while True:
        try:
            return open_session(connect=endpoint, mode="client", tls=tls)
        except UserError:
            if time.monotonic() >= give_up_s:
                raise
            time.sleep(RETRY_S)
