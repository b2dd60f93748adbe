"""``python -m bridge replay``: run recorded states through a policy and compare its commands.

The policy runs inside the edge runtime's own decision logic. All times come from the recording, so
two replays of one file are the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bridge.messages import Heard
from bridge.ports import add_options
from bridge.recording import Recording, choose_vehicle, valid_messages
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
from edge_runtime.safety import Event
from edge_runtime.util import UserError, name_in_file, printable
from edge_runtime.vehicles import find_vehicle, installed_as, vehicle_limits
from edge_runtime.wire import DRIVE, SAFE_STOP, Command, Health, State, is_foreign

RUNTIME_ENDED = "runtime_ended"  # Reason of a runtime's farewell, which answers no state
JUST_AFTER_S = 1e-6  # A watchdog wakes at its deadline or later, never before
CLOCK_STEP_S = 1.0  # Stamps that leap by more against the recorder's: a clock was set
MOST_REPETITIONS = 1000  # Of a stop; after so many, however long the silence lasts, nothing is new
RESTART_S = 0.5  # Uptimes that disagree by more than this belong to two runtimes
DEFAULT_TOLERANCE = 1e-5  # Two processors round differently, by far less than this
DIFFERENT = 1  # Exit status where at least one command differs
SHOWN_DIFFERENCES = 10

Key = tuple[str, int, int]  # Session, episode, step
EXAMPLE = examples("python -m bridge replay drive.mcap --policy my.onnx --public-key policy.pub")


def add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("recording", metavar="F.mcap", help="a file of bridge record")
    add("--policy", metavar="POLICY.onnx", required=True, help="the policy to run")
    add_trust(parser)
    config = "settings of the recorded edge runtime, if a vehicle's model or scale was not default"
    add("--config", metavar="FILE.toml", help=config)
    several = "the vehicle, if the recording holds several"
    add_options(parser, "--vehicle-id", default=None, help=several)
    apart = "largest difference of two equal actions, in the unit of the action"
    kind = not_negative_number
    add("--tolerance", metavar="X", type=kind, default=DEFAULT_TOLERANCE, help=apart)
    add_options(parser, "--out")


def run(arguments: Any) -> int:
    """Run the command: 0 where every command is the same, 1 where one differs."""
    drive = RecordedDrive(Path(arguments.recording), arguments.vehicle_id)
    policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    config = load_config(arguments.config, {"policy": arguments.policy}, opens_link=False)
    replayed = replay(drive, policy, config)
    states, recording = list(map(key_of, drive.states())), drive.recording
    dropped = recording.metadata.get("dropped", "")
    report = {
        "recording": str(arguments.recording),
        "vehicle_id": drive.vehicle_id,
        "policy_id": policy.policy_id,
        "recorded_policy_ids": drive.policy_ids,
        "cut_off": recording.cut_off,
        "damaged_places": recording.damaged_places,
        "dropped": int(dropped) if dropped.isdecimal() else 0,  # Other programs do not say
        **compare(drive.answers, replayed, states, arguments.tolerance),
    }
    if report["compared"] == 0:
        raise UserError(f"{arguments.recording} holds answers, but none of the states they answer")
    write_json_out(arguments.out, report)
    print(
        f"{report['compared']} commands compared, {report['different']} differ; largest difference"
        f" {report['largest_difference']:.3g}, tolerance {report['tolerance']:g};"
        f" {report['unanswered']} states were never answered"
    )
    for row in report["first_differences"][:1]:
        place = f"episode {row['episode']} step {row['step']}"
        print(f"  {place}: recorded {_text(row['recorded'])}; replayed {_text(row['replayed'])}")
    return DIFFERENT if report["different"] else 0


def _text(answer: Mapping[str, Any] | None) -> str:
    if answer is None:
        return "nothing"
    action = [round(x, 4) for x in answer["action"]]
    return printable(f"{answer['mode']} {action} {answer['reason']}".strip())


class Answer(NamedTuple):
    """What was decided about a state."""

    mode: str
    reason: str
    action: tuple[float, ...]  # Followed by the actions of its plan


class Answers(dict[Key, Answer]):
    """The first answer to each state that does not repeat the stop before it.

    A stop that goes on is repeated every T. Whether a repetition falls just before the next state
    or just after it, where it counts as an answer to that state, is no difference.
    """

    _last: Answer | None = None
    _repeated: Key | None = None  # Has only a repeated stop so far

    def note(self, key: Key, decision: Command | Order) -> None:
        plan = tuple(value for action in decision.plan or () for value in action)
        answer = Answer(decision.mode, decision.reason, (*decision.action, *plan))
        if key not in self or key == self._repeated:
            self[key] = answer
            repeats = answer.mode == SAFE_STOP and answer == self._last
            self._repeated = key if repeats else None
        self._last = answer


class Exchange(NamedTuple):
    """The times of the first answer to a state, in seconds since the recording's first message."""

    arrived_s: float  # When the state reached the runtime
    begun_s: float  # When the policy began with it
    sent_s: float  # When the answer was sent
    arrived_ns: int  # `arrived_s` by the runtime's own clock
    by_watchdog: bool  # The policy was still at it, or the state came too late


class RecordedDrive:
    """One vehicle's part of a recording; states are read from the file when they are needed.

    Raises UserError where nothing can be replayed.
    """

    def __init__(self, path: Path, vehicle_id: str | None) -> None:
        self.recording = Recording(path)
        self.vehicle_id = choose_vehicle(self.recording, vehicle_id)
        self.answers = Answers()
        self.exchanges: dict[Key, Exchange] = {}
        self.policy_ids: list[str] = []
        self.vehicle = NONE
        self.task: Task | None = None  # As the simulator's scenes say
        self.plan_periods = 0  # Of the runtime's ride-through
        self.runtime_starts_s: list[float] = []
        self._zero_ns = 0  # Arrival of the first message
        self._lead_s: float | None = None  # Of the recorder's clock before the runtime's
        for heard, message in valid_messages(self.recording, self.vehicle_id):
            self._take(heard, message)
        self.recording.say_missing()
        if not self.exchanges:
            raise UserError(f"{path} holds no answered state of vehicle {self.vehicle_id}")

    def states(self) -> Iterator[State]:
        """Yield the states in their order, each once: a network may repeat a message."""
        seen: set[Key] = set()
        for _, state in valid_messages(self.recording, self.vehicle_id):
            if isinstance(state, State) and key_of(state) not in seen:
                seen.add(key_of(state))
                yield state

    def _take(self, heard: Heard, message: Any) -> None:
        self._zero_ns = self._zero_ns or heard.arrived_ns
        heard_s = (heard.arrived_ns - self._zero_ns) * 1e-9
        if heard.topic == "scene":
            self.task = self.task or message.task
        elif isinstance(message, Command) and message.reason != RUNTIME_ENDED:
            self._take_command(message, heard_s)
        elif isinstance(message, Health):
            self.vehicle = message.vehicle
            start_s = heard_s - message.uptime_s
            if not self.runtime_starts_s or start_s > self.runtime_starts_s[-1] + RESTART_S:
                self.runtime_starts_s.append(start_s)
                self._lead_s = None

    def _take_command(self, command: Command, heard_s: float) -> None:
        if command.policy_id not in self.policy_ids:
            self.policy_ids.append(command.policy_id)
        self.plan_periods = max(self.plan_periods, len(command.plan or ()))
        key, sent_s = key_of(command), self._sent_s(command, heard_s)
        self.answers.note(key, command)
        if key not in self.exchanges:
            before = next(reversed(self.exchanges.values()), None)
            # By one clock, unless that was set between the two stamps; states arrive in order.
            arrived_s = sent_s - max(0.0, (command.sent_ns - command.received_ns) * 1e-9)
            arrived_s = max(arrived_s, before.arrived_s) if before else arrived_s
            by_watchdog = command.inference_ns == 0
            begun_s = arrived_s if by_watchdog else sent_s - command.inference_ns * 1e-9
            times = arrived_s, max(arrived_s, begun_s), sent_s
            self.exchanges[key] = Exchange(*times, command.received_ns, by_watchdog)

    def _sent_s(self, command: Command, heard_s: float) -> float:
        """Return when the command was sent, in the recorder's time.

        The recorder's clock leads a runtime's as at its first command, until a clock is set.
        """
        stamp_s = (command.sent_ns - self._zero_ns) * 1e-9
        lead_s = heard_s - stamp_s
        if self._lead_s is None or abs(lead_s - self._lead_s) > CLOCK_STEP_S:
            self._lead_s = lead_s
        return stamp_s + self._lead_s


def key_of(message: State | Command) -> Key:
    return message.session, message.episode, message.step


def replay(drive: RecordedDrive, policy: Policy, config: Config) -> Answers:
    """Return the answers to every state that was answered in the recording.

    Which vehicle was attached is the recording's, and so is what befell it: when it failed, when
    an operator re-armed (before a state that was answered with ``drive``), and when the runtime was
    started anew, armed or not. Its limits follow from ``config``. UserError where it lacks an
    action of the policy or cannot follow its scenario.
    """
    name = drive.vehicle
    if NONE not in (name, config.vehicle) and find_vehicle(config.vehicle).name == name:
        name = config.vehicle  # A module:Class; the recording has the class's name
    elif name not in (NONE, *BUILT_IN):
        option = "--config FILE.toml whose table [vehicle] has as its driver"
        name = name_in_file(installed_as(name), f"{drive.recording.path} is of", option)
    try:
        limits = vehicle_limits(name, config.vehicle_settings, policy.manifest)
    except UserError as error:
        raise UserError(f"{error} (--config FILE.toml: the settings it was driven by)") from None
    limits = shared_limits(policy.manifest.action, limits)
    answers, controller, starts_s = Answers(), None, drive.runtime_starts_s[1:]
    for state in drive.states():
        if (exchange := drive.exchanges.get(key_of(state))) is None:
            continue
        recorded = drive.answers[key_of(state)]
        if controller is None or (starts_s and exchange.arrived_s >= starts_s[0]):
            starts_s = [start_s for start_s in starts_s if start_s > exchange.arrived_s]
            needs_rearm, armed = drive.vehicle != NONE, recorded.reason != Event.NOT_ARMED.value
            controller = controller_of(policy, limits, drive.plan_periods, needs_rearm, armed)
        for order in _orders(controller, policy, state, exchange, recorded):
            if not order.ridden:
                answers.note(key_of(order.answers.state), order)
    return answers


def controller_of(
    policy: Policy, limits: Limits, plan_periods: int, needs_rearm: bool, is_armed: bool = True
) -> Controller:
    """Make the edge runtime's decision logic with ride-through of so many periods."""
    period_s, task = policy.manifest.control_period_s, policy.layout.task_text
    ride_s = plan_periods * period_s
    return Controller(ControllerConfig(limits, period_s, needs_rearm, is_armed, task, ride_s))


def _orders(
    controller: Controller, policy: Policy, state: State, exchange: Exchange, recorded: Answer
) -> Iterator[Order]:
    """Yield what the runtime decides until it has answered the state."""
    finished_s = exchange.sent_s
    if exchange.by_watchdog:
        too_long = recorded.reason == Event.TOO_LONG.value
        waited_s = policy.manifest.control_period_s * too_long
        finished_s = exchange.begun_s + waited_s + JUST_AFTER_S
    yield from _watchdog(controller, exchange.begun_s)
    if recorded.mode == DRIVE and controller.waits_for_rearm:
        controller.rearm(exchange.arrived_s)
    controller.begin(Received(state, exchange.arrived_s, exchange.arrived_ns), exchange.begun_s)
    output, layout = None, policy.layout
    if layout.refusal(state.observation) is None and not is_foreign(state, layout.task_text):
        output, _ = infer(policy, layout.arrays(state.observation))
    yield from _watchdog(controller, finished_s)
    # How long a vehicle's fault stood is not recorded, and need not be: the stop is latched.
    fault = Event.VEHICLE.value
    if recorded.reason == fault and controller.safety.reason != fault:
        controller.vehicle_fault = fault
    if order := controller.finish(output, 1, finished_s):
        yield order
    controller.vehicle_fault = ""


def _watchdog(controller: Controller, until_s: float) -> Iterator[Order]:
    last_s = None
    for _ in range(MOST_REPETITIONS):
        due_s = controller.next_deadline_s()
        if due_s in (None, last_s) or due_s + JUST_AFTER_S > until_s:
            return
        if order := controller.tick(due_s + JUST_AFTER_S):
            yield order
        last_s = due_s


def compare(
    recorded: Mapping[Key, Answer],
    replayed: Mapping[Key, Answer],
    states: Sequence[Key],
    tolerance: float,
) -> dict[str, Any]:
    """Return the part of the report that says what differs.

    ``states`` are the keys of all recorded states; those that nobody answered are counted, not
    compared. Two answers are equal where mode and reason are, and no action is further apart
    than ``tolerance``.
    """
    answered = [key for key in states if key in recorded]
    kinds, wrong = Counter[str](), Counter[str]()
    differences: list[dict[str, Any]] = []
    largest = 0.0
    for key in answered:
        ours, theirs = recorded[key], replayed.get(key, Answer("", "", ()))
        kind = f"{ours.mode}: {ours.reason}".removesuffix(": ")
        kinds[kind] += 1
        pairs = zip(ours.action, theirs.action, strict=False)
        distance = max((abs(a - b) for a, b in pairs), default=0.0)
        largest = max(largest, distance)
        same = ours[:2] == theirs[:2] and len(ours.action) == len(theirs.action)
        if not same or distance > tolerance:
            wrong[kind] += 1
            place = dict(zip(("session", "episode", "step"), key, strict=True))
            replay = theirs._asdict() if key in replayed else None
            differences.append({**place, "recorded": ours._asdict(), "replayed": replay})
    return {
        "states": len(states),
        "compared": len(answered),
        "unanswered": len(states) - len(answered),
        "equal": len(answered) - len(differences),
        "different": len(differences),
        "largest_difference": largest,
        "tolerance": tolerance,
        "by_recorded": {
            kind: {"compared": count, "different": wrong[kind]} for kind, count in kinds.items()
        },
        "first_differences": differences[:SHOWN_DIFFERENCES],
    }
