"""Real processes and real Zenoh sessions for the tests: an edge runtime and a simulator's end."""

from __future__ import annotations

import itertools
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from edge_runtime import wire
from edge_runtime.cli import run_cli
from edge_runtime.commands import ask
from edge_runtime.transport import open_session
from edge_runtime.wire import Command, Feedback, Health, State
from hil_tests.testing.policies import SIZE, T

# This machine may be busy: waits are long, and only what must never happen has a short limit.
PATIENCE_S = 20.0
BLACK, WHITE = 0, 255


def frames(level: int) -> dict[str, bytes]:
    """The observation of pictures that are grey throughout."""
    return {"frames": bytes([level]) * SIZE}


def make_state(step: int, **changes: Any) -> State:
    """A valid black state; `changes` replace its fields."""
    fields: dict[str, Any] = {
        "session": "simulator-a", "episode": 0, "step": step,
        "sim_time_s": step * 0.1, "sent_ns": time.time_ns(),
        "observation": frames(BLACK), "speed_mps": 1.0, "final": False,
    }  # fmt: skip
    return State(**{**fields, **changes})


def make_command(step: int = 0, **changes: Any) -> Command:
    """A valid command to drive; `changes` replace its fields."""
    fields: dict[str, Any] = {
        "session": "here", "episode": 0, "step": step, "mode": "drive", "action": [0.5],
        "policy_id": "p", "received_ns": 1, "inference_ns": 1, "sent_ns": 1,
    }  # fmt: skip
    return Command(**{**fields, **changes})


HEALTH = Health(
    vehicle_id="hunter01", vehicle="none", mode="standby", reason="", needs_rearm=False,
    accepted=0, superseded=0, rejected={}, deadline_misses=0, safe_stops=0, policy_id="p",
    inference_ms={}, uptime_s=0.0, sent_ns=0, command_ms={"p50": 1.5}, temperature_c=40.0,
    load_1min=0.5, rss_mb=90.0, rivals=1,
)  # fmt: skip


def wait_until(condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> Any:
    """Poll until the condition is true and return its value; fail with `what` otherwise."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        value = condition()
        if value:
            return value
        time.sleep(0.01)
    raise AssertionError(f"not within {timeout_s} s: {what}")


class CommandProcess:
    """``python -m`` with these arguments; killed at the end of the block if need be."""

    def __init__(
        self, *arguments: str, python: str = sys.executable, environment: Any = (), **options: Any
    ) -> None:
        pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        words, variables = [python, "-m", *arguments], {**os.environ, **dict(environment)}
        self.process: Any = subprocess.Popen(words, env=variables, **{**pipes, **options})

    def wait(self, timeout_s: float = 60.0) -> int:
        """The exit status; `output` and `errors` hold what it printed."""
        self.output, self.errors = self.process.communicate(timeout=timeout_s)
        return self.process.returncode

    def end(self) -> int:
        """SIGTERM, then the exit status."""
        self.process.terminate()
        return self.wait(PATIENCE_S)

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


class EdgeProcess(CommandProcess):
    """An edge runtime that has printed its first line."""

    def __init__(self, *arguments: str, **options: Any) -> None:
        super().__init__("edge_runtime", "run", *arguments, **options)
        self.ready_line = self.process.stdout.readline().strip()


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


def run_command(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "edge_runtime", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=cwd, check=False)


def exit_status(main: Callable[[list[str]], int], arguments: list[str]) -> int:
    """The status with which the command ends, also where argparse ends it."""
    try:
        return run_cli(main, arguments)
    except SystemExit as end:
        return int(end.code or 0)


def render_table(events, states, after):
    """A table of transitions as README.md shows it: a row for each event, a column a state."""
    rows = [
        ["event", *(f"in {state.value}" for state in states)],
        *([event.value, *(after(state, event).value for state in states)] for event in events),
    ]
    first, *others = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join((first, "|---" * len(rows[0]) + "|", *others))
