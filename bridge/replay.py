"""``python -m bridge replay``: recorded states through another policy or runtime, compared.

In process the runtime's own decision logic is around the policy, and time comes from the recording
alone, so that two replays of one file are the same. A running edge runtime is asked at the pace of
the recording.
"""

from __future__ import annotations

import queue
import secrets
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from bridge.commands import add_tls, add_wait_edge, count_bar
from bridge.ports import SimulatorPort, open_port
from bridge.recorded import (
    JUST_AFTER_S,
    Answer,
    Exchange,
    Key,
    RecordedDrive,
    RecordedState,
    key_of,
    note,
)
from edge_runtime.cli import ArgumentParser, add_public_key, examples, not_negative_number
from edge_runtime.config import NONE, Config, load_config
from edge_runtime.controller import Controller, LimitRow, Order, Received, limit_rows
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.policy import Policy, infer, load_policy
from edge_runtime.safety import SILENCE_S, Event
from edge_runtime.tls import tls_for
from edge_runtime.transport import check_endpoint
from edge_runtime.util import UserError, printable
from edge_runtime.vehicles.registry import vehicle_limits
from edge_runtime.wire import SAFE_STOP, Command, check_vehicle_id, decode_command, encode

DEFAULT_TOLERANCE = 1e-5
"""Two processors round differently; a graph of the same weights stays far below this."""
DIFFERENT = 1
"""Exit status where at least one command differs."""
SHOWN_DIFFERENCES = 10
Answers = dict[Key, list[Answer]]
OnState = Callable[[int], None]
"""Called with the number of states published so far."""
EXAMPLE = examples(
    "python -m bridge replay hil_tests/recordings/left_turn.mcap \\\n"
    "    --policy results/policies/left_turn.onnx --public-key results/policies/policy.pub",
    "python -m bridge replay drive.mcap --listen tcp/127.0.0.1:7447 --out replay.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("recording", metavar="F.mcap", help="what bridge record has written")
    through = parser.add_mutually_exclusive_group(required=True)
    through.add_argument(
        "--policy", metavar="POLICY.onnx", help="replay in process, with the recording's times"
    )
    through.add_argument(
        "--listen",
        metavar="PROTOCOL/HOST:PORT",
        help="replay in real time to an edge runtime that connects here",
    )
    through.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        help="replay in real time to an edge runtime behind this router",
    )
    add_tls(parser)
    add_public_key(parser)
    parser.add_argument(
        "--allow-unsigned",
        action="store_true",
        help="also take a policy whose origin cannot be verified",
    )
    parser.add_argument(
        "--config",
        metavar="FILE.toml",
        help="with --policy: the settings of the edge runtime that was recorded, where a vehicle's"
        " model or scale was not the default",
    )
    parser.add_argument(
        "--vehicle-id", metavar="ID", help="which vehicle, where the recording holds several"
    )
    parser.add_argument(
        "--tolerance",
        metavar="X",
        type=not_negative_number,
        default=DEFAULT_TOLERANCE,
        help="how far two actions may be apart, of a range of -1 to 1",
    )
    add_wait_edge(parser)
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def run(arguments: Any) -> int:
    """Run the command: 0 where every command is the same, 1 where one differs."""
    if arguments.out is not None:
        check_writable(arguments.out)
    if arguments.vehicle_id is not None:
        check_vehicle_id(arguments.vehicle_id)
    drive = RecordedDrive(Path(arguments.recording), arguments.vehicle_id)
    policy_id, replayed = _answers(drive, arguments)
    states = [key_of(state) for state in drive.states()]
    report = {
        "recording": str(arguments.recording),
        "vehicle_id": drive.vehicle_id,
        "policy_id": policy_id,
        "recorded_policy_ids": drive.policy_ids,
        "cut_off": drive.recording.cut_off,
        "damaged_places": drive.recording.damaged_places,
        "damaged_bytes": drive.recording.damaged_bytes,
        "dropped": _dropped(drive),
        **compare(drive.exchanges, replayed, states, arguments.tolerance),
    }
    if report["compared"] == 0:
        raise UserError(f"{arguments.recording} holds answers, but none of the states they answer")
    write_json_out(arguments.out, report)
    if drive.recording.trouble():
        print(
            f"the recording {drive.recording.trouble()}; what is whole of it was replayed",
            file=sys.stderr,
        )
    _say(report)
    return DIFFERENT if report["different"] else 0


def _dropped(drive: RecordedDrive) -> int:
    """Messages that the recorder had to drop; of another program's recording nothing is known."""
    dropped = drive.recording.metadata.get("dropped", "")
    return int(dropped) if dropped.isdecimal() else 0


def _answers(drive: RecordedDrive, arguments: Any) -> tuple[str, Answers]:
    if arguments.policy is not None:
        if arguments.tls is not None:
            raise UserError("--tls is for a link, of --listen or --connect; --policy has none")
        policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
        config = load_config(arguments.config, {"policy": arguments.policy})
        return policy.policy_id, replay_in_process(drive, policy, config)
    if arguments.config is not None:
        raise UserError("--config is for --policy; an edge runtime that is asked has its own")
    endpoint = check_endpoint(arguments.listen or arguments.connect)
    wait_s, tls = arguments.wait_edge_s, tls_for(arguments.tls, endpoint)
    with open_port(arguments.listen, drive.vehicle_id, tls, arguments.connect, wait_s) as port:
        port.wait_for_edge(wait_s, endpoint)
        with count_bar("states", len(drive.exchanges)) as bar:
            answers = replay_live(drive, port, bar)
        return port.edge_policy_id(), answers


def _say(report: dict[str, Any]) -> None:
    print(
        f"{report['compared']} commands compared, {report['different']} differ; largest difference"
        f" {report['largest_difference']:.3g}, tolerance {report['tolerance']:g};"
        f" {report['unanswered']} states were never answered"
    )
    for row in report["first_differences"][:3]:
        print(f"  episode {row['episode']} step {row['step']}: {_told(row)}")


def _told(row: dict[str, Any]) -> str:
    def text(answers: list[dict[str, Any]]) -> str:
        parts = [
            f"{answer['mode']} {[round(value, 4) for value in answer['action']]}"
            + (f" ({printable(answer['reason'])})" if answer["reason"] else "")
            for answer in answers
        ]
        return ", then ".join(parts) or "nothing"

    return f"recorded {text(row['recorded'])}; replayed {text(row['replayed'])}"


def replay_in_process(drive: RecordedDrive, policy: Policy, config: Config) -> Answers:
    """Return the answers to every state that was answered in the recording.

    Which vehicle was attached is the recording's, and so is what befell it: when it failed, when
    an operator re-armed (before a state that was answered with ``drive``), and when the runtime
    was started anew. Its limits follow from ``config``. UserError where it lacks an action of the
    policy or cannot follow its scenario.
    """
    limits = vehicle_limits(drive.vehicle, config, policy.manifest.scenario)
    rows = limit_rows(policy.manifest.action, limits)
    return _Replay(drive, policy, rows, needs_rearm=drive.vehicle != NONE).run()


class _Replay:
    def __init__(
        self, drive: RecordedDrive, policy: Policy, rows: Sequence[LimitRow], needs_rearm: bool
    ) -> None:
        self._drive = drive
        self._policy = policy
        self._rows = rows
        self._needs_rearm = needs_rearm
        self._restarts_s: Iterator[float] = iter(drive.runtime_starts_s[1:])
        self._next_restart_s = next(self._restarts_s, float("inf"))
        self._controller = self._make_controller()
        self._last_heard_s = 0.0
        self._answers: Answers = {}

    def run(self) -> Answers:
        for recorded in self._drive.answered():
            self._restart(recorded.exchange.arrived_s)
            self._answer(recorded)
        self._pass_time(self._last_heard_s)
        return self._answers

    def _restart(self, now_s: float) -> None:
        while now_s >= self._next_restart_s:
            self._pass_time(self._last_heard_s)
            self._controller = self._make_controller()
            self._next_restart_s = next(self._restarts_s, float("inf"))

    def _make_controller(self) -> Controller:
        return Controller(self._rows, self._needs_rearm, task=self._policy.manifest.task)

    def _answer(self, recorded: RecordedState) -> None:
        state, exchange = recorded
        self._pass_time(exchange.begun_s)
        rearmed = any(answer.mode == "drive" for answer in exchange.answers)
        if rearmed and self._controller.waits_for_rearm:
            self._controller.rearm(exchange.arrived_s)
        arrived_ns = round(exchange.arrived_s * 1e9)
        self._controller.begin(Received(state, exchange.arrived_s, arrived_ns), exchange.begun_s)
        output = infer(self._policy, state.frames_array()).output
        self._pass_time(exchange.finished_s)
        first, *later = exchange.answers
        self._controller.vehicle_fault = self._new_fault([first])
        self._note(self._controller.finish(output, 1, exchange.finished_s))
        self._controller.vehicle_fault = self._new_fault(later)
        if self._controller.vehicle_fault:
            self._note(self._controller.tick(exchange.finished_s))
            self._controller.vehicle_fault = ""
        self._last_heard_s = exchange.last_s

    def _new_fault(self, answers: Sequence[Answer]) -> str:
        """The vehicle's fault where these answers are the first to tell of it; else empty.

        How long the cause stood is not recorded, and need not be: the stop is latched.
        """
        fault = Event.VEHICLE.value
        told = any(answer.reason == fault for answer in answers)
        return fault if told and self._controller.safety.reason != fault else ""

    def _pass_time(self, until_s: float) -> None:
        """Be the watchdog up to a moment."""
        last_s = None
        while (due_s := self._controller.next_deadline_s()) is not None and due_s != last_s:
            if due_s + JUST_AFTER_S > until_s:
                return
            self._note(self._controller.tick(due_s + JUST_AFTER_S))
            last_s = due_s

    def _note(self, order: Order | None) -> None:
        if order is not None:
            note(self._answers.setdefault(key_of(order.answers.state), []), order)


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
        note(self._answers.setdefault(key, []), command)


def compare(
    recorded: Mapping[Key, Exchange],
    replayed: Mapping[Key, Sequence[Answer]],
    states: Sequence[Key],
    tolerance: float,
) -> dict[str, Any]:
    """Return the part of the report that says what differs.

    ``states`` are the keys of all recorded states; those that nobody answered are counted, not
    compared. Two answers are equal where mode and reason are, and no action is further apart
    than ``tolerance``. A stop that goes on is repeated every T: whether that falls just before
    the next state or just after it, where it counts as an answer to that, is no difference.
    """
    answered = [key for key in states if key in recorded]
    kinds: dict[str, dict[str, int]] = {}
    differences: list[dict[str, Any]] = []
    largest = 0.0
    each_ours = _without_repetitions([recorded[key].answers for key in answered])
    each_theirs = _without_repetitions([replayed.get(key, []) for key in answered])
    for key, ours, theirs in zip(answered, each_ours, each_theirs, strict=True):
        same_shape, distance = _distance(ours, theirs)
        largest = max(largest, distance)
        row = kinds.setdefault(_kind(ours[-1]), {"compared": 0, "different": 0})
        row["compared"] += 1
        if not same_shape or distance > tolerance:
            row["different"] += 1
            differences.append(_describe(key, ours, theirs))
    return {
        "states": len(states),
        "compared": len(answered),
        "unanswered": len(states) - len(answered),
        "equal": len(answered) - len(differences),
        "different": len(differences),
        "largest_difference": largest,
        "tolerance": tolerance,
        "by_recorded": kinds,
        "first_differences": differences[:SHOWN_DIFFERENCES],
    }


def _without_repetitions(each: Sequence[Sequence[Answer]]) -> list[Sequence[Answer]]:
    """The answers to each state, without a first one that only repeats the stop before it."""
    kept: list[Sequence[Answer]] = []
    standing: Answer | None = None
    for answers in each:
        repeats = len(answers) > 1 and answers[0] == standing and standing.mode == SAFE_STOP
        kept.append(answers[1:] if repeats else answers)
        standing = answers[-1] if answers else None
    return kept


def _distance(ours: Sequence[Answer], theirs: Sequence[Answer]) -> tuple[bool, float]:
    """Whether modes, reasons and sizes agree, and how far apart the actions are at most."""
    same = len(ours) == len(theirs) and all(
        (one.mode, one.reason, len(one.action)) == (other.mode, other.reason, len(other.action))
        for one, other in zip(ours, theirs, strict=True)
    )
    apart = [
        abs(a - b)
        for one, other in zip(ours, theirs, strict=False)
        for a, b in zip(one.action, other.action, strict=False)
    ]
    return same, max(apart, default=0.0)


def _kind(answer: Answer) -> str:
    return f"{answer.mode}: {answer.reason}" if answer.reason else answer.mode


def _describe(key: Key, ours: Sequence[Answer], theirs: Sequence[Answer]) -> dict[str, Any]:
    session, episode, step = key
    return {
        "session": session,
        "episode": episode,
        "step": step,
        "recorded": [answer._asdict() for answer in ours],
        "replayed": [answer._asdict() for answer in theirs],
    }
