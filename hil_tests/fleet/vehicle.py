"""A vehicle's simulator reduced to its traffic: states at the control rate, and what comes back."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import zenoh

from edge_runtime import tls as access
from edge_runtime import wire
from edge_runtime.tls import load_tls
from edge_runtime.transport import open_session
from hil_tests.faults.sender import make_state

_SCENES = 16
"""Pictures of noise, made before the drive: making them costs more than sending."""


class LightSimulator:
    """Sends states under its vehicle's own certificate, and keeps the commands that answer them."""

    def __init__(self, vehicle_id: str, endpoint: str, certificates: Path, seed: int) -> None:
        self.vehicle_id = vehicle_id
        self.sent_s: dict[int, float] = {}
        """When each step was sent, monotonic s."""
        self.latency_s: dict[int, float] = {}
        """From state sent to command received, for each step that was answered, s."""
        self.foreign = 0
        """Messages of another vehicle. Each would be a hole in the access control."""
        self.message_bytes: dict[str, int] = {}
        """The payload of the last message, by topic."""
        self.last_command_s = 0.0
        self.step = 0
        self._name = f"fleet-{vehicle_id}"
        self._frames = [make_state(i, seed).frames for i in range(_SCENES)]
        tls = load_tls(certificates / access.common_name(access.SIMULATOR, vehicle_id))
        self._session = open_session(connect=endpoint, mode="client", tls=tls)
        self._own = f"phil/{vehicle_id}/"
        self._publisher = self._session.declare_publisher(
            wire.key(vehicle_id, "state"),
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )
        self._subscribers = [
            self._session.declare_subscriber(wire.key(vehicle_id, "command"), self._keep),
            self._session.declare_subscriber(wire.key(vehicle_id, "health"), self._look),
            # What it has no right to: nothing may come.
            self._session.declare_subscriber(
                "phil/**", self._look, allowed_origin=zenoh.Locality.REMOTE
            ),
        ]

    def send(self) -> None:
        """Publish the next state."""
        self.step += 1
        state = wire.State(
            session=self._name,
            episode=0,
            step=self.step,
            sim_time_s=self.step * wire.CONTROL_PERIOD_S,
            sent_ns=time.time_ns(),
            frames=self._frames[self.step % _SCENES],
            speed_mps=3.0,
            final=False,
        )
        payload = wire.encode(state)
        self.message_bytes["state"] = len(payload)
        self.sent_s[self.step] = time.monotonic()
        self._publisher.put(payload)

    def begin(self) -> None:
        """Forget the numbers so far: the measurement begins."""
        self.sent_s, self.latency_s = {}, {}

    def close(self) -> None:
        """Leave the wire."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._publisher.undeclare()
        self._session.close()

    def _keep(self, sample: Any) -> None:
        now_s = time.monotonic()
        command = wire.decode_command(bytes(sample.payload))
        if isinstance(command, wire.Rejection) or command.session != self._name:
            self.foreign += 1
            return
        self.message_bytes["command"] = len(bytes(sample.payload))
        self.last_command_s = now_s
        sent_s = self.sent_s.get(command.step)
        if command.mode == wire.DRIVE and sent_s is not None:
            self.latency_s.setdefault(command.step, now_s - sent_s)

    def _look(self, sample: Any) -> None:
        key = str(sample.key_expr)
        self.foreign += not key.startswith(self._own)
        self.message_bytes[key.rpartition("/")[2]] = len(bytes(sample.payload))


class Fleet:
    """Drives the simulators from one thread, each at its own moment of the control period."""

    def __init__(self, simulators: list[LightSimulator]) -> None:
        self._simulators = simulators
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)

    def __enter__(self) -> Fleet:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        begin_s, period_s = time.monotonic(), wire.CONTROL_PERIOD_S
        tick, count = 0, len(self._simulators)
        while True:
            due_s = begin_s + tick * period_s / count
            if self._stopping.wait(max(0.0, due_s - time.monotonic())):
                return
            self._simulators[tick % count].send()
            tick += 1
