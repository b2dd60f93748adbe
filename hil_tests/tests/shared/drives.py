"""The processes of a drive, and the simulator's end of the wire in the test."""

from __future__ import annotations

import itertools
import json
import queue
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from edge_runtime import wire
from edge_runtime.link import ask
from edge_runtime.transport import open_session
from edge_runtime.wire import Command, Feedback, Health, State
from hil_tests.processes import PATIENCE_S, Process, wait_until
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import T, write_policy

TOY, SLOW_TOY = (
    f"hil_tests.tests.shared.environments:{name}-v0" for name in ("BridgeToy", "BridgeToySlow")
)
LEFT_TURN = Path(__file__).parents[2] / "recordings" / "left_turn.mcap"


def make_policy(folder: Path, kind: str = "mean", value: float = 0.3) -> Path:
    """Write an unsigned policy file."""
    path = folder / f"{kind}{value:g}.onnx"
    write_policy(path, kind, value)
    return path


def run_edge(*arguments: str, **options: Any) -> Process:
    """Start ``python -m edge_runtime run``, and wait until it is ready."""
    return Process("edge_runtime", "run", *arguments, ready="ready ", **options)


def start_edge(endpoint: str, policy: object, *arguments: str) -> Process:
    """Start an edge runtime with an unsigned test policy, and wait until it is ready."""
    trust = ("--policy", str(policy), "--allow-unsigned")
    return run_edge(*trust, "--connect", endpoint, *arguments)


def start_simulate(endpoint, out, env, *options, **more) -> Process:
    fixed = ["simulate", "--env", env, "--listen", endpoint, "--out", str(out)]
    return Process("bridge", *fixed, *options, **more)


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


class Simulator:
    """The simulator's end of the wire: a router that sends states and keeps what comes back."""

    def __init__(self, endpoint: str, vehicle_id: str = "hunter01") -> None:
        self.endpoint, self.vehicle_id = endpoint, vehicle_id
        self.commands: queue.Queue[Command] = queue.Queue()
        self.health: list[Health] = []
        self.feedback: list[Feedback] = []
        self.steps = itertools.count()
        self._session = open_session(listen=endpoint, mode="router")
        self.alive = threading.Event()
        alive, tokens = wire.key(vehicle_id, "alive"), self._session.liveliness()
        self._subscribers = [tokens.declare_subscriber(alive, self._note_alive, history=True)]
        for topic, decode, keep in (
            ("command", wire.decode_command, self.commands.put),
            ("health", wire.decode_health, self.health.append),
            ("feedback", wire.decode_feedback, self.feedback.append),
        ):
            hear = partial(self._keep, decode, keep)
            key = wire.key(vehicle_id, topic)
            self._subscribers.append(self._session.declare_subscriber(key, hear))

    def wait_for_edge(self) -> None:
        assert self.alive.wait(PATIENCE_S), "no edge runtime came"
        wait_until(lambda: self.health, "a health message")

    def send(self, state: Any, key: str = "") -> None:
        """Publish a State, or bytes as they are; all arrive, on however busy a machine."""
        payload = state if isinstance(state, bytes) else wire.encode(state)
        key = key or wire.key(self.vehicle_id, "state")
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def ask(self, state: State, timeout_s: float = PATIENCE_S) -> Command:
        """Send a state and wait for the command that answers it, dropping all before."""
        self.send(state)
        end_s = time.monotonic() + timeout_s
        while True:
            command = self.commands.get(timeout=max(0.001, end_s - time.monotonic()))
            place = (command.session, command.episode, command.step)
            if place == (state.session, state.episode, state.step):
                return command

    def drive_until(
        self, holds: Callable[[], Any], what: str, rearms: bool = False, **changes: Any
    ) -> None:
        """Answered states at 10 Hz; an operator beside it re-arms where that is asked."""

        def does_after_a_state() -> Any:
            self.ask(make_state(next(self.steps), **changes))
            if rearms and self.health[-1].needs_rearm:
                self.query("rearm")
            time.sleep(T)
            return holds()

        wait_until(does_after_a_state, what)

    def next_command(self) -> Command:
        return self.commands.get(timeout=PATIENCE_S)

    def drain(self) -> list[Command]:
        return [self.commands.get_nowait() for _ in range(self.commands.qsize())]

    def query(self, topic: str) -> dict[str, Any]:
        """The status or rearm query, as an operator's command asks it."""
        return ask(self.endpoint, self.vehicle_id, topic)

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *_: object) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._session.close()

    def _keep(self, decode: Callable, keep: Callable, sample: Any) -> None:
        message = decode(bytes(sample.payload))
        assert not isinstance(message, wire.Rejection), message
        keep(message)

    def _note_alive(self, sample: Any) -> None:
        (self.alive.set if str(sample.kind).endswith("PUT") else self.alive.clear)()
