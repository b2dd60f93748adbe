"""`python -m edge_runtime sense`, or `bridge sense`: a robot's own sensors replace the simulator.

A source's `observe()` returns an array, taken after the call, for each entry of the policy's
manifest. An observation that is too old is not sent. Any other fault ends the command: no state
comes, and the edge runtime stops as if the cable had been pulled. Needs the board's libraries only.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import queue
import sys
import threading
import time
from typing import Any, Callable, Dict, Mapping, NamedTuple, Optional

import msgspec
import numpy as np

from edge_runtime import transport, wire
from edge_runtime.cli import examples, sigterm_as_interrupt
from edge_runtime.config import add_flags, add_trust
from edge_runtime.manifest import Layout, Task
from edge_runtime.policy import load_manifest
from edge_runtime.safety import SILENCE_PERIODS, Event
from edge_runtime.util import UserError, load_named
from edge_runtime.wire import Command, Rejection, State

SOURCE_FAILED = 1  # exit status
# A camera's noise changes each picture: one that stays is frozen, or the lens is covered.
FROZEN_PERIODS = 5
GIVES_UP_S = 2.0  # without a state for this long the command ends: the vehicle stopped long ago
TELLS_S = 10.0  # between two lines that it waits for the first observation
ROUNDING_S = 1e-9
_POLL_S = 0.1  # a signal that another thread got does not wake the waiting main thread

EXAMPLE = examples("python -m edge_runtime sense --source my_camera:Camera --policy my.onnx")


class SourceError(UserError):
    """A fault of the source."""


class Seen(NamedTuple):
    """One observation of a source, encoded as in a state."""

    observation: Dict[str, bytes]
    speed_mps: Optional[float] = None
    episode_over: bool = False


def look(source: Any, task: Task) -> Seen:
    """Observe once. Raises SourceError for a wrong observation, and whatever the source raises."""
    observation = pack(task, source.observe())
    offered = (getattr(source, name, None) for name in ("speed_mps", "episode_over"))
    speed_mps, over = (each() if callable(each) else each for each in offered)
    return Seen(observation, None if speed_mps is None else float(speed_mps), bool(over))


def pack(task: Task, arrays: Any) -> Dict[str, bytes]:
    """Encode the arrays in the task's types, floats of any size. Raises SourceError for others."""
    if not isinstance(arrays, Mapping) or arrays.keys() != task.observation.keys():
        keys = map(str, arrays) if isinstance(arrays, Mapping) else [type(arrays).__name__]
        raise SourceError(f"it observes {', '.join(keys)}, not {', '.join(task.observation)}")
    packed = {}
    for name, entry in task.observation.items():
        array, dtype = np.asarray(arrays[name]), np.dtype(entry.dtype)
        fits = array.dtype == dtype or array.dtype.kind == dtype.kind == "f"
        if not fits or array.shape != tuple(entry.shape):
            found = f"{name} is {array.dtype} {list(array.shape)}"
            raise SourceError(f"{found}, not {entry.dtype} {entry.shape}")
        with np.errstate(over="ignore"):  # it becomes inf, which is refused
            packed[name] = array.astype(dtype).tobytes()
    return packed


class Intake:
    """Checks a source's observations and makes the states of one session; monotonic times.

    A state is stamped with the moment at which the source was asked. `observe` may take 2.2 T (the
    edge runtime answers no older state), but not more than T twice in a row.
    """

    def __init__(self, task: Task, session: str, zero_ns: int) -> None:
        self._task, self._layout, self._session = task, Layout(task), session
        self._zero_ns = zero_ns  # the wall clock at monotonic 0: stamps never leap
        self._episode = self._step = self._unchanged = 0
        # An episode's first state must come within T: the edge runtime measures lag against it.
        self._was_slow = True
        self._pictures: Dict[str, bytes] = {}

    def take(self, seen: Seen, asked_s: float, now_s: float) -> Optional[State]:
        """Return the state to send now; None if it is too old.

        Raises SourceError for numbers that are not finite, and for a picture that has frozen.
        """
        self._watch(seen.observation)
        period_s, periods = self._task.control_period_s, 1.0 if self._was_slow else SILENCE_PERIODS
        took_s = now_s - asked_s - ROUNDING_S
        self._was_slow = took_s > period_s
        if took_s > periods * period_s:
            return None
        state = State(
            session=self._session, episode=self._episode, step=self._step,
            sim_time_s=round(self._step * period_s, 6), speed_mps=seen.speed_mps,
            sent_ns=self._zero_ns + round(asked_s * 1e9), final=seen.episode_over,
            observation=seen.observation, task=self._layout.task_text,
        )  # fmt: skip
        # The same check as in the edge runtime.
        decoded = self._layout.decode(wire.encode(state))
        if isinstance(decoded, Rejection):
            raise SourceError(decoded.detail)
        self._step += 1
        if seen.episode_over:
            self._episode, self._step, self._was_slow = self._episode + 1, 0, True
        return state

    def _watch(self, observation: Dict[str, bytes]) -> None:
        """Raise SourceError where no picture has changed for FROZEN_PERIODS."""
        entries = self._task.observation.items()
        names = [name for name, entry in entries if entry.dtype == "uint8" and len(entry.shape) > 1]
        pictures = {name: observation[name] for name in names}
        same = bool(pictures) and pictures == self._pictures
        self._unchanged, self._pictures = (self._unchanged + 1 if same else 0), pictures
        if self._unchanged >= FROZEN_PERIODS:
            raise SourceError(f"no picture has changed in {FROZEN_PERIODS} periods: frozen")


class _Source:
    """Calls a source in a thread of its own: at the start once, then once for each `ask`.

    So a source that hangs blocks neither the loop nor ^C (unless it holds the interpreter).
    """

    def __init__(self, make: Callable[[], Any], task: Task) -> None:
        self._requests: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
        threading.Thread(target=self._run, args=(make, task), daemon=True).start()

    def ask(self) -> None:
        self._requests.put(None)

    def answer(self, until_s: float = math.inf) -> Optional[Seen]:
        """Wait for the answer; None if none comes in time. Raises SourceError."""
        while True:
            left_s = until_s - time.monotonic()
            with contextlib.suppress(queue.Empty):
                reply = self._replies.get(timeout=min(max(left_s, 0.0), _POLL_S))
                if isinstance(reply, BaseException):
                    name = "" if isinstance(reply, SourceError) else f"{type(reply).__name__}: "
                    raise SourceError(f"{name}{reply}")
                return reply
            if left_s <= 0.0:
                return None

    def _run(self, make: Callable[[], Any], task: Task) -> None:
        try:
            source = make()
            while True:
                self._replies.put(look(source, task))
                self._requests.get()
        except BaseException as error:  # foreign code; the main thread reports it
            self._replies.put(error)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    place = "the source: a class with observe() -> {entry: array}; may have speed_mps, episode_over"
    add("--source", metavar="MODULE:CLASS", required=True, help=place)
    text = "the policy that is to drive; its manifest names the observation and the period"
    add("--policy", metavar="POLICY.onnx", type="path", required=True, help=text)
    add_trust(parser)
    where = parser.add_mutually_exclusive_group()
    form: Any = {"metavar": "PROTOCOL/HOST:PORT", "type": transport.check_endpoint}
    here = "endpoint on which edge runtimes and viewers connect"
    where.add_argument("--listen", **form, default=transport.DEFAULT_ENDPOINT, help=here)
    where.add_argument("--connect", **form, help="connect to this router instead of listening")
    add_flags(parser, "tls", "vehicle_id")


def run(arguments: argparse.Namespace) -> int:
    """Send what the source observes until ^C, or until it fails (status 1)."""
    vehicle_id, where = arguments.vehicle_id or wire.DEFAULT_VEHICLE_ID, arguments.source
    tls = transport.tls_for(arguments.tls, arguments.connect or arguments.listen)
    manifest = load_manifest(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    task = Task(**{name: getattr(manifest, name) for name in Task.__struct_fields__})
    with sigterm_as_interrupt():  # and again below, because the import may change the handlers
        make = load_named(where, "source")
    place = (arguments.listen, vehicle_id, tls, arguments.connect)
    opened = transport.open_simulator(transport.SimulatorEnd, *place)
    with sigterm_as_interrupt(), opened as end:
        try:
            source = _Source(make, task)
            # The first observation is not sent: a camera takes its time to open.
            while source.answer(time.monotonic() + TELLS_S) is None:
                print(f"waiting: {where} has observed nothing yet", flush=True)
            print(f"ready vehicle_id={vehicle_id} source={where}", flush=True)
            _sense(source, end, task)
        except SourceError as error:
            # Printed at once, before anything is closed.
            stops = f"{error}; nothing is sent any more, so the vehicle stops"
            print(f"error: {where} has failed: {stops}", file=sys.stderr, flush=True)
    return SOURCE_FAILED


def _sense(source: _Source, end: transport.SimulatorEnd, task: Task) -> None:
    """Send a state each period until the source fails: SourceError."""
    intake = Intake(task, end.session, time.time_ns() - time.monotonic_ns())
    newest = [("", "")]  # mode and reason of the newest command

    def hear(payload: bytes) -> None:
        command = wire.decode_command(payload)
        if isinstance(command, Command) and command.session == end.session:
            newest[0] = command.mode, command.reason

    end.hear("command", hear)
    printed, next_s, sent_s = newest[0], time.monotonic(), time.monotonic()
    while True:
        time.sleep(max(0.0, next_s - time.monotonic()))
        asked_s = time.monotonic()
        next_s = max(next_s + task.control_period_s, asked_s)
        source.ask()
        seen = source.answer(sent_s + GIVES_UP_S)
        if seen is None:
            raise SourceError(f"observe() hangs, or is too slow: no state for {GIVES_UP_S:g} s")
        now_s = time.monotonic()
        if (state := intake.take(seen, asked_s, now_s)) is None:
            print(f"too old: observe() took {now_s - asked_s:.2f} s; it is not sent", flush=True)
        else:
            place = {name: getattr(state, name) for name in ("episode", "step", "sim_time_s")}
            end.scenes.put(msgspec.msgpack.encode({**place, "task": task}))  # for viewers
            end.publish_state(wire.encode(state))
            sent_s = now_s
        if newest[0] != printed:
            printed = newest[0]
            print(f"the edge runtime says {' '.join(printed).strip()}", flush=True)
        if printed[1] == Event.OTHER_TASK.value:
            raise UserError(f"the edge runtime's policy is for another task than {task.task!r}")
