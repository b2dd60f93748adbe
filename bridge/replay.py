"""``python -m bridge replay``: recorded states through another policy or runtime, compared.

In process the runtime's own decision logic is around the policy, and time comes from the recording
alone, so that two replays of one file are the same. A running edge runtime is asked at the pace of
the recording.
"""

from __future__ import annotations

import itertools
import queue
import secrets
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from bridge.messages import Heard, decode, period_of
from bridge.ports import SimulatorPort, add_options, open_port
from bridge.progress import ProgressBar
from bridge.recording import Recording, choose_vehicle, heard_of, say_missing
from edge_runtime.cli import ArgumentParser, examples, not_negative_number
from edge_runtime.config import BUILT_IN, NONE, Config, add_trust, load_config
from edge_runtime.controller import (
    Controller,
    ControllerConfig,
    Limits,
    Order,
    Received,
    shared_limits,
)
from edge_runtime.files import write_json_out
from edge_runtime.manifest import Task
from edge_runtime.policy import Policy, infer, load_policy
from edge_runtime.safety import SILENCE_PERIODS, Event
from edge_runtime.transport import tls_for
from edge_runtime.util import UserError, name_in_file, printable
from edge_runtime.vehicles import find_vehicle, installed_as, vehicle_limits
from edge_runtime.wire import (
    SAFE_STOP,
    Command,
    Health,
    State,
    decode_command,
    encode,
    is_foreign,
)

RUNTIME_ENDED = "runtime_ended"
"""Reason of the farewell of a runtime that is ended; no decision about a state."""
JUST_AFTER_S = 1e-6  # A watchdog wakes at its deadline or later, never before
CLOCK_STEP_S = 1.0
"""Where the two clocks come apart by more than this, the runtime's has been stepped."""
MOST_REPETITIONS = 1000  # Of a stop: by then nothing is new, however long the silence lasts
RESTART_S = 0.5  # Uptimes that disagree by more than this belong to two runtimes

Key = tuple[str, int, int]  # Session, episode, step
DEFAULT_TOLERANCE = 1e-5
"""Two processors round differently; a graph of the same weights stays far below this."""
DIFFERENT = 1  # Exit status where at least one command differs
SHOWN_DIFFERENCES = 10
EXAMPLE = examples(
    "python -m bridge replay drive.mcap \\\n    --policy my.onnx --public-key keys/policy.pub",
    "python -m bridge replay drive.mcap --listen tcp/127.0.0.1:7447 --out replay.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("recording", metavar="F.mcap", help="what bridge record has written")
    through = parser.add_mutually_exclusive_group(required=True)
    in_process = "replay in process, with the recording's times"
    live = "replay in real time to an edge runtime"
    through.add_argument("--policy", metavar="POLICY.onnx", help=in_process)
    add_options(through, "--listen", help=f"{live} that connects here")
    add_options(through, "--connect", default=None, help=f"{live} behind this router")
    add_options(parser, "--tls", "--wait-edge-s", "--out")
    add_trust(parser)
    config = "with --policy: the settings of the edge runtime that was recorded, where a vehicle's"
    config += " model or scale was not the default"
    parser.add_argument("--config", metavar="FILE.toml", help=config)
    several = "which vehicle, where the recording holds several"
    add_options(parser, "--vehicle-id", default=None, help=several)
    apart = "how far two actions may be apart, in the unit of the action"
    parser.add_argument(
        "--tolerance", metavar="X", type=not_negative_number, default=DEFAULT_TOLERANCE, help=apart
    )


def run(arguments: Any) -> int:
    """Run the command: 0 where every command is the same, 1 where one differs."""
    drive = RecordedDrive(Path(arguments.recording), arguments.vehicle_id)
    policy_id, replayed = _answers(drive, arguments)
    states = [key_of(state) for state in drive.states()]
    recording, dropped = drive.recording, drive.recording.metadata.get("dropped", "")
    report = {
        "recording": str(arguments.recording),
        "vehicle_id": drive.vehicle_id,
        "policy_id": policy_id,
        "recorded_policy_ids": drive.policy_ids,
        "cut_off": recording.cut_off,
        "damaged_places": recording.damaged_places,
        "damaged_bytes": recording.damaged_bytes,
        "dropped": int(dropped) if dropped.isdecimal() else 0,  # other programs do not say
        **compare(drive.exchanges, replayed, states, arguments.tolerance),
    }
    if report["compared"] == 0:
        raise UserError(f"{arguments.recording} holds answers, but none of the states they answer")
    write_json_out(arguments.out, report)
    say_missing(recording, drive.vehicle_id)
    print(
        f"{report['compared']} commands compared, {report['different']} differ; largest difference"
        f" {report['largest_difference']:.3g}, tolerance {report['tolerance']:g};"
        f" {report['unanswered']} states were never answered"
    )
    for row in report["first_differences"][:3]:
        recorded, ours = _text(row["recorded"]), _text(row["replayed"])
        place = f"episode {row['episode']} step {row['step']}"
        print(f"  {place}: recorded {recorded}; replayed {ours}")
    return DIFFERENT if report["different"] else 0


def _text(answers: Sequence[Mapping[str, Any]]) -> str:
    parts = []
    for answer in answers:
        reason = f" ({printable(answer['reason'])})" if answer["reason"] else ""
        parts.append(f"{answer['mode']} {[round(x, 4) for x in answer['action']]}{reason}")
    return ", then ".join(parts) or "nothing"


def _answers(drive: RecordedDrive, arguments: Any) -> tuple[str, Answers]:
    """The policy's id, and what it answered."""
    if arguments.policy is not None:
        if arguments.tls is not None:
            raise UserError("--tls is for a link, of --listen or --connect; --policy has none")
        policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
        config = load_config(arguments.config, {"policy": arguments.policy}, opens_link=False)
        return policy.policy_id, replay_in_process(drive, policy, config)
    if arguments.config is not None:
        raise UserError("--config is for --policy; an edge runtime that is asked has its own")
    endpoint = arguments.listen or arguments.connect
    wait_s, tls = arguments.wait_edge_s, tls_for(arguments.tls, endpoint)
    with open_port(arguments.listen, drive.vehicle_id, tls, arguments.connect, wait_s) as port:
        port.wait_for_edge(wait_s, endpoint)
        with ProgressBar("replaying states", len(drive.exchanges)) as bar:
            answers = _Live(port, drive.period_s).replay(drive.answered(), bar)
        port.note_edge_counts()
        health = port.edge_counts.newest
        return health.policy_id if health else "", answers


class Answer(NamedTuple):
    """What was decided about a state; repetitions of the same are one answer."""

    mode: str
    reason: str
    action: tuple[float, ...]  # And those of its plan


@dataclass
class Exchange:
    """The answers to one state, and the times of the first of them."""

    arrived_s: float
    """When the state reached the runtime, seconds since the recording's first message."""
    begun_s: float  # When the policy began with it
    finished_s: float  # When the policy's answer, or the verdict that it took too long, was there
    last_s: float  # When the last answer was heard, repetitions included
    arrived_ns: int = 0  # `arrived_s` by the runtime's own clock
    answers: list[Answer] = field(default_factory=list)


Answers = dict[Key, list[Answer]]


class RecordedDrive:
    """One vehicle's part of a recording; states are read from the file when they are needed."""

    def __init__(self, path: Path, vehicle_id: str | None) -> None:
        """Read everything but the states; UserError where nothing can be replayed."""
        self.recording = Recording(path)
        self.exchanges: dict[Key, Exchange] = {}
        self.policy_ids: list[str] = []
        self.vehicle = NONE
        self.task: Task | None = None  # As the simulator's scenes say
        self.period_s = 0.0
        self.plan_periods = 0  # Of the runtime's ride-through
        self.runtime_starts_s: list[float] = []
        self.vehicle_id = choose_vehicle(self.recording, vehicle_id)
        self._zero_ns: int | None = None
        self._lead_s: tuple[int, float] | None = None
        self._arrived_s = -CLOCK_STEP_S  # The newest exchange's
        for heard in heard_of(self.recording, self.vehicle_id):
            self._take(heard)
        if not self.exchanges:
            raise UserError(f"{path} holds no answered state of vehicle {self.vehicle_id}")

    def states(self) -> Iterator[State]:
        """Yield every state that can be read, answered or not, once, in order of arrival."""
        seen: set[Key] = set()  # A network may repeat them.
        for heard in heard_of(self.recording, self.vehicle_id):
            if heard.topic == "state":
                state = decode(heard)
                if isinstance(state, State) and key_of(state) not in seen:
                    seen.add(key_of(state))
                    yield state

    def answered(self) -> Iterator[tuple[State, Exchange]]:
        """Yield the states that reached the policy."""
        for state in self.states():
            if (exchange := self.exchanges.get(key_of(state))) is not None:
                yield state, exchange

    def _take(self, heard: Heard) -> None:
        if self._zero_ns is None:
            self._zero_ns = heard.arrived_ns
        if heard.topic == "state" and not self.period_s:
            state = decode(heard)
            self.period_s = period_of(state) if isinstance(state, State) else 0.0
        if heard.topic == "scene" and self.task is None:
            self.task = getattr(decode(heard), "task", None)
        if heard.topic not in ("command", "health"):
            return
        heard_s = (heard.arrived_ns - self._zero_ns) * 1e-9
        message = decode(heard)
        if isinstance(message, Command) and message.reason != RUNTIME_ENDED:
            self._take_command(message, heard_s)
        elif isinstance(message, Health):
            self.vehicle = message.vehicle
            start_s = heard_s - message.uptime_s
            if not self.runtime_starts_s or start_s > self.runtime_starts_s[-1] + RESTART_S:
                self.runtime_starts_s.append(start_s)

    def _take_command(self, command: Command, heard_s: float) -> None:
        if command.policy_id not in self.policy_ids:
            self.policy_ids.append(command.policy_id)
        self.plan_periods = max(self.plan_periods, len(command.plan or ()))
        sent_s = self._sent_s(command, heard_s)
        exchange = self.exchanges.get(key_of(command))
        if exchange is None:
            exchange = _first_exchange(command, sent_s, self.period_s, self._arrived_s)
            self.exchanges[key_of(command)] = exchange
            self._arrived_s = exchange.arrived_s
        exchange.last_s = sent_s
        note(exchange.answers, command)

    def _sent_s(self, command: Command, heard_s: float) -> float:
        """When the command was sent, in the recorder's time.

        The recorder's clock leads the runtime's by as much as at the first command of that
        runtime, until a step of the latter.
        """
        stamp_s = (command.sent_ns - (self._zero_ns or 0)) * 1e-9
        runtime, lead_s = len(self.runtime_starts_s), heard_s - stamp_s
        known = self._lead_s
        if known is None or known[0] != runtime or abs(lead_s - known[1]) > CLOCK_STEP_S:
            self._lead_s = known = (runtime, lead_s)
        return stamp_s + known[1]


def note(answers: list[Answer], decision: Command | Order) -> None:
    """Add what was decided to the answers to a state, unless it repeats the last one."""
    numbers = (*decision.action, *itertools.chain(*(decision.plan or ())))
    answer = Answer(decision.mode, decision.reason, numbers)
    if not answers or answers[-1] != answer:
        answers.append(answer)


def key_of(message: State | Command) -> Key:
    """Return what a state and its command have in common."""
    return message.session, message.episode, message.step


def _first_exchange(
    command: Command, sent_s: float, period_s: float, earliest_s: float
) -> Exchange:
    """When it arrived: the answer's sending, less the time between the runtime's two stamps.

    States arrive in their order: where that says before ``earliest_s``, the one before, the
    runtime's clock was set between the two stamps, and the sending counts.
    """
    arrived_s = sent_s - max(0.0, (command.sent_ns - command.received_ns) * 1e-9)
    if arrived_s < earliest_s - period_s:
        arrived_s = sent_s
    begun_s = max(arrived_s, sent_s - command.inference_ns * 1e-9)
    finished_s = sent_s
    if command.inference_ns == 0:
        # The watchdog's verdict: the policy is still at it, or the state came too late for it.
        begun_s = arrived_s
        finished_s = begun_s + JUST_AFTER_S
        if command.reason == Event.TOO_LONG.value:
            finished_s = max(sent_s, begun_s + period_s + JUST_AFTER_S)
    return Exchange(arrived_s, begun_s, finished_s, sent_s, command.received_ns)


def replay_in_process(drive: RecordedDrive, policy: Policy, config: Config) -> Answers:
    """Return the answers to every state that was answered in the recording.

    Which vehicle was attached is the recording's, and so is what befell it: when it failed, when
    an operator re-armed (before a state that was answered with ``drive``), and when the runtime was
    started anew, armed or not. Its limits follow from ``config``. UserError where it lacks an
    action of the policy or cannot follow its scenario.
    """
    name = drive.vehicle
    if NONE not in (name, config.vehicle) and find_vehicle(config.vehicle).name == name:
        name = config.vehicle  # A module:Class, of which the recording has the class's name
    elif name not in (NONE, *BUILT_IN):
        option = "--config FILE.toml whose table [vehicle] has as its driver"
        name = name_in_file(installed_as(name), f"{drive.recording.path} is of", option)
    try:
        limits = vehicle_limits(name, config.vehicle_settings, policy.manifest)
    except UserError as error:
        raise UserError(f"{error} (--config FILE.toml: the settings it was driven by)") from None
    return _Replay(drive, policy, shared_limits(policy.manifest.action, limits)).run()


def controller_of(
    policy: Policy, limits: Limits, plan_periods: int, needs_rearm: bool, is_armed: bool = True
) -> Controller:
    """The edge runtime's decision logic; its commands carry plans of so many periods."""
    period_s, task = policy.manifest.control_period_s, policy.layout.task_text
    ride_s = plan_periods * period_s
    return Controller(ControllerConfig(limits, period_s, needs_rearm, is_armed, task, ride_s))


class _Replay:
    def __init__(self, drive: RecordedDrive, policy: Policy, limits: Limits) -> None:
        self._drive, self._policy, self._limits = drive, policy, limits
        self._restarts_s = deque(drive.runtime_starts_s[1:])
        self._controller = self._make_controller(next(iter(drive.exchanges.values())))
        self._last_heard_s = 0.0
        self._answers: Answers = {}

    def run(self) -> Answers:
        for state, exchange in self._drive.answered():
            while self._restarts_s and exchange.arrived_s >= self._restarts_s[0]:
                self._restarts_s.popleft()
                self._pass_time(self._last_heard_s)
                self._controller = self._make_controller(exchange)
            self._answer(state, exchange)
        self._pass_time(self._last_heard_s)
        return self._answers

    def _make_controller(self, first: Exchange) -> Controller:
        """A runtime as it was when it met this exchange first."""
        needs_rearm = self._drive.vehicle != NONE
        is_armed = first.answers[0].reason != Event.NOT_ARMED.value
        plans = self._drive.plan_periods
        return controller_of(self._policy, self._limits, plans, needs_rearm, is_armed)

    def _answer(self, state: State, exchange: Exchange) -> None:
        self._pass_time(exchange.begun_s)
        rearmed = any(answer.mode == "drive" for answer in exchange.answers)
        if rearmed and self._controller.waits_for_rearm:
            self._controller.rearm(exchange.arrived_s)
        received = Received(state, exchange.arrived_s, exchange.arrived_ns)
        self._controller.begin(received, exchange.begun_s)
        output, layout = None, self._policy.layout
        if layout.refusal(state.observation) is None and not is_foreign(state, layout.task_text):
            output, _ = infer(self._policy, layout.arrays(state.observation))
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
        for _ in range(MOST_REPETITIONS):
            due_s = self._controller.next_deadline_s()
            if due_s in (None, last_s) or due_s + JUST_AFTER_S > until_s:
                return
            self._note(self._controller.tick(due_s + JUST_AFTER_S))
            last_s = due_s

    def _note(self, order: Order | None) -> None:
        if order is not None and not order.ridden:
            note(self._answers.setdefault(key_of(order.answers.state), []), order)


class _Live:
    """Publishes every answered state to a running edge runtime, and keeps what comes back.

    Each waits for its moment, and for the answer to the one before (2 T at most): a runtime that
    is slower than the recorded one is asked later, not less. Every recorded session becomes a
    fresh one, which the runtime has never heard of.
    """

    def __init__(self, port: SimulatorPort, period_s: float) -> None:
        self._port, self._silence_s = port, SILENCE_PERIODS * period_s
        self._inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._fresh: dict[str, str] = {}  # recorded session to the one it is replayed as
        self._recorded: dict[str, str] = {}  # and back
        self._answers: Answers = {}

    def replay(self, states: Iterable[tuple[State, Exchange]], bar: ProgressBar) -> Answers:
        self._port.hear("command", self._inbox.put)
        zero_s, last_s = float("-inf"), 0.0
        for state, exchange in states:
            if zero_s == float("-inf"):
                zero_s = time.monotonic() - exchange.arrived_s
            self._listen_until(zero_s + exchange.arrived_s)
            fresh = self._fresh.setdefault(state.session, secrets.token_hex(8))
            self._recorded[fresh] = state.session
            sent = msgspec.structs.replace(state, session=fresh, sent_ns=time.time_ns())
            self._port.publish_state(encode(sent))
            self._listen_until(time.monotonic() + self._silence_s, key_of(state))
            zero_s = max(zero_s, time.monotonic() - exchange.finished_s)
            last_s = exchange.last_s
            bar.advance({})
        self._listen_until(zero_s + last_s)
        return self._answers

    def _listen_until(self, end_s: float, wanted: Key | None = None) -> None:
        """Take what comes before ``end_s`` (monotonic), or until the wanted answer is there."""
        while wanted not in self._answers and (left_s := end_s - time.monotonic()) > 0.0:
            try:
                command = decode_command(self._inbox.get(timeout=left_s))
            except queue.Empty:
                return
            if isinstance(command, Command) and command.session in self._recorded:
                key = (self._recorded[command.session], command.episode, command.step)
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
    each_ours = list(without_repetitions(recorded[key].answers for key in answered))
    each_theirs = list(without_repetitions(replayed.get(key, []) for key in answered))
    then = ([*each_ours[1:], ()], [*each_theirs[1:], ()])
    for key, ours, theirs, *later in zip(answered, each_ours, each_theirs, *then, strict=True):
        ours, theirs = _same_moment(ours, theirs, *later)
        same_shape, distance = _distance(ours, theirs)
        largest = max(largest, distance)
        kind = f"{ours[-1].mode}: {ours[-1].reason}".removesuffix(": ")
        row = kinds.setdefault(kind, {"compared": 0, "different": 0})
        row["compared"] += 1
        if not same_shape or distance > tolerance:
            row["different"] += 1
            place = dict(zip(("session", "episode", "step"), key, strict=True))
            each = {"recorded": ours, "replayed": theirs}
            told = {name: [one._asdict() for one in found] for name, found in each.items()}
            differences.append({**place, **told})
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


def without_repetitions(each: Iterable[Sequence[Answer]]) -> Iterator[Sequence[Answer]]:
    """The answers to each state, without a first one that only repeats the stop before it."""
    standing: Answer | None = None
    for answers in each:
        repeats = len(answers) > 1 and answers[0] == standing and standing.mode == SAFE_STOP
        yield answers[1:] if repeats else answers
        standing = answers[-1] if answers else None


def _same_moment(
    ours: Sequence[Answer],
    theirs: Sequence[Answer],
    ours_then: Sequence[Answer],
    theirs_then: Sequence[Answer],
) -> tuple[Sequence[Answer], Sequence[Answer]]:
    """Both, without a last stop of one alone with which both answer the next state.

    On a busy machine that state comes before the watchdog has noticed the silence.
    """
    longer, shortest = max(ours, theirs, key=len), min(len(ours), len(theirs))
    stop = longer[shortest:]
    noticed = shortest > 0 and len(stop) == 1 and stop[0].mode == SAFE_STOP
    if noticed and tuple(stop) == tuple(ours_then[:1]) == tuple(theirs_then[:1]):
        return ours[:shortest], theirs[:shortest]
    return ours, theirs


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
