"""``python -m bridge simulate``: serve an environment to an edge runtime, and report."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium

from bridge.arguments import (
    add_tls,
    add_vehicle_id,
    add_wait_edge,
    non_negative_int,
    positive_int,
)
from bridge.clock import Clock, Publish
from bridge.command_check import CommandCheck
from bridge.environments import CONDITIONS, NOMINAL, SCENARIOS, make_environment, scenario_of
from bridge.episode import EpisodeRunner
from bridge.lockstep import LockStepClock
from bridge.port import SimulatorPort, open_port
from bridge.progress import EpisodeBar, episode_bar
from bridge.realtime import RealTimeClock
from bridge.report import make_report, rejections, summary_line
from bridge.signals import sigterm_as_interrupt
from edge_runtime.cli import ArgumentParser, write_json_out
from edge_runtime.files import check_writable
from edge_runtime.latency.model import GRAMMAR, LatencySpec, parse_spec
from edge_runtime.tls import TlsFiles, tls_for
from edge_runtime.topics import check_vehicle_id
from edge_runtime.transport import DEFAULT_ENDPOINT, check_endpoint

CLOCKS: dict[str, Callable[[Publish, CommandCheck, LatencySpec], Clock]] = {
    "lockstep": LockStepClock,
    "realtime": RealTimeClock,
}


@dataclass(frozen=True)
class SimulateSettings:
    """What the command line asks for, checked."""

    env: str
    condition: str
    episodes: int
    clock: str
    listen: str | None
    connect: str | None
    tls: TlsFiles | None
    vehicle_id: str
    latency: LatencySpec
    seed: int
    wait_edge_s: float
    out: str | None


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    words = ", ".join(SCENARIOS)
    parser.add_argument(
        "--env", metavar="ENV", required=True, help=f"scenario ({words}), gymnasium id or module:id"
    )
    parser.add_argument(
        "--condition",
        choices=CONDITIONS,
        default=NOMINAL,
        help="the scene as trained in, or its variant with more vehicles and other types of them",
    )
    parser.add_argument(
        "--episodes", metavar="N", type=positive_int, default=1, help="episodes to drive"
    )
    parser.add_argument(
        "--clock",
        choices=sorted(CLOCKS),
        default="lockstep",
        help="lockstep waits for each command; realtime waits for nobody",
    )
    add_where(parser)
    add_tls(parser)
    add_vehicle_id(parser, "the vehicle to simulate")
    network = "injected network: " + GRAMMAR.replace("%", "%%")
    parser.add_argument("--latency", metavar="SPEC", default="none", help=network)
    parser.add_argument(
        "--seed",
        metavar="N",
        type=non_negative_int,
        default=0,
        help="episode i is reset with seed + i",
    )
    add_wait_edge(parser)
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def add_where(parser: ArgumentParser) -> None:
    """Declare --listen and --connect, of which one is taken (``check_where``)."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--listen",
        metavar="PROTOCOL/HOST:PORT",
        help=f"where the edge runtime and viewers connect to (default: {DEFAULT_ENDPOINT})",
    )
    where.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        help="share a router with other vehicles instead of listening",
    )


def check_where(arguments: Any) -> tuple[str | None, str | None]:
    """Return listen and connect, of which one is an endpoint and the other None."""
    if arguments.connect is not None:
        return None, check_endpoint(arguments.connect)
    return check_endpoint(arguments.listen or DEFAULT_ENDPOINT), None


def simulate(arguments: Any) -> int:
    """Run the command; UserError for anything the caller can put right."""
    settings = _check(arguments)
    environment = make_environment(settings.env, settings.condition)
    try:
        with sigterm_as_interrupt():
            report = _serve(settings, environment)
    finally:
        environment.close()
    write_json_out(settings.out, report)
    print(summary_line(report))
    return 0


def _check(arguments: Any) -> SimulateSettings:
    listen, connect = check_where(arguments)
    settings = SimulateSettings(
        env=arguments.env,
        condition=arguments.condition,
        episodes=arguments.episodes,
        clock=arguments.clock,
        listen=listen,
        connect=connect,
        tls=tls_for(arguments.tls, str(listen or connect)),
        vehicle_id=check_vehicle_id(arguments.vehicle_id),
        latency=parse_spec(arguments.latency),
        seed=arguments.seed,
        wait_edge_s=arguments.wait_edge_s,
        out=arguments.out,
    )
    if settings.out is not None:
        check_writable(settings.out)
    return settings


def _serve(settings: SimulateSettings, environment: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    action_size = (environment.action_space.shape or (1,))[0]
    wait_s, tls = settings.wait_edge_s, settings.tls
    with open_port(settings.listen, settings.vehicle_id, tls, settings.connect, wait_s) as port:
        check = CommandCheck(port.session, action_size)
        with (
            _running_clock(settings, port.publish_state, check) as clock,
            episode_bar(settings.episodes) as bar,
        ):
            port.on_command(clock.receive)
            port.wait_for_edge(wait_s, str(settings.connect or settings.listen))
            return _drive(settings, environment, port, clock, check, bar)


@contextlib.contextmanager
def _running_clock(
    settings: SimulateSettings, publish: Publish, check: CommandCheck
) -> Iterator[Clock]:
    clock = CLOCKS[settings.clock](publish, check, settings.latency)
    try:
        yield clock
    finally:
        clock.close()


def _drive(
    settings: SimulateSettings,
    environment: gymnasium.Env[Any, Any],
    port: SimulatorPort,
    clock: Clock,
    check: CommandCheck,
    bar: EpisodeBar,
) -> dict[str, Any]:
    runner = EpisodeRunner(environment, clock, port.session, port.publish_scene, bar.tick)
    results = []
    port.note_edge_counts()
    started_s = time.monotonic()
    for episode in range(settings.episodes):
        results.append(runner.run(episode, settings.seed + episode))
        bar.done(episode + 1)
    wall_s = time.monotonic() - started_s
    port.note_edge_counts()
    return make_report(
        results,
        runner.safe_stops.events,
        clock.latencies_ms,
        runner.command_ages_ms,
        counts={
            "deadline_misses": runner.deadline_misses,
            "tick_overruns": clock.tick_overruns,
            "missed_ticks": clock.missed_ticks,
            "wall_clock_stalls": clock.wall_clock_stalls,
            "edge_changes": port.edge_counts.changes,
            **rejections(
                port.edge_counts.rejected, check.rejected + Counter(port.edge_counts.unreadable)
            ),
        },
        settings={
            "scenario": scenario_of(settings.env),
            "condition": settings.condition,
            "policy_ids": check.policy_ids,
            "seed": settings.seed,
            "clock": settings.clock,
            "latency_spec": str(settings.latency),
            "wall_s": wall_s,
        },
    )
