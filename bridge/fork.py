"""``python -m bridge fork``: rebuild a recorded drive up to a moment, and drive on in another way.

The scene is rebuilt from its seed and from the action of every step; each step is compared with the
recorded one, to the bit. From the fork on it is an ordinary drive in lock-step: a policy inside the
edge runtime's decision logic, behind a network that has carried the recorded commands until then.
So the same policy behind the same network repeats a drive of lock-step.

A person forks a drive in the trainer: the bridge imports nothing of it, and runs its command.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from argparse import Namespace
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np

from bridge.clocks import LockStepClock
from bridge.environments import Adapter, Environment, describe, make_environment, scene_of
from bridge.episode import EpisodeRunner, policy_action
from bridge.inbound import CommandCheck
from bridge.messages import ENCODER, STAMPS, Heard, Origin, Scene
from bridge.network import LatencySpec, parse_spec
from bridge.ports import add_options, scene_payload
from bridge.record import RecordingWriter, new_recording
from bridge.recording import Recording, choose_vehicle, valid_messages
from bridge.replay import controller_of
from bridge.report import EpisodeResult
from bridge.virtual_link import Arrival, Decision
from edge_runtime import cli
from edge_runtime.config import add_trust
from edge_runtime.controller import Received, shared_limits
from edge_runtime.files import write_atomic, write_json_out
from edge_runtime.manifest import Task
from edge_runtime.policy import Policy, infer, load_policy
from edge_runtime.util import UserError, counted, name_in_file, printable
from edge_runtime.wire import DRIVE, Command, State, encode


@dataclass
class RecordedEpisode:
    """One episode of a recording, by step; ``number`` is its place among them, from 0."""

    path: Path
    vehicle_id: str
    number: int
    origin: Origin
    episode: int
    task: Task
    began_ns: int
    scenes: dict[int, bytes] = field(default_factory=dict)  # As `_own_scene` returns them
    states: dict[int, list[State]] = field(default_factory=dict)  # A network loses and repeats
    commands: dict[int, Command] = field(default_factory=dict)  # First answer to each state
    applied: dict[int, tuple[list[float], bool]] = field(default_factory=dict)
    """Of each step: the action, and whether the brake was pressed."""

    def take(self, payload: bytes, message: Any) -> None:
        origin = message.origin if isinstance(message, Scene) else message
        key = getattr(origin, "session", None), getattr(message, "episode", None)
        if key != (self.origin.session, self.episode):
            return
        if isinstance(message, State):
            self.states.setdefault(message.step, []).append(message)
        elif isinstance(message, Command):
            self.commands.setdefault(message.step, message)
        elif isinstance(message, Scene):
            self.scenes[message.step] = _own_scene(payload)
            action = message.applied or []
            if len(action) == len(self.task.action) and np.isfinite(action).all():
                self.applied[message.step - 1] = action, message.braked

    @property
    def steps(self) -> int:
        """How many steps from the first on have a recorded action."""
        return next(n for n in range(len(self.applied) + 1) if n not in self.applied)

    @property
    def ended(self) -> bool:
        return any(state.final for state in self.states.get(self.steps, ()))

    def step_at(self, at_s: float) -> int:
        """Return the first step from that time on; UserError where it is not recorded."""
        period_s = self.task.control_period_s
        step = math.ceil(at_s / period_s - 1e-6)
        if step >= self.steps:
            end_s = self.steps * period_s
            raise UserError(f"{self.path}: the drive is known for {end_s:g} s; fork before")
        return step

    def environment(self, named: str | None = None, option: str = "--env") -> Environment:
        """Make the environment, or the one ``named`` by the option that a person typed.

        UserError where there is none, or where its task has changed.
        """
        name = named or name_in_file(self.origin.environment, f"{self.path} was driven in", option)
        made = make_environment(name, self.origin.condition)
        if (now := describe(made, self.task.control_period_s).text) != self.task.text:
            raise UserError(f"{self.path} was driven in {self.task.text!r}, and {name} is {now!r}")
        return made

    def check(self, step: int, observation: dict[str, bytes], environment: Any) -> None:
        differs = {
            f"the observation {name!r}"
            for state in self.states.get(step, ())
            for name, data in observation.items()
            if state.observation.get(name) != data
        }
        known, scene = self.scenes.get(step), scene_of(environment)
        if known is not None and scene is not None and _own_scene(ENCODER.encode(scene)) != known:
            differs.add("the scene")
        if differs:
            where = f"at step {step} ({step * self.task.control_period_s:g} s)"
            why = f"{where} {min(differs)} is another than recorded"
            raise UserError(f"{self.path}: the drive cannot be rebuilt: {why}")

    def redo(self, step: int, adapter: Adapter) -> np.ndarray:
        action, braked = self.applied[step]
        adapter.press_brake(braked)
        return adapter.within(action)


def _own_scene(payload: bytes) -> bytes:
    fields = msgspec.msgpack.decode(payload)
    return msgspec.msgpack.encode({n: v for n, v in fields.items() if n not in STAMPS})


def read_episode(path: Path, vehicle_id: str | None, number: int | None) -> RecordedEpisode:
    """Read an episode; ``number`` None: the only one."""
    recording = Recording(path)
    vehicle_id = choose_vehicle(recording, vehicle_id)
    begun: dict[tuple[str, int], tuple[Origin, int, Task, int]] = {}
    for heard, message in valid_messages(recording, vehicle_id):
        if isinstance(message, Scene) and message.origin is not None and message.task is not None:
            about = message.origin, message.episode, message.task, heard.arrived_ns
            begun.setdefault((message.origin.session, message.episode), about)
    recording.say_missing()
    if not begun:
        raise UserError(f"{path} does not say how its drives were begun: it holds no scenes")
    number = 0 if number is None and len(begun) == 1 else number
    if number is None or number >= len(begun):
        which = f"--episode says which, 0 to {len(begun) - 1}"
        raise UserError(f"{path} holds {counted(len(begun), 'drive')}; {which}")
    drive = RecordedEpisode(path, vehicle_id, number, *list(begun.values())[number])
    for heard, message in valid_messages(recording, vehicle_id):
        drive.take(heard.payload, message)
    return drive


class ForkedEnvironment(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose every episode begins where a recorded drive is forked."""

    def __init__(self, environment: Any, drive: RecordedEpisode, step: int) -> None:
        super().__init__(environment)
        self._drive, self._fork = drive, step

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        drive, adapter = self._drive, Adapter(self.env, self._drive.task)
        options = {"standing": True} if drive.origin.standing else None
        seen, info = self.env.reset(seed=drive.origin.seed, options=options)
        for step in range(self._fork):
            drive.check(step, adapter.pack(seen), self.env)
            seen, *_, info = self.env.step(drive.redo(step, adapter))
        drive.check(self._fork, adapter.pack(seen), self.env)
        adapter.press_brake(False)
        return seen, info


class ForkedDrive(LockStepClock):
    """A recorded drive in virtual time: as recorded before step ``fork``, then by ``policy``.

    It publishes nothing. ``network`` carries what is sent from the fork on (None: the recorded
    network); ``out`` records the drive. Without a policy, ``fork`` must be the drive's end.
    """

    def __init__(
        self,
        drive: RecordedEpisode,
        environment: Environment,
        fork: int,
        policy: Policy | None = None,
        network: LatencySpec | None = None,
        out: RecordingWriter | None = None,
    ) -> None:
        self._drive, self._environment, self._fork, self._out = drive, environment, fork, out
        self._recorded, task, self._step = parse_spec(drive.origin.latency), drive.task, 0
        self.network, self._policy, self._now_s = network or self._recorded, policy, 0.0
        self.first_difference: int | None = None
        """The first step whose action or brake is not as recorded."""
        if policy is not None:
            if policy.manifest.text != task.text:
                theirs = policy.manifest.text
                raise UserError(f"the policy is for {theirs!r}, {drive.path} is of {task.text!r}")
            task = msgspec.structs.replace(task, action=policy.manifest.action)
            plans = max((len(command.plan or ()) for command in drive.commands.values()), default=0)
            limits = shared_limits(policy.manifest.action, {})
            self._controller = controller_of(policy, limits, plans, needs_rearm=False)
        super().__init__(lambda payload: None, CommandCheck("", task), self._recorded, task)

    def run(self) -> EpisodeResult:
        """Drive to the end. UserError where the drive cannot be rebuilt until the fork."""
        changed = {"session": "fork", "latency": str(self.network)}
        origin = msgspec.structs.replace(self._drive.origin, **changed)
        shown = self._show, lambda *_: None
        runner = EpisodeRunner(self._environment, self, *shown, self.task, origin, self._apply)
        result = runner.run(0, origin.seed)
        if result.steps <= self._fork:
            self._drive.check(result.steps, self._last.observation, self._environment)
        if result.steps < self._fork or (self._policy is None and result.steps > self._fork):
            raise UserError(f"{self._drive.path}: the drive cannot be rebuilt: it ends elsewhere")
        return result

    def exchange(self, state: State) -> Decision:
        """Compare the state with the recorded one until the fork, and go on as in lock-step."""
        self._step = state.step
        if state.step <= self._fork:
            self._drive.check(state.step, state.observation, self._environment)
        if state.step == self._fork and self.network != self._recorded:
            self._link.change(self.network, self._drive.origin.seed)
        return super().exchange(state)

    def finish(self, state: State) -> None:
        self._last = state
        self._write("state", state, state.sim_time_s)

    def _apply(self, adapter: Adapter, decision: Decision) -> np.ndarray:
        if self._step < self._fork:
            return self._drive.redo(self._step, adapter)
        action = policy_action(adapter, decision)
        done = [float(value) for value in action.ravel()], bool(decision.brake_reason)
        if self.first_difference is None and self._drive.applied.get(self._step) != done:
            self.first_difference = self._step
        return action

    def _arrive_at_edge(self, arrival: Arrival[State]) -> None:
        # Before the fork as the edge runtime did, then as the policy does
        if arrival.overtaken:
            return
        sent_ns = self._at_ns(arrival.arrived_s)
        state = msgspec.structs.replace(arrival.message, sent_ns=sent_ns)
        command, given = self._drive.commands.get(arrival.step), self._step < self._fork
        if self._policy is not None:
            answer = self._answer(self._policy, state, command if given else None)
            command = command if given else answer
        self._write("state", state, arrival.arrived_s)
        if command is not None:
            stamps: dict[str, Any] = {"received_ns": sent_ns, "sent_ns": sent_ns, "inference_ns": 0}
            stamps |= {"session": state.session, "episode": state.episode}
            told = msgspec.structs.replace(command, **stamps)
            self._write("command", told, arrival.arrived_s)
            self._link.answer(arrival, command)

    def _answer(self, policy: Policy, state: State, known: Command | None) -> Command | None:
        """Return the policy's command, from decision logic to which no state comes late.

        ``known`` is the recorded answer before the fork: limits and stops go on from there.
        """
        self._now_s += policy.manifest.control_period_s
        self._controller.begin(Received(state, self._now_s, state.sent_ns), self._now_s)
        if known is not None and known.mode == DRIVE:
            output: np.ndarray | None = np.array(known.action, np.float32)
        else:
            output, _ = infer(policy, policy.layout.arrays(state.observation))
        order = self._controller.finish(output, 0, self._now_s)
        return order and order.command(policy.policy_id, state.sent_ns)

    def _show(self, environment: Environment, stamps: Scene) -> None:
        if self._out is not None:
            self._write("scene", scene_payload(environment, stamps), stamps.sim_time_s)

    def _write(self, topic: str, message: State | Command | bytes, at_s: float) -> None:
        if self._out is not None:
            payload = message if isinstance(message, bytes) else encode(message)
            key = f"phil/{self._drive.vehicle_id}/{topic}"
            self._out.write(Heard(key, topic, payload, self._at_ns(at_s), len(payload)))

    def _at_ns(self, at_s: float) -> int:
        return self._drive.began_ns + round(at_s * 1e9)


def _seconds(text: str) -> float:
    return cli.seconds(text.removesuffix("s"))


def add_place(parser: Any) -> None:
    at, which = "time of the fork in the drive, as 12.3s", "number of the drive, from 0"
    parser.add_argument("--at", metavar="T", type=_seconds, default=0.0, help=at)
    parser.add_argument("--episode", metavar="K", type=cli.not_negative, help=which)
    several = "the vehicle, if the recording holds several"
    add_options(parser, "--vehicle-id", default=None, help=several)


def find_fork(recording: str, asked: Namespace) -> tuple[RecordedEpisode, int]:
    drive = read_episode(Path(recording), asked.vehicle_id, asked.episode)
    return drive, drive.step_at(asked.at)


def _add_fork_arguments(parser: Any) -> None:
    add = parser.add_argument
    add("recording", metavar="F.mcap", type="path", help="a file of bridge record")
    add_place(parser)
    module = "the environment, if it is in a module: no file decides what is imported"
    add("--env", metavar="ENV", help=module)
    add_options(parser, "--out")
    policy = "the policy that drives on (default: the drive is rebuilt to its end)"
    human = "you drive on: `python -m trainer drive --from`, which has more options"
    record = "record the fork, as `bridge record` does; with --human a directory"
    add("--policy", metavar="POLICY.onnx", type="path", help=policy)
    add_trust(parser)
    add_options(parser, "--latency", default=None, help="another network, as for `bridge simulate`")
    add("--human", metavar="web", help=human)
    add("--record", metavar="G.mcap", help=record)


def _run_fork(asked: Namespace) -> int:
    """Fork the drive, and print and write what came of it."""
    if asked.human is not None:
        return _hand_over(asked)
    record = asked.record and new_recording(asked.record)
    drive, fork = find_fork(asked.recording, asked)
    trust = asked.public_key, asked.allow_unsigned
    policy = None if asked.policy is None else load_policy(asked.policy, *trust)
    if policy is None and (asked.latency is not None or not drive.ended):
        why = "another network" if asked.latency is not None else "a drive not recorded to its end"
        raise UserError(f"{why} needs a policy that drives on: --policy POLICY.onnx")
    with ExitStack() as stack:
        environment = stack.enter_context(closing(drive.environment(asked.env)))
        recorded = ForkedDrive(drive, environment, drive.steps).run() if drive.ended else None
        out, made = None, Path(stack.enter_context(tempfile.TemporaryDirectory()), "fork.mcap")
        if record:
            out = stack.enter_context(closing(RecordingWriter(made)))
        begun = drive.steps if policy is None else fork
        forked = ForkedDrive(drive, environment, begun, policy, asked.latency, out)
        found = forked.run()
        if out:
            out.finish(dropped=0)
            write_atomic(record, made.read_bytes())
    first, period_s = forked.first_difference, drive.task.control_period_s
    report = {
        "recording": asked.recording,
        "episode": drive.number,
        "origin": msgspec.structs.asdict(drive.origin),
        "at_s": round(fork * period_s, 6),
        "latency_spec": str(forked.network),
        "policy_id": "" if policy is None else policy.policy_id,
        "recorded_policy_ids": sorted({each.policy_id for each in drive.commands.values()}),
        "recorded": None if recorded is None else asdict(recorded),
        "fork": asdict(found),
        "differs_from_s": None if first is None else round(first * period_s, 6),
    }
    write_json_out(asked.out, report)
    how = "the same to the bit" if first is None else f"another from {first * period_s:g} s on"
    ends = [
        f"{end.outcome} after {end.time_s:g} s, {end.distance_m:.2f} m" if end else "not to its end"
        for end in (recorded, found)
    ]
    at = f"forked at {fork * period_s:g} s"
    print(printable(f"recorded: {ends[0]}; {at}: {ends[1]}; {how}"))
    return 0


def _hand_over(asked: Namespace) -> int:
    """Let the trainer's command take this process's place: it has the screen and the signals."""
    if asked.latency is not None or asked.out is not None:
        raise UserError("--human takes no --latency and no --out: it drives without a network")
    given = {
        "--at": asked.at, "--human": asked.human, "--episode": asked.episode,
        "--vehicle-id": asked.vehicle_id, "--scenario": asked.env, "--out": asked.record,
        "--policy": asked.policy, "--public-key": asked.public_key,
    }  # fmt: skip
    words = [str(word) for pair in given.items() if pair[1] is not None for word in pair]
    command = [sys.executable, "-m", "trainer", "drive", "--from", asked.recording, *words]
    os.execv(sys.executable, command)


FORK = cli.Subcommand(
    cli.examples(
        "python -m bridge fork drive.mcap --at 12.3s --policy other.onnx --out fork.json",
        "python -m bridge fork drive.mcap --episode 2 --at 3s --policy my.onnx --latency 80ms",
        "python -m bridge fork drive.mcap --at 12.3s --human web --record runs/forked",
    ),
    _add_fork_arguments,
    _run_fork,
)
