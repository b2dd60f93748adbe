"""``python -m bridge fork``: rebuild a recorded drive up to a moment, and drive on in another way.

The scene is rebuilt from its seed and all actions, and each observation compared, to the bit. Then
follows a drive in lock-step with a policy in this process, or a person's ``trainer drive``.
"""

from __future__ import annotations

import math
import os
import sys
from argparse import Namespace
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import msgspec

from bridge.clocks import LockStepClock
from bridge.environments import Adapter, Environment, describe, make_environment
from bridge.inbound import CommandCheck
from bridge.messages import Heard, Origin, Scene
from bridge.network import LatencySpec, parse_spec
from bridge.ports import add_options, scene_payload
from bridge.recording import (
    Recording,
    RecordingWriter,
    choose_vehicle,
    valid_messages,
    whole_recording,
)
from bridge.replay import controller_of
from bridge.report import EpisodeResult
from bridge.simulate import EpisodeRunner
from edge_runtime import cli
from edge_runtime.config import add_trust
from edge_runtime.controller import Received, shared_limits
from edge_runtime.files import write_json_out
from edge_runtime.manifest import Task
from edge_runtime.policy import Policy, infer, load_policy
from edge_runtime.util import UserError, counted, name_in_file, printable
from edge_runtime.wire import Command, State, decode_state, encode

EXAMPLE = cli.examples(
    "python -m bridge fork drive.mcap --at 12.3s --policy other.onnx --out fork.json"
)


@dataclass
class RecordedEpisode:
    """One episode of a recording, by step; ``number`` counts the episodes from 0."""

    path: Path
    vehicle_id: str
    number: int
    origin: Origin
    task: Task
    began_ns: int
    states: dict[int, State] = field(default_factory=dict)
    commands: dict[int, Command] = field(default_factory=dict)  # First answer to each state
    applied: dict[int, tuple[list[float], bool]] = field(default_factory=dict)
    """Of each step: the action, and whether the brake was pressed."""
    waited: int = 0  # Steps before the drive, in which the vehicle waited for a re-arm

    @property
    def steps(self) -> int:
        return next(n for n in range(len(self.applied) + 1) if n not in self.applied)

    def step_at(self, at_s: float) -> int:
        """Return the first step at or after a time; UserError where it is not recorded."""
        period_s = self.task.control_period_s
        step = math.ceil(at_s / period_s - 1e-6)
        if step >= self.steps:
            end_s = self.steps * period_s
            raise UserError(f"{self.path}: the drive is known for {end_s:g} s; fork before")
        return step

    def environment(self, named: str | None = None, option: str = "--env") -> Environment:
        """Make the recorded environment, or the one ``named`` by a person's ``option``.

        UserError where there is none, or where its task has changed.
        """
        name = named or name_in_file(self.origin.environment, f"{self.path} was driven in", option)
        environment = make_environment(name, self.origin.condition)
        if (now := describe(environment, self.task.control_period_s).text) != self.task.text:
            raise UserError(f"{self.path} was driven in {self.task.text!r}, and {name} is {now!r}")
        return environment


def read_episodes(
    path: Path, vehicle_id: str | None = None, number: int | None = None
) -> list[RecordedEpisode]:
    """Read all episodes; without ``number`` with all messages, else with those of this one only."""
    recording = Recording(path)
    vehicle_id = choose_vehicle(recording, vehicle_id)
    drives: dict[tuple[str, int], RecordedEpisode] = {}
    for heard, message in valid_messages(recording, vehicle_id):
        if isinstance(message, Scene) and message.origin is not None and message.task is not None:
            about = message.origin, message.task, heard.arrived_ns
            episode = RecordedEpisode(path, vehicle_id, len(drives), *about)
            episode = drives.setdefault((message.origin.session, message.episode), episode)
            episode.waited = message.waited
            applied = message.applied or []
            if len(applied) == len(episode.task.action):
                episode.applied[message.step - message.waited - 1] = applied, message.braked
        elif isinstance(message, State | Command):
            drive = drives.get((message.session, message.episode))
            if drive is not None and number in (None, drive.number):
                is_state = isinstance(message, State)
                kept: dict[int, Any] = drive.states if is_state else drive.commands
                kept.setdefault(message.step - drive.waited, message)
    recording.say_trouble()
    return list(drives.values())


class ForkedEnvironment(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose episodes all begin at the fork of a recorded drive."""

    def __init__(self, environment: Any, drive: RecordedEpisode, step: int) -> None:
        super().__init__(environment)
        self._drive, self._fork = drive, step

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Rebuild the drive; UserError where an observation differs from the recorded one."""
        drive, adapter = self._drive, Adapter(self.env, self._drive.task)
        options = {"standing": True} if drive.origin.standing else None
        observation, info = self.env.reset(seed=drive.origin.seed, options=options)
        for step in range(self._fork + 1):
            recorded = drive.states.get(step)
            if recorded is not None and recorded.observation != adapter.pack(observation):
                at = f"at step {step} ({step * drive.task.control_period_s:g} s)"
                why = f"{at} the observation differs from the recorded one"
                raise UserError(f"{drive.path}: the drive cannot be rebuilt: {why}")
            if step < self._fork:
                action, braked = drive.applied[step]
                adapter.press_brake(braked)
                observation, *_, info = self.env.step(adapter.within(action))
        adapter.press_brake(False)
        return observation, info


class ForkedDrive(LockStepClock):
    """A drive in lock-step from step ``fork`` of a recorded one, with a policy in this process.

    ``network`` None: as recorded. ``out`` records the drive.
    """

    def __init__(
        self,
        drive: RecordedEpisode,
        environment: Environment,
        fork: int,
        policy: Policy,
        network: LatencySpec | None = None,
        out: RecordingWriter | None = None,
    ) -> None:
        if policy.manifest.text != drive.task.text:
            theirs = policy.manifest.text
            raise UserError(f"the policy is for {theirs!r}, {drive.path} is of {drive.task.text!r}")
        self._drive, self._fork, self._policy, self._out = drive, fork, policy, out
        self._environment = ForkedEnvironment(environment, drive, fork)
        limits = shared_limits(policy.manifest.action, {})
        self._controller = controller_of(policy, limits, drive.commands.values())
        self._newest, self._now_ns = -1, drive.began_ns
        task = msgspec.structs.replace(drive.task, action=policy.manifest.action)
        network = network or parse_spec(drive.origin.latency)
        super().__init__(self._answer, CommandCheck("fork", task), network)

    def run(self) -> EpisodeResult:
        """Drive to the end; UserError where the drive cannot be rebuilt until the fork."""
        changed = {"session": "fork", "latency": str(self.spec)}
        origin = msgspec.structs.replace(self._drive.origin, **changed)
        runner = EpisodeRunner(self._environment, self, self._show, self.task, origin)
        return runner.run(0, origin.seed)

    def _answer(self, payload: bytes) -> None:
        """Answer a state as an edge runtime that receives no state late."""
        state = decode_state(payload)
        assert isinstance(state, State)
        if state.step <= self._newest:
            return
        self._newest = state.step
        self._now_ns += round(self.task.control_period_s * 1e9)
        now_s, state = self._now_ns * 1e-9, msgspec.structs.replace(state, sent_ns=self._now_ns)
        self._controller.begin(Received(state, now_s, self._now_ns), now_s)
        output, inference_ns = infer(self._policy, self._policy.layout.arrays(state.observation))
        order = self._controller.finish(output, inference_ns, now_s)
        self._record("state", encode(state))
        if order is not None:
            command = encode(order.command(self._policy.policy_id, self._now_ns))
            self._record("command", command)
            self.receive(command)

    def _show(self, environment: Environment, stamps: Scene) -> None:
        self._record("scene", scene_payload(environment, stamps))

    def _record(self, topic: str, payload: bytes) -> None:
        if self._out is not None:
            key = f"phil/{self._drive.vehicle_id}/{topic}"
            self._out.write(Heard(key, topic, payload, self._now_ns, len(payload)))


def add_place(parser: Any) -> None:
    at, which = "time of the fork in the drive, as 12.3s", "number of the drive, from 0"
    at_s = {"type": lambda text: cli.seconds(text.removesuffix("s")), "default": 0.0}
    parser.add_argument("--at", metavar="T", **at_s, help=at)
    parser.add_argument("--episode", metavar="K", type=cli.not_negative, help=which)
    several = "the vehicle, if the recording holds several"
    add_options(parser, "--vehicle-id", default=None, help=several)


def find_fork(recording: str, arguments: Namespace) -> tuple[RecordedEpisode, int]:
    """Return the drive that the options name, or the only one, and the step of the fork."""
    drives = read_episodes(Path(recording), arguments.vehicle_id, arguments.episode)
    number = 0 if arguments.episode is None and len(drives) == 1 else arguments.episode
    if number is None or number >= len(drives):
        which = f"{counted(len(drives), 'drive')} with scenes; --episode says which, from 0"
        raise UserError(f"{recording} holds {which}")
    return drives[number], drives[number].step_at(arguments.at)


def add_arguments(parser: Any) -> None:
    add = parser.add_argument
    add("recording", metavar="F.mcap", type="path", help="a file of bridge record")
    add_place(parser)
    add("--env", metavar="ENV", help="the environment, where it is in a module")
    add("--policy", metavar="POLICY.onnx", type="path", help="drives on (default: rebuild only)")
    add_trust(parser)
    add_options(parser, "--latency", default=None, help="another network, as for `bridge simulate`")
    human = "you drive on: `python -m trainer drive --from`, which has more options"
    add("--human", metavar="web", help=human)
    record = "record the fork, as `bridge record` does; with --human a directory"
    add("--record", metavar="G.mcap", type="path", help=record)
    add_options(parser, "--out")


def run(arguments: Namespace) -> int:
    if arguments.human is not None:
        _hand_over(arguments)
    drive, fork = find_fork(arguments.recording, arguments)
    at_s, result, policy = fork * drive.task.control_period_s, None, None
    if arguments.policy is not None:
        policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    with closing(drive.environment(arguments.env)) as environment:
        if policy is None:
            ForkedEnvironment(environment, drive, drive.steps).reset()
        else:
            with whole_recording(arguments.record) if arguments.record else nullcontext() as out:
                result = ForkedDrive(drive, environment, fork, policy, arguments.latency, out).run()
    report = {
        "recording": arguments.recording,
        "episode": drive.number,
        "origin": msgspec.structs.asdict(drive.origin),
        "at_s": round(at_s, 6),
        "latency_spec": str(arguments.latency or drive.origin.latency),
        "policy_id": policy.policy_id if policy else "",
        "recorded_policy_ids": sorted({each.policy_id for each in drive.commands.values()}),
        "fork": result and asdict(result),
    }
    write_json_out(arguments.out, report)
    end = f"forked at {at_s:g} s: {result.outcome} {result.time_s:g} s later" if result else ""
    print(printable(end or "rebuilt to its end, to the bit"))
    return 0


def _hand_over(arguments: Namespace) -> None:
    """Replace this process by the trainer's command, which gets the terminal and the signals."""
    if arguments.latency is not None or arguments.out is not None:
        raise UserError("--human takes no --latency and no --out: it drives without a network")
    options = {
        "--at": arguments.at, "--human": arguments.human, "--episode": arguments.episode,
        "--vehicle-id": arguments.vehicle_id, "--scenario": arguments.env,
        "--out": arguments.record, "--policy": arguments.policy,
        "--public-key": arguments.public_key,
    }  # fmt: skip
    words = [str(word) for pair in options.items() if pair[1] is not None for word in pair]
    command = [sys.executable, "-m", "trainer", "drive", "--from", arguments.recording, *words]
    os.execv(sys.executable, command)
