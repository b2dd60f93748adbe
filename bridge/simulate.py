"""``python -m bridge simulate``: serve an environment to an edge runtime, and write a report."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from bridge import environments, report
from bridge.clocks import CLOCKS, LOCKSTEP, REALTIME, Clock, LockStepClock, VehicleClock
from bridge.environments import CONDITIONS, Adapter, Environment, make_environment
from bridge.inbound import NO_COMMAND, CommandCheck, Decision
from bridge.messages import Origin, Scene
from bridge.outcomes import outcome_of
from bridge.ports import EdgeStatus, SimulatorPort, add_options, open_port
from bridge.report import EpisodeResult, of_known
from edge_runtime import cli
from edge_runtime.config import NONE
from edge_runtime.files import write_json_out
from edge_runtime.manifest import Task
from edge_runtime.safety import Event
from edge_runtime.transport import DEFAULT_ENDPOINT, rearm_command, run_command, tls_for
from edge_runtime.util import UserError
from edge_runtime.wire import SAFE_STOP, State

POLICY, VEHICLE = LOOPS = ("policy", "vehicle")
PEDAL = "pedal"
EXAMPLE = cli.examples(
    "python -m bridge simulate --env Pendulum-v1 --episodes 5 \\\n"
    "      --clock realtime --latency 50ms+-10ms",
    "python -m bridge simulate --env SCENARIO --clock realtime --loop vehicle --vehicle-id car-a",
)


def add_arguments(parser: cli.ArgumentParser) -> None:
    add = parser.add_argument
    env = f"scenario ({', '.join(environments.scenarios())}), gymnasium id or module:id"
    scene = "scene; " + "; ".join(f"{name}: {meaning}" for name, meaning in CONDITIONS.items())
    clock = "lockstep waits for each command, realtime never waits"
    loop = "the car follows the policy's commands, or (realtime only) the reports of the vehicle"
    loop += " behind the edge runtime"
    period = "control period in s (default: the environment's, else guessed from render_fps)"
    add("--env", metavar="ENV", required=True, help=env)
    add("--condition", choices=CONDITIONS, default=environments.NOMINAL, help=scene)
    add("--episodes", metavar="N", type=cli.positive, default=1, help="episodes to drive")
    add("--period", metavar="SECONDS", type=cli.positive_number, help=period)
    add("--clock", choices=sorted(CLOCKS), default=LOCKSTEP, help=clock)
    add("--loop", choices=LOOPS, default=POLICY, help=loop)
    where = parser.add_mutually_exclusive_group()
    add_options(where, "--listen", default=DEFAULT_ENDPOINT)
    add_options(
        where, "--connect", default=None, help="connect to this router instead of listening"
    )
    add_options(parser, "--tls", "--latency", "--wait-edge-s", "--out")
    add_options(parser, "--vehicle-id", help="id of the vehicle to simulate")
    add_options(parser, "--seed", help="seed of the first episode; each next episode adds 1")


def run(asked: Namespace) -> int:
    if asked.loop == VEHICLE and asked.clock != REALTIME:
        raise UserError("--loop vehicle needs --clock realtime: a real vehicle does not pause")
    endpoint, wait_s = asked.connect or asked.listen, asked.wait_edge_s
    tls = tls_for(asked.tls, endpoint)
    with ExitStack() as stack:
        environment = stack.enter_context(closing(make_environment(asked.env, asked.condition)))
        stack.enter_context(cli.sigterm_as_interrupt())
        task = environments.describe(environment, asked.period)
        opened = open_port(asked.listen, asked.vehicle_id, tls, asked.connect, wait_s)
        port = stack.enter_context(opened)
        kind = VehicleClock if asked.loop == VEHICLE else CLOCKS[asked.clock]
        check = CommandCheck(port.session, task)
        clock = stack.enter_context(closing(kind(port.publish_state, check, asked.latency)))
        port.hear("command", clock.receive)
        here = (endpoint, asked.vehicle_id, tls)
        edge = port.wait_for_edge(wait_s, start := run_command(*here))
        if isinstance(clock, VehicleClock):
            port.hear("feedback", clock.receive_feedback)
            clock.wait_for_vehicle(wait_s, f"{start} --vehicle NAME")
        results = _drive(asked, environment, port, clock, edge, rearm_command(*here))
    write_json_out(asked.out, results)
    print(report.summary_line(results))
    if results["interrupted"]:
        print(f"interrupted before the end of {asked.episodes} episodes", file=sys.stderr)
    return cli.INTERRUPTED if results["interrupted"] else 0


def _drive(
    asked: Namespace,
    environment: Environment,
    port: SimulatorPort,
    clock: Clock,
    edge: EdgeStatus,
    rearm: str,
) -> dict[str, Any]:
    vehicle = clock if isinstance(clock, VehicleClock) else None
    how = {n: getattr(asked, n) for n in ("condition", "seed", "clock", "loop")}
    how["standing"] = vehicle is not None
    network, task = str(asked.latency), clock.task
    if is_same := edge.manifest.text == task.text:
        task = msgspec.structs.replace(task, action=edge.manifest.action)  # with the policy's stops
    origin = Origin(session=port.session, environment=asked.env, latency=network, **how)
    rearm = "" if edge.vehicle == NONE else rearm
    runner = EpisodeRunner(environment, clock, port.publish_scene, task, origin, rearm)
    if not is_same:
        runner.show_task(asked.seed)
        time.sleep(task.control_period_s)  # So that its safe stop still finds our end of the wire.
        raise other_task(task)
    results: list[EpisodeResult] = []
    try:
        with report.ProgressBar("episodes", asked.episodes) as bar:
            for episode in range(asked.episodes):
                if vehicle is not None:
                    vehicle.wait_for_standstill()
                results.append(runner.run(episode, asked.seed + episode))
                bar.advance({"last": results[-1].outcome})
    except KeyboardInterrupt:  # The report covers the episodes that were driven to their end.
        if not results:
            raise
    after, by_simulator = port.edge_status(), clock.rejected()
    by_edge = after.rejected_since(edge) if after else Counter[str]()
    facts = {
        "scenario": task.task,
        **how,
        "latency_spec": network,
        "interrupted": len(results) < asked.episodes,
        "policy_ids": clock.check.policy_ids,
        "deadline_misses": runner.deadline_misses,
        "missed_ticks": clock.missed_ticks,
        "wall_clock_stalls": clock.wall_clock_stalls,
        "rejected": dict(by_edge + by_simulator),
        "rejected_by_edge": dict(by_edge),
        "rejected_by_simulator": dict(by_simulator),
        "vehicle": vehicle and {"name": vehicle.vehicle, "faults": dict(vehicle.faults)},
    }
    return report.make_report(results, runner.safe_stops.events, clock.latencies_ms, facts)


def other_task(task: Task) -> UserError:
    return UserError(
        f"the edge runtime's policy is for another task than --env ({task.text!r}); start it with"
        " a policy of this one, or choose another --env"
    )


def policy_action(adapter: Adapter, decision: Decision) -> np.ndarray:
    """Return the command's action, the safe stop's, or (before the first command) zero."""
    adapter.press_brake(bool(decision.brake_reason))
    if decision.brake_reason:
        return adapter.stop()
    if decision.command is None:
        return adapter.hands_off
    return adapter.within(decision.command.action)


def vehicle_action(adapter: Adapter, decision: Decision) -> np.ndarray:
    """Return the action that the vehicle's actuators have reached; the safe stop without feedback.

    If the environment has ``pedal_for_speed``, the pedal is the one that leads to the vehicle's
    reported speed: errors of pedals would add up.
    """
    adapter.press_brake(bool(decision.brake_reason))
    if decision.feedback is None:
        return adapter.stop()
    pedal_for_speed = environments.offered(adapter.env, "pedal_for_speed")
    speed_mps, action = decision.feedback.scenario_speed_mps, list(decision.feedback.action)
    for place, row in enumerate(adapter.task.action):
        if row.name == PEDAL and speed_mps is not None and pedal_for_speed is not None:
            action[place] = float(pedal_for_speed(speed_mps))
    return adapter.within(action)


@dataclass
class EpisodeRunner:
    """Drives one environment through a clock and collects figures for the report."""

    environment: Environment
    clock: Clock
    publish_scene: Callable[[Any, Scene], None]
    """Called with the environment, and the fields to add to its scene."""
    task: Task
    origin: Origin
    """Sent with every scene; each episode has a seed of its own."""
    rearm_command: str = ""  # What an operator types; empty without a vehicle

    def __post_init__(self) -> None:
        self._period_s = self.task.control_period_s
        self.safe_stops = report.SafeStopLog()
        self._adapter = Adapter(self.environment, self.task)
        self.deadline_misses = 0

    def show_task(self, seed: int) -> None:
        """Send one final state, so that the edge runtime also detects the different task.

        The state holds no observation: another policy's may have another size.
        """
        self.clock.begin(0, seed)
        self.clock.finish(self._state(0, 0, None, {}, final=True))

    def run(self, episode: int, seed: int) -> EpisodeResult:
        """Drive one episode to its end; the seed decides the environment and the link.

        If it is cut short (^C, a fault of the environment), a final state is sent, too: the edge
        runtime goes to standby instead of stopping for a lost link.
        """
        self._under_way: State | None = None
        try:
            return self._drive(episode, seed)
        except BaseException:
            if (cut := self._under_way) is not None:
                self.clock.finish(msgspec.structs.replace(cut, step=cut.step + 1, final=True))
            raise

    def _drive(self, episode: int, seed: int) -> EpisodeResult:
        options = {"standing": True} if self.origin.standing else None
        observation, info = self.environment.reset(seed=seed, options=options)
        self.clock.begin(episode, seed)
        self._adapter.last = self._adapter.hands_off
        self.origin = msgspec.structs.replace(self.origin, seed=seed)
        result = EpisodeResult(seed)
        applied: dict[str, Any] = {}  # The scene's fields about the last step
        accelerations, ended, waited, waits = [], False, 0, bool(self.rearm_command)
        apply = vehicle_action if isinstance(self.clock, VehicleClock) else policy_action
        while not ended:
            state = self._state(episode, waited + result.steps, observation, info)
            self._show(state, {**applied, "waited": waited})
            self._under_way = state
            decision = self.clock.exchange(state)
            if decision.brake_reason == Event.OTHER_TASK.value:
                raise other_task(self.task)
            if waits and (command := decision.command) and decision.brake_reason != NO_COMMAND:
                # A person may take minutes: until then states go on, without steps.
                waits = command.mode == SAFE_STOP
                if waits:
                    if not waited:
                        say = f"episode {episode}: the vehicle waits for a re-arm"
                        print(f"{say} ({command.reason}): {self.rearm_command}", file=sys.stderr)
                    # Real time keeps its pace by itself.
                    time.sleep(self._period_s * isinstance(self.clock, LockStepClock))
                    waited += 1
                    continue
            action = apply(self._adapter, decision)
            observation, reward, terminated, truncated, info = self.environment.step(action)
            result.steps += 1
            result.actions.append([float(value) for value in action.ravel()])
            result.reward += environments.finite("reward", reward)
            accelerations.append(report.accelerations(info))
            self.deadline_misses += not decision.fresh
            self.safe_stops.observe(episode, state.step, decision)
            braked = bool(decision.brake_reason)
            applied = {"applied": result.actions[-1], "braked": braked, "ridden": decision.ridden}
            ended = bool(terminated or truncated)
        steps = waited + result.steps
        final = self._state(episode, steps, observation, info, final=True)
        self._show(final, {**applied, "waited": waited})
        self.clock.finish(final)
        self._under_way = None
        result.outcome = outcome_of(info, only_truncated=not terminated)
        result.distance_m = report.number_of(info, "distance_m") or 0.0
        result.time_s = round(result.steps * self._period_s, 6)
        result.lateral_acceleration_mps2, result.longitudinal_acceleration_mps2 = map(
            of_known, zip(*accelerations, strict=True)
        )
        return result

    def _state(
        self, episode: int, step: int, observation: Any, info: dict[str, Any], final: bool = False
    ) -> State:
        return State(
            session=self.origin.session,
            episode=episode,
            step=step,
            sim_time_s=round(step * self._period_s, 6),
            sent_ns=0,  # The clock stamps it when it sends it.
            observation={} if observation is None else self._adapter.pack(observation),
            speed_mps=report.number_of(info, "speed_mps"),
            final=final,
            task=self.task.text,
        )

    def _show(self, state: State, applied: dict[str, Any]) -> None:
        step, round_trip_ms = self.clock.newest_answer() or (None, None)
        stamps = Scene(
            episode=state.episode, step=state.step, sim_time_s=state.sim_time_s,
            round_trip_ms=round_trip_ms, answered_step=step, rejected=dict(self.clock.rejected()),
            task=self.task, origin=self.origin, **applied,
        )  # fmt: skip
        self.publish_scene(self.environment, stamps)
