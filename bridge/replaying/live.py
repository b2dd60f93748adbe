"""Recorded states to a running edge runtime, at the pace of the recording."""

from __future__ import annotations

import queue
import secrets
import time
from collections.abc import Callable

import msgspec

from bridge.port import SimulatorPort
from bridge.replaying.in_process import Answers
from bridge.replaying.recorded import Answer, Key, RecordedDrive, RecordedState, key_of
from edge_runtime.safety import SILENCE_S
from edge_runtime.wire import Command, decode_command, encode

OnState = Callable[[int], None]
"""Called with the number of states published so far."""


def replay_live(drive: RecordedDrive, port: SimulatorPort, on_state: OnState) -> Answers:
    """Publish every answered state and return what comes back.

    Each waits for its moment, and for the answer to the one before (2 T at most): a runtime that
    is slower than the recorded one is asked later, not less. Every recorded session becomes a
    fresh one, which the runtime has never heard of.
    """
    return _Live(drive, port, on_state).run()


class _Live:
    def __init__(self, drive: RecordedDrive, port: SimulatorPort, on_state: OnState) -> None:
        self._drive = drive
        self._port = port
        self._on_state = on_state
        self._inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._sessions: dict[str, str] = {}
        self._answers: Answers = {}

    def run(self) -> Answers:
        self._port.on_command(self._inbox.put)
        zero_s: float | None = None
        last_s = 0.0
        for number, recorded in enumerate(self._drive.answered(), start=1):
            if zero_s is None:
                zero_s = time.monotonic() - recorded.exchange.arrived_s
            self._listen_until(zero_s + recorded.exchange.arrived_s)
            self._publish(recorded)
            zero_s = max(zero_s, time.monotonic() - recorded.exchange.finished_s)
            last_s = recorded.exchange.last_s
            self._on_state(number)
        self._listen_until((zero_s or 0.0) + last_s)
        return self._answers

    def _publish(self, recorded: RecordedState) -> None:
        state, key = recorded.state, key_of(recorded.state)
        fresh = self._sessions.setdefault(state.session, secrets.token_hex(8))
        sent = msgspec.structs.replace(state, session=fresh, sent_ns=time.time_ns())
        self._port.publish_state(encode(sent))
        give_up_s = time.monotonic() + SILENCE_S
        while key not in self._answers and time.monotonic() < give_up_s:
            self._take(give_up_s)

    def _listen_until(self, end_s: float) -> None:
        while time.monotonic() < end_s:
            self._take(end_s)

    def _take(self, until_s: float) -> None:
        """Take one command, if one comes before ``until_s`` (monotonic)."""
        try:
            payload = self._inbox.get(timeout=max(0.0, until_s - time.monotonic()))
        except queue.Empty:
            return
        command = decode_command(payload)
        if isinstance(command, Command):
            self._note(command)

    def _note(self, command: Command) -> None:
        names = {fresh: recorded for recorded, fresh in self._sessions.items()}
        if command.session not in names:
            return
        key: Key = (names[command.session], command.episode, command.step)
        answers = self._answers.setdefault(key, [])
        answer = Answer(command.mode, command.reason, tuple(command.action))
        if not answers or answers[-1] != answer:
            answers.append(answer)
