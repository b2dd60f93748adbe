"""``python -m bridge replay``: run recorded states through a policy and compare its commands.

The policy runs inside the edge runtime's own decision logic, at the times that the recorded
runtime stamped, on the recorder's clock: two replays of one file are the same.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bridge.ports import add_options
from bridge.recording import Recording, choose_vehicle, valid_messages
from bridge.report import write_figure
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
from edge_runtime.safety import Event, Mode
from edge_runtime.util import UserError, name_in_file, printable
from edge_runtime.vehicles import find_vehicle, vehicle_limits
from edge_runtime.wire import DRIVE, Command, Health, State, is_foreign

RUNTIME_ENDED = "runtime_ended"  # Reason of a runtime's last command, which answers no state
JUST_AFTER_S = 1e-6  # A watchdog wakes at its deadline or later, never before
RESTART_S = 0.5  # Starts that are further apart belong to two runtimes
CLOCK_STEP_S = 1.0  # A larger leap of stamps against the recorder's clock: a clock was set
DEFAULT_TOLERANCE = 1e-5  # Two processors round differently, by far less than this
DIFFERENT = 1  # Exit status where at least one command differs
SHOWN_DIFFERENCES = 10
MOST_PANELS = 8  # Of a picture, one for each action

Key = tuple[str, int, int]  # Session, episode, step


class Exchange(NamedTuple):
    """A recorded answer, and its times in seconds since the recording's first message."""

    command: Command
    arrived_s: float  # When the state reached the runtime
    sent_s: float  # When the answer was sent


Row = tuple[State, Command | None, Order | None]
"""A state, the policy's recorded answer (None if it has none), and the replayed answer."""
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
    out = "report to write, as JSON, and beside it a picture R.png of recorded and replayed actions"
    add_options(parser, "--out", help=out)


def run(arguments: Any) -> int:
    """Replay, report, and return 0 if every command is the same, 1 if one differs."""
    drive = RecordedDrive(Path(arguments.recording), arguments.vehicle_id)
    policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    config = load_config(arguments.config, {"policy": arguments.policy}, opens_link=False)
    rows = [*replay(drive, policy, config)]
    report = report_on(drive, policy, rows, arguments.tolerance)
    write_json_out(arguments.out, report)
    if arguments.out:
        names = [row.name for row in policy.manifest.action]
        write_figure(draw(rows, names), Path(arguments.out).with_suffix(".png"))
    print(
        f"{report['compared']} commands compared, {report['different']} differ; largest difference"
        f" {report['largest_difference']:.3g}, tolerance {report['tolerance']:g};"
        f" {report['unanswered']} states were never answered"
    )
    for row in report["first_differences"][:1]:
        place = f"episode {row['episode']} step {row['step']}"
        print(printable(f"  {place}: recorded {row['recorded']}; replayed {row['replayed']}"))
    return DIFFERENT if report["different"] else 0


def report_on(
    drive: RecordedDrive, policy: Policy, rows: Iterable[Row], tolerance: float = DEFAULT_TOLERANCE
) -> dict[str, Any]:
    """Return the report on the rows of `replay`. UserError where nothing is compared."""
    report = {
        "recording": str(drive.recording.path),
        "policy_id": policy.policy_id,
        "recorded_policy_ids": sorted({each.command.policy_id for each in drive.answers.values()}),
        **compare(rows, tolerance),
    }
    if report["compared"] == 0:
        raise UserError(f"{drive.recording.path} holds no state with an answer of its policy")
    return report


class RecordedDrive:
    """One vehicle's part of a recording; states are read from the file when they are needed.

    ``answers`` has for each state the policy's first answer, or else the watchdog's (without an
    inference). Raises UserError where no state was answered.
    """

    def __init__(self, path: Path, vehicle_id: str | None) -> None:
        self.recording = Recording(path)
        self.vehicle_id = choose_vehicle(self.recording, vehicle_id)
        self.answers: dict[Key, Exchange] = {}
        self.vehicle = NONE
        self.task: Task | None = None  # As the simulator's scenes say
        self.starts_s: list[float] = []  # Start times of the edge runtimes, one after the other
        zero_ns: int | None = None
        self._lead_s: float | None = None  # Recorder's clock minus the runtime's
        self._newest_s = -math.inf  # Arrival of the newest state
        for heard, message in valid_messages(self.recording, self.vehicle_id):
            zero_ns = heard.arrived_ns if zero_ns is None else zero_ns
            heard_s = (heard.arrived_ns - zero_ns) * 1e-9
            if heard.topic == "scene":
                self.task = self.task or message.task
            elif isinstance(message, Command) and message.reason != RUNTIME_ENDED:
                first = self.answers.get(key_of(message))
                exchange = self._exchange(message, heard_s)
                if first is None or (message.inference_ns and not first.command.inference_ns):
                    self.answers[key_of(message)] = exchange
            elif isinstance(message, Health):
                self.vehicle = message.vehicle
                start_s = heard_s - message.uptime_s
                if not self.starts_s or start_s > self.starts_s[-1] + RESTART_S:
                    self.starts_s.append(start_s)
                    self._lead_s = None
        self.recording.say_trouble()
        if not self.answers:
            raise UserError(f"{path} holds no answered state of vehicle {self.vehicle_id}")

    def _exchange(self, command: Command, heard_s: float) -> Exchange:
        """Convert a command's stamps to the recorder's clock."""
        stamp_s = command.sent_ns * 1e-9
        lead_s = heard_s - stamp_s
        if self._lead_s is None or abs(lead_s - self._lead_s) > CLOCK_STEP_S:
            self._lead_s = lead_s
        sent_s = stamp_s + self._lead_s
        # Both stamps are of one clock, unless it was set in between; states arrive in order.
        took_s = (command.sent_ns - command.received_ns) * 1e-9
        arrived_s = sent_s - (took_s if 0.0 <= took_s < CLOCK_STEP_S else 0.0)
        self._newest_s = max(self._newest_s, arrived_s)
        return Exchange(command, self._newest_s, max(sent_s, self._newest_s))

    def states(self) -> Iterator[State]:
        """Yield the states in order, each once: a network may repeat a message."""
        seen: set[Key] = set()
        for _, state in valid_messages(self.recording, self.vehicle_id):
            if isinstance(state, State) and key_of(state) not in seen:
                seen.add(key_of(state))
                yield state


def key_of(message: State | Command) -> Key:
    return message.session, message.episode, message.step


def replay(drive: RecordedDrive, policy: Policy, config: Config) -> Iterator[Row]:
    """Yield every state with its recorded and its replayed answer.

    The recording shows which vehicle was attached, when it failed, when an operator re-armed
    (before a state that was answered with ``drive``), and when the runtime was restarted. The
    vehicle's limits follow from ``config``. UserError where it lacks an action of the policy.
    """
    limits = shared_limits(policy.manifest.action, _vehicle_limits(drive, policy, config))
    commands = [each.command for each in drive.answers.values()]
    controller, starts_s = None, drive.starts_s[1:]
    for state in drive.states():
        exchange = drive.answers.get(key_of(state))
        if exchange is None:
            yield state, None, None
            continue
        while starts_s and starts_s[0] <= exchange.arrived_s:
            controller, starts_s = None, starts_s[1:]
        recorded = exchange.command
        if controller is None:
            armed = recorded.reason != Event.NOT_ARMED.value
            controller = controller_of(policy, limits, commands, drive.vehicle != NONE, armed)
        order = _answer(controller, policy, state, exchange)
        yield state, recorded if recorded.inference_ns or order else None, order


def _vehicle_limits(drive: RecordedDrive, policy: Policy, config: Config) -> Limits:
    """Return the limits of the recorded vehicle; a recording never decides what is imported."""
    name = drive.vehicle
    if NONE not in (name, config.vehicle) and find_vehicle(config.vehicle).name == name:
        name = config.vehicle  # A module:Class; the recording has the class's name
    elif name not in (NONE, *BUILT_IN):
        option = "--config FILE.toml whose table [vehicle] has as its driver"
        name = name_in_file(name, f"{drive.recording.path} is of", option)
    return vehicle_limits(name, config.vehicle_settings, policy.manifest, config.bounds)


def controller_of(
    policy: Policy,
    limits: Limits,
    commands: Iterable[Command],
    needs_rearm: bool = False,
    is_armed: bool = True,
) -> Controller:
    """Make the edge runtime's decision logic, with the ride-through of recorded commands."""
    period_s, task = policy.manifest.control_period_s, policy.layout.task_text
    commands = [*commands]
    ride_s = period_s * max((len(command.plan or ()) for command in commands), default=0)
    each = any(command.reason == Event.EPISODE.value for command in commands)
    config = ControllerConfig(limits, period_s, needs_rearm, is_armed, task, ride_s, each)
    return Controller(config)


def _answer(
    controller: Controller, policy: Policy, state: State, exchange: Exchange
) -> Order | None:
    """Return the runtime's answer to the state, None where only its watchdog would send one."""
    recorded, arrived_s, sent_s = exchange
    layout, begun_s = policy.layout, max(arrived_s, sent_s - recorded.inference_ns * 1e-9)
    if not recorded.inference_ns:
        begun_s = sent_s = arrived_s
    _watchdog(controller, begun_s)
    if recorded.mode == DRIVE and controller.waits_for_rearm:
        controller.rearm(arrived_s)
    controller.begin(Received(state, arrived_s, recorded.received_ns), begun_s)
    if recorded.reason == Event.TOO_LONG.value and not recorded.inference_ns:
        return controller.tick(begun_s + policy.manifest.control_period_s + JUST_AFTER_S)
    output = None
    if layout.refusal(state.observation) is None and not is_foreign(state, layout.task_text):
        output, _ = infer(policy, layout.arrays(state.observation))
    # The recording lacks a vehicle fault's duration, which does not matter: the stop is latched.
    fault, is_new = Event.VEHICLE.value, recorded.reason != controller.safety.reason
    if recorded.reason == fault and is_new:
        controller.vehicle_fault = fault
    controller.leash_is_used = recorded.reason == Event.LEASH.value and is_new
    order = controller.finish(output, 1, sent_s)
    controller.vehicle_fault, controller.leash_is_used = "", False
    return order if recorded.inference_ns else None


def _watchdog(controller: Controller, until_s: float) -> None:
    """Let the runtime's deadlines until a time pass; a stop's repetitions are skipped."""
    while controller.safety.mode is Mode.DRIVE:
        due_s = controller.next_deadline_s()
        if due_s is None or due_s + JUST_AFTER_S > until_s:
            return
        controller.tick(due_s + JUST_AFTER_S)


def compare(rows: Iterable[Row], tolerance: float) -> dict[str, Any]:
    """Compare the answers; return the report's counts and first differences.

    Two answers are equal if mode and reason are, and no action (planned ones included) differs by
    more than ``tolerance``. States without a recorded answer are counted only.
    """
    kinds, unanswered, largest = Counter[str](), 0, 0.0
    differences: list[dict[str, Any]] = []
    for state, recorded, order in rows:
        if recorded is None:
            unanswered += 1
            continue
        kinds[f"{recorded.mode}: {recorded.reason}".removesuffix(": ")] += 1
        distance = _distance(recorded, order)
        largest = max(largest, distance if distance < math.inf else 0.0)
        if distance > tolerance:
            place = dict(zip(("session", "episode", "step"), key_of(state), strict=True))
            replayed = None if order is None else _row(order)
            differences.append({**place, "recorded": _row(recorded), "replayed": replayed})
    return {
        "compared": kinds.total(),
        "unanswered": unanswered,
        "different": len(differences),
        "largest_difference": largest,
        "tolerance": tolerance,
        "by_recorded": dict(kinds),
        "first_differences": differences[:SHOWN_DIFFERENCES],
    }


def draw(rows: Iterable[Row], names: Sequence[str]) -> Any:
    """Draw recorded and replayed answers, state by state, a panel for each action."""
    from matplotlib.figure import Figure

    answers = [(recorded.action, order.action if order else ())
               for _, recorded, order in rows if recorded]  # fmt: skip
    names = names[:MOST_PANELS]
    figure = Figure(figsize=(10, 1 + 1.8 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), squeeze=False, sharex=True)[:, 0]
    for place, (name, panel) in enumerate(zip(names, panels, strict=True)):
        for number, look in enumerate(({"label": "recorded"}, {"label": "replayed", "ls": "--"})):
            values = [[*each[number], *[math.nan] * len(names)][place] for each in answers]
            panel.plot(values, **look)
        panel.set_ylabel(name)
    panels[0].legend(fontsize=8)
    panels[-1].set_xlabel("answered states, in their order")
    return figure


def _row(answer: Command | Order) -> dict[str, Any]:
    plan = [value for action in answer.plan or () for value in action]
    return {"mode": answer.mode, "reason": answer.reason, "action": [*answer.action, *plan]}


def _distance(recorded: Command, order: Order | None) -> float:
    """Return the largest difference of two actions; inf for another mode, reason or size."""
    if order is None or (recorded.mode, recorded.reason) != (order.mode, order.reason):
        return math.inf
    ours, theirs = _row(recorded)["action"], _row(order)["action"]
    if len(ours) != len(theirs):
        return math.inf
    return max((abs(a - b) for a, b in zip(ours, theirs, strict=True)), default=0.0)
