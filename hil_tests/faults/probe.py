"""The probe: a Zenoh router between the two ends that stamps what passes.

It listens for the edge runtime and connects to the simulator, so that it hears the edge still
when the simulator is gone, and the other way round.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import zenoh

from edge_runtime import wire
from edge_runtime.transport import open_session
from hil_tests.faults.timeline import CommandSeen, Timeline


class Probe:
    """Fills a timeline; ``put`` sends anything on any key and loses nothing."""

    def __init__(
        self, listen: str, connect: str | None, vehicle_id: str, timeline: Timeline
    ) -> None:
        self.timeline = timeline
        self.health: list[wire.Health] = []
        self._vehicle_id = vehicle_id
        self._lock = threading.Lock()
        self._session = open_session(listen=listen, connect=connect, mode="router")
        # BLOCK: a message that the campaign says it sent has been sent.
        self._publishers = {
            topic: self._session.declare_publisher(
                wire.key(vehicle_id, topic),
                congestion_control=zenoh.CongestionControl.BLOCK,
                allowed_destination=zenoh.Locality.REMOTE,  # its own ears are for the others
            )
            for topic in ("state", "command", "feedback", "health")
        }
        handlers = {
            "state": self._on_state,
            "command": self._on_command,
            "health": self._on_health,
            "feedback": self._on_feedback,
        }
        self._declared: list[Any] = [
            self._session.declare_subscriber(wire.key(vehicle_id, topic), handler)
            for topic, handler in handlers.items()
        ]

    def put(self, topic: str, payload: bytes) -> None:
        """Send bytes as they are."""
        self._publishers[topic].put(payload)

    def rejected(self) -> dict[str, int]:
        """The edge runtime's counts of rejected states, by its newest health message."""
        return dict(self.health[-1].rejected) if self.health else {}

    def close(self) -> None:
        """Undeclare all, then close."""
        for declared in [*self._declared, *self._publishers.values()]:
            declared.undeclare()
        self._session.close()

    def note_state(self, payload: bytes, seen_s: float) -> None:
        """Remember a state that a policy may answer."""
        state = wire.decode_state(payload)
        if isinstance(state, wire.State):
            place = (state.session, state.episode, state.step)
            self.timeline.states.setdefault(place, seen_s)
            self.timeline.flow_s.append(seen_s)

    def _on_state(self, sample: zenoh.Sample) -> None:
        self.note_state(bytes(sample.payload), time.monotonic())

    def _on_command(self, sample: zenoh.Sample) -> None:
        seen_s, offset_ns = time.monotonic(), time.time_ns() - time.monotonic_ns()
        command = wire.decode_command(bytes(sample.payload))
        if isinstance(command, wire.Rejection):
            self.timeline.unreadable += 1
            return
        self.timeline.commands.append(
            CommandSeen(
                seen_s,
                (command.sent_ns - offset_ns) * 1e-9,
                (command.session, command.episode, command.step),
                command.mode,
                command.action,
                command.reason,
            )
        )

    def _on_feedback(self, sample: zenoh.Sample) -> None:
        seen_s = time.monotonic()
        self.timeline.feedback_s.append(seen_s)
        feedback = wire.decode_feedback(bytes(sample.payload))
        if isinstance(feedback, wire.Feedback):
            self.timeline.named += [(seen_s, words) for words in feedback.faults]

    def _on_health(self, sample: zenoh.Sample) -> None:
        health = wire.decode_health(bytes(sample.payload))
        if isinstance(health, wire.Health):
            self.health.append(health)
