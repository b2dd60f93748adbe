"""The simulator's end of the wire: a thin shell around one Zenoh session."""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import zenoh

from bridge.edge_counts import EdgeCounts
from bridge.environments import scene_of
from bridge.feed import connect_client
from bridge.scene import Stamps, encode_scene, scene_key
from edge_runtime import tls as access
from edge_runtime.policy_file import Manifest
from edge_runtime.tls import TlsFiles
from edge_runtime.transport import only_own, open_session
from edge_runtime.util import UserError
from edge_runtime.wire import key

PayloadHandler = Callable[[bytes], None]
EDGE_POLL_S = 0.1
QUERY_S = 1.0


class _Status(msgspec.Struct):
    """What is needed of the answer to the status query."""

    manifest: Manifest


def simulator_key(vehicle_id: str) -> str:
    """Return the liveliness key by which viewers see that the simulator is there (extension)."""
    return f"phil/{vehicle_id}/simulator"


class SimulatorPort:
    """Publishes states and scenes, hands on commands, and sees whether an edge runtime lives."""

    def __init__(self, zenoh_session: zenoh.Session, vehicle_id: str) -> None:
        self.session = secrets.token_hex(8)
        self._zenoh = zenoh_session
        self.vehicle_id = vehicle_id
        # DROP: a slow listener must never hold up the simulation.
        drop = zenoh.CongestionControl.DROP
        self._states = zenoh_session.declare_publisher(
            key(vehicle_id, "state"), congestion_control=drop
        )
        self._scenes = zenoh_session.declare_publisher(
            scene_key(vehicle_id), congestion_control=drop
        )
        self._token = zenoh_session.liveliness().declare_token(simulator_key(vehicle_id))
        self._commands: Any = None
        self._feedback: Any = None
        self.edge_counts = EdgeCounts()
        self._health = self._subscribe("health", self.edge_counts.observe_message)

    def on_command(self, handler: PayloadHandler) -> None:
        """Call ``handler(payload)`` for every command, on Zenoh's thread: it must be quick."""
        self._commands = self._subscribe("command", handler)

    def on_feedback(self, handler: PayloadHandler) -> None:
        """Call ``handler(payload)`` for every feedback of the vehicle, as ``on_command`` does."""
        self._feedback = self._subscribe("feedback", handler)

    def _subscribe(self, topic: str, handler: PayloadHandler) -> Any:
        own = key(self.vehicle_id, topic)
        hear = only_own(own, lambda sample: handler(sample.payload.to_bytes()))
        return self._zenoh.declare_subscriber(own, hear)

    def publish_state(self, payload: bytes) -> None:
        """Send an encoded state to the edge runtime (and to viewers)."""
        self._states.put(payload)

    def publish_scene(self, environment: Any, stamps: Stamps) -> None:
        """Send the scene, if the environment has one and anybody is listening."""
        somebody: Any = self._scenes.matching_status
        if not somebody.matching:
            return
        scene = scene_of(environment)
        if scene is not None:
            self._scenes.put(encode_scene(scene, stamps))

    def wait_for_edge(self, limit_s: float, endpoint: str) -> None:
        """Wait until an edge runtime for this vehicle is there; UserError after ``limit_s``."""
        give_up_s = time.monotonic() + limit_s
        while not self._edge_is_there():
            if time.monotonic() >= give_up_s:
                raise UserError(
                    f"no edge runtime after {limit_s:g} s; start one: python -m edge_runtime run "
                    f"--policy POLICY.onnx --connect {endpoint} --vehicle-id {self.vehicle_id}"
                )
            time.sleep(EDGE_POLL_S)

    def note_edge_counts(self) -> None:
        """Ask the edge runtime for its counts now: before and after the drive."""
        for reply in self._status_replies():
            if reply.ok is not None:
                self.edge_counts.observe_status(reply.ok.payload.to_bytes())

    def edge_policy_id(self) -> str:
        """Return the policy that the edge runtime says it drives; empty if it says nothing."""
        self.note_edge_counts()
        return self.edge_counts.policy_id

    def edge_manifest(self) -> Manifest | None:
        """Return the manifest of the edge runtime's policy; None if it says nothing."""
        for reply in self._status_replies():
            if reply.ok is not None:
                with contextlib.suppress(msgspec.MsgspecError, ValueError, RecursionError):
                    status = msgspec.json.decode(reply.ok.payload.to_bytes(), type=_Status)
                    return status.manifest
        return None

    def _edge_is_there(self) -> bool:
        """Its token is seen, or it answers: the board's Zenoh can lose the token for a while."""
        alive = key(self.vehicle_id, "alive")
        tokens = self._zenoh.liveliness().get(alive, timeout=QUERY_S)
        return any(reply.ok for reply in tokens) or any(
            reply.ok for reply in self._status_replies()
        )

    def _status_replies(self) -> Any:
        return self._zenoh.get(key(self.vehicle_id, "status"), timeout=QUERY_S)

    def close(self) -> None:
        """Undeclare everything: a callback left open hangs the process at its end."""
        callbacks = (self._commands, self._feedback, self._health)
        for declared in (*callbacks, self._token, self._scenes, self._states):
            if declared is not None:
                declared.undeclare()


@contextlib.contextmanager
def open_port(
    listen: str | None,
    vehicle_id: str,
    tls: TlsFiles | None = None,
    connect: str | None = None,
    wait_s: float = 0.0,
) -> Iterator[SimulatorPort]:
    """Listen at ``listen`` for the edge runtime, or share the router at ``connect`` with others.

    With ``tls``, every other party has the rights of its certificate's name and no more; behind a
    router it is the router that sees to that.
    UserError if the port is busy, or if no router answers within ``wait_s``.
    """
    rules = None
    if tls is not None:
        able = (access.ROUTER,) if connect is None else ()
        access.check_name(tls.name, access.common_name(access.SIMULATOR, vehicle_id), *able)
        rules = access.rules_for_listener([vehicle_id])
    # Behind a router a client: two peers there would not hear one another.
    if connect is not None:
        zenoh_session = connect_client(connect, wait_s, tls)
    else:
        zenoh_session = open_session(listen=listen, mode="router", tls=tls, access=rules)
    try:
        port = SimulatorPort(zenoh_session, vehicle_id)
        try:
            yield port
        finally:
            port.close()
    finally:
        zenoh_session.close()
