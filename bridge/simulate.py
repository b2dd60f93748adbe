"""``python -m bridge simulate``: serve an environment to an edge runtime, and write a report."""

from __future__ import annotations

import time
from argparse import Namespace
from contextlib import ExitStack, closing
from typing import Any

import msgspec

from bridge.clocks import CLOCKS, LOCKSTEP, REALTIME, Clock, VehicleClock
from bridge.environments import (
    CONDITIONS,
    NOMINAL,
    Environment,
    describe,
    make_environment,
    scenarios,
)
from bridge.episode import EpisodeRunner, OnTick, policy_action, vehicle_action
from bridge.inbound import CommandCheck
from bridge.messages import Origin
from bridge.ports import SimulatorPort, add_options, open_port
from bridge.progress import ProgressBar
from bridge.report import episode_line, make_report, summary_line
from bridge.virtual_link import Decision
from edge_runtime.cli import (
    ArgumentParser,
    examples,
    positive,
    positive_number,
    sigterm_as_interrupt,
)
from edge_runtime.files import write_json_out
from edge_runtime.run import rearm_command
from edge_runtime.transport import DEFAULT_ENDPOINT, tls_for
from edge_runtime.util import UserError, printable

POLICY, VEHICLE = LOOPS = ("policy", "vehicle")
EXAMPLE = examples(
    "python -m bridge simulate --env SCENARIO --episodes 5 --clock realtime --latency 50ms+-10ms",
    "python -m bridge simulate --env SCENARIO --condition variant --episodes 20 --out r.json",
    "python -m bridge simulate --env SCENARIO --clock realtime --loop vehicle \\\n"
    "    --connect tcp/127.0.0.1:7447 --vehicle-id car-a",
)


def add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    env = f"scenario ({', '.join(scenarios())}), gymnasium id or module:id"
    scene = "scene; " + "; ".join(f"{name}: {meaning}" for name, meaning in CONDITIONS.items())
    clock = "lockstep waits for each command, realtime never waits"
    loop = "the car follows the policy's commands, or (realtime only) the reports of the vehicle"
    loop += " behind the edge runtime"
    standing = "begin every episode at rest (always so with --loop vehicle)"
    period = "control period in s (default: the environment's, else guessed from render_fps)"
    add("--env", metavar="ENV", required=True, help=env)
    add("--condition", choices=CONDITIONS, default=NOMINAL, help=scene)
    add("--episodes", metavar="N", type=positive, default=1, help="episodes to drive")
    add("--period", metavar="SECONDS", type=positive_number, help=period)
    add("--clock", choices=sorted(CLOCKS), default=LOCKSTEP, help=clock)
    add("--loop", choices=LOOPS, default=POLICY, help=loop)
    add("--standing", action="store_true", help=standing)
    where = parser.add_mutually_exclusive_group()
    add_options(where, "--listen", default=DEFAULT_ENDPOINT)
    help_text = "a router to share with other vehicles, instead of listening"
    add_options(where, "--connect", default=None, help=help_text)
    add_options(parser, "--tls", "--latency", "--wait-edge-s", "--out")
    add_options(parser, "--vehicle-id", help="the vehicle to simulate")
    add_options(parser, "--seed", help="episode i is reset with seed + i")


def run(asked: Namespace) -> int:
    """Open both ends of the loop, wait for an edge runtime and its vehicle, and drive."""
    if asked.loop == VEHICLE and asked.clock != REALTIME:
        raise UserError("--loop vehicle needs --clock realtime: a vehicle waits for no simulation")
    asked.standing |= asked.loop == VEHICLE
    endpoint, wait_s = asked.connect or asked.listen, asked.wait_edge_s
    tls = tls_for(asked.tls, endpoint)
    with ExitStack() as stack:
        environment = stack.enter_context(closing(make_environment(asked.env, asked.condition)))
        stack.enter_context(sigterm_as_interrupt())
        task = describe(environment, asked.period)
        opened = open_port(asked.listen, asked.vehicle_id, tls, asked.connect, wait_s)
        port = stack.enter_context(opened)
        kind = VehicleClock if asked.loop == VEHICLE else CLOCKS[asked.clock]
        check = CommandCheck(port.session, task)
        clock = stack.enter_context(closing(kind(port.publish_state, check, asked.latency, task)))
        bar = stack.enter_context(ProgressBar("episodes", asked.episodes))
        bar.show("waiting for an edge runtime")
        port.hear("command", clock.receive)
        port.wait_for_edge(wait_s, endpoint)
        if isinstance(clock, VehicleClock):
            port.hear("feedback", clock.receive_feedback)
            clock.wait_for_vehicle(wait_s, asked.vehicle_id)
        report = _drive(asked, environment, port, clock, bar)
    write_json_out(asked.out, report)
    print(summary_line(report))
    return 0


def _drive(
    asked: Namespace, environment: Environment, port: SimulatorPort, clock: Clock, bar: ProgressBar
) -> dict[str, Any]:
    vehicle = clock if isinstance(clock, VehicleClock) else None
    how = {n: getattr(asked, n) for n in ("condition", "seed", "clock", "loop", "standing")}
    network, task, manifest = str(asked.latency), clock.task, port.edge_manifest()
    if manifest is not None and manifest.text == task.text:
        task = msgspec.structs.replace(task, action=manifest.action)  # with the policy's stops
    runner = EpisodeRunner(
        environment,
        clock,
        port.publish_scene,
        _shown_on(bar, port, rearm_command(asked.connect or asked.listen, asked.vehicle_id)),
        task,
        Origin(session=port.session, environment=asked.env, latency=network, **how),
        apply=vehicle_action if vehicle else policy_action,
    )
    # Without a manifest, the edge runtime itself compares what the states say.
    if manifest is not None and manifest.text != task.text:
        runner.show_task(asked.seed)
        time.sleep(task.control_period_s)  # Its safe stop still finds this end of the wire.
        raise UserError(
            f"the edge runtime's policy is for another task ({manifest.text!r}) than --env"
            f" {asked.env} ({task.text!r}); start it with a policy of this, or choose another --env"
        )
    results = []
    port.note_edge_counts()
    started_s = time.monotonic()
    for episode in range(asked.episodes):
        if vehicle is not None:
            vehicle.wait_for_standstill()
        results.append(runner.run(episode, asked.seed + episode))
        stops = [event for event in runner.safe_stops.events if event.episode == episode]
        told = episode_line(episode + 1, asked.episodes, results[-1], stops)
        bar.advance({}, told=told)
    wall_s = time.monotonic() - started_s
    port.note_edge_counts()
    edge, by_simulator = port.edge_counts, clock.rejected() + port.edge_counts.unreadable
    facts = {
        "scenario": task.task,
        **how,
        "latency_spec": network,
        "policy_ids": clock.check.policy_ids,
        "deadline_misses": runner.deadline_misses,
        "ridden_steps": runner.ridden_steps,
        "tick_overruns": clock.tick_overruns,
        "missed_ticks": clock.missed_ticks,
        "wall_clock_stalls": clock.wall_clock_stalls,
        "edge_changes": edge.changes,
        "rejected": dict(edge.rejected + by_simulator),
        "rejected_by_edge": dict(edge.rejected),
        "rejected_by_simulator": dict(by_simulator),
        "wall_s": wall_s,
        "vehicle": vehicle.report() if vehicle else None,
    }
    stops, ages_ms = runner.safe_stops.events, runner.command_ages_ms
    return make_report(results, stops, clock.latencies_ms, ages_ms, facts)


def _shown_on(bar: ProgressBar, port: SimulatorPort, rearm: str) -> OnTick:
    """Return what shows each tick on the bar, and says when the vehicle waits for a re-arm."""
    waited = False

    def on_tick(episode: int, step: int, decision: Decision) -> None:
        nonlocal waited
        doing = f"braking: {decision.brake_reason}" if decision.brake_reason else "driving"
        bar.show(f"step {step:3d}  {printable(doing)[:40]}")
        newest = port.edge_counts.newest
        waits = newest is not None and newest.needs_rearm
        if waits and not waited:
            bar.say(f"the vehicle stands until it is re-armed: {rearm}")
        waited = waits

    return on_tick
