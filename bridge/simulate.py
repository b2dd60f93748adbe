"""``python -m bridge simulate``: serve an environment to an edge runtime, and report."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
from rich.progress import Progress

from bridge.clocks import CLOCKS, REALTIME, Clock
from bridge.commands import (
    add_tls,
    add_vehicle_id,
    add_wait_edge,
    add_where,
    check_where,
    progress_bar,
)
from bridge.environments import (
    CONDITIONS,
    NOMINAL,
    SCENARIOS,
    make_environment,
    scenario_of,
    task_of,
)
from bridge.episode import EpisodeRunner, policy_action
from bridge.inbound import CommandCheck, FeedbackCheck
from bridge.network import GRAMMAR, LatencySpec, parse_spec
from bridge.ports import SimulatorPort, open_port
from bridge.report import episode_line, make_report, rejections, summary_line
from bridge.vehicle import VehicleClock, VehicleInLoop
from bridge.virtual_link import Decision
from edge_runtime.cli import ArgumentParser, examples, not_negative, positive, sigterm_as_interrupt
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.run import rearm_command
from edge_runtime.tls import TlsFiles, tls_for
from edge_runtime.util import UserError, printable
from edge_runtime.wire import CONTROL_PERIOD_S, check_vehicle_id

POLICY, VEHICLE = LOOPS = ("policy", "vehicle")


@dataclass(frozen=True)
class SimulateSettings:
    """What the command line asks for, checked."""

    env: str
    condition: str
    episodes: int
    clock: str
    loop: str
    standing: bool
    listen: str | None
    connect: str | None
    tls: TlsFiles | None
    vehicle_id: str
    latency: LatencySpec
    seed: int
    wait_edge_s: float
    out: str | None


EXAMPLE = examples(
    "python -m bridge simulate --env left_turn --episodes 5 --clock realtime --latency 50ms+-10ms",
    "python -m bridge simulate --env congestion --condition variant --episodes 20 --out r.json",
    "python -m bridge simulate --env left_turn --clock realtime --loop vehicle \\\n"
    "    --connect tcp/127.0.0.1:7447 --vehicle-id car-a",
)


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
        help="scene; " + "; ".join(f"{name}: {meaning}" for name, meaning in CONDITIONS.items()),
    )
    parser.add_argument(
        "--episodes", metavar="N", type=positive, default=1, help="episodes to drive"
    )
    parser.add_argument(
        "--clock",
        choices=sorted(CLOCKS),
        default="lockstep",
        help="lockstep waits for each command; realtime waits for nobody",
    )
    parser.add_argument(
        "--loop",
        choices=LOOPS,
        default=POLICY,
        help="the car does what the policy commands, or (realtime only) what the vehicle behind "
        "the edge runtime reports to have done",
    )
    parser.add_argument(
        "--standing",
        action="store_true",
        help="the car starts every episode at rest, as with --loop vehicle it always does",
    )
    add_where(parser)
    add_tls(parser)
    add_vehicle_id(parser, "the vehicle to simulate")
    network = "injected network: " + GRAMMAR.replace("%", "%%")
    parser.add_argument("--latency", metavar="SPEC", default="none", help=network)
    parser.add_argument(
        "--seed",
        metavar="N",
        type=not_negative,
        default=0,
        help="episode i is reset with seed + i",
    )
    add_wait_edge(parser)
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def run(arguments: Any) -> int:
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
    if arguments.loop == VEHICLE and arguments.clock != REALTIME:
        raise UserError("--loop vehicle needs --clock realtime: a vehicle waits for no simulation")
    settings = SimulateSettings(
        env=arguments.env,
        condition=arguments.condition,
        episodes=arguments.episodes,
        clock=arguments.clock,
        loop=arguments.loop,
        standing=arguments.standing or arguments.loop == VEHICLE,
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
        clock = _make_clock(settings, port, check, action_size)
        with contextlib.closing(clock), episode_bar(settings.episodes) as bar:
            port.on_command(clock.receive)
            port.wait_for_edge(wait_s, str(settings.connect or settings.listen))
            vehicle = (
                VehicleInLoop(clock, port, wait_s) if isinstance(clock, VehicleClock) else None
            )
            return _drive(settings, environment, port, clock, check, bar, vehicle)


def _make_clock(
    settings: SimulateSettings, port: SimulatorPort, check: CommandCheck, action_size: int
) -> Clock:
    if settings.loop == VEHICLE:
        feedback = FeedbackCheck(port.session, action_size)
        return VehicleClock(port.publish_state, check, settings.latency, feedback)
    return CLOCKS[settings.clock](port.publish_state, check, settings.latency)


def _drive(
    settings: SimulateSettings,
    environment: gymnasium.Env[Any, Any],
    port: SimulatorPort,
    clock: Clock,
    check: CommandCheck,
    bar: EpisodeBar,
    vehicle: VehicleInLoop | None,
) -> dict[str, Any]:
    rearm = rearm_command(str(settings.connect or settings.listen), settings.vehicle_id)

    def on_tick(episode: int, step: int, decision: Decision) -> None:
        bar.tick(episode, step, decision, rearm if port.edge_counts.waits_for_rearm else "")

    runner = EpisodeRunner(
        environment,
        clock,
        port.session,
        port.publish_scene,
        on_tick,
        apply=vehicle.apply if vehicle else policy_action,
        standing=settings.standing,
        # Copies, made at once: other threads go on counting.
        rejected=lambda: {**check.rejected, **(vehicle.rejected() if vehicle else {})},
        task=task_of(environment, settings.env),
    )
    _meet(settings, environment, port, runner)
    results = []
    port.note_edge_counts()
    started_s = time.monotonic()
    for episode in range(settings.episodes):
        if vehicle is not None:
            vehicle.clock.wait_for_standstill()
        results.append(runner.run(episode, settings.seed + episode))
        stops = [event for event in runner.safe_stops.events if event.episode == episode]
        bar.done(episode + 1, episode_line(episode + 1, settings.episodes, results[-1], stops))
    wall_s = time.monotonic() - started_s
    port.note_edge_counts()
    unbelieved = Counter(port.edge_counts.unreadable)
    if vehicle is not None:
        unbelieved += vehicle.rejected()
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
            **rejections(port.edge_counts.rejected, check.rejected + unbelieved),
        },
        settings={**_as_asked(settings), "policy_ids": check.policy_ids, "wall_s": wall_s},
        vehicle=vehicle.report() if vehicle else None,
    )


def _meet(
    settings: SimulateSettings,
    environment: gymnasium.Env[Any, Any],
    port: SimulatorPort,
    runner: EpisodeRunner,
) -> None:
    """Compare tasks with the edge runtime; UserError where its policy is for another one."""
    manifest = port.edge_manifest()
    if manifest is None:
        return  # It compares by itself what the states say.
    task = task_of(environment, settings.env, manifest)
    if manifest.task != task:
        runner.show_task(settings.seed)
        time.sleep(CONTROL_PERIOD_S)  # Its safe stop still finds this end of the wire.
        raise UserError(
            f"the edge runtime's policy is for another task ({manifest.task!r}) than --env"
            f" {settings.env} ({task!r}); start it with a policy of this, or choose another --env"
        )


def _as_asked(settings: SimulateSettings) -> dict[str, Any]:
    return {
        "scenario": scenario_of(settings.env),
        "condition": settings.condition,
        "seed": settings.seed,
        "clock": settings.clock,
        "loop": settings.loop,
        "standing": settings.standing,
        "latency_spec": str(settings.latency),
    }


class EpisodeBar:
    """Shows the episodes done and what the vehicle does at the moment.

    Where nobody watches a terminal, it prints a line an episode instead.
    """

    def __init__(self, progress: Progress, episodes: int) -> None:
        self._progress = progress
        self._task = progress.add_task("waiting for an edge runtime", total=episodes)
        self._waits_for = ""

    def tick(self, episode: int, step: int, decision: Decision, waits_for: str = "") -> None:
        """Show one tick; ``waits_for`` is the command that the vehicle needs to drive again."""
        reason = printable(decision.brake_reason)
        doing = f"braking: {reason}" if reason else "driving"
        self._progress.update(
            self._task, completed=episode, description=f"step {step:3d}  {doing[:40]}"
        )
        if waits_for and not self._waits_for:
            self._say(f"the vehicle stands until it is re-armed: {waits_for}")
        self._waits_for = waits_for

    def done(self, episodes: int, told: str) -> None:
        """Show how many episodes are done, and without a bar what became of the last one."""
        self._progress.update(self._task, completed=episodes)
        if self._progress.disable:
            self._say(told)

    def _say(self, line: str) -> None:
        """Print a line above the bar, as it is."""
        self._progress.console.print(line, markup=False, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def episode_bar(episodes: int) -> Iterator[EpisodeBar]:
    """Show a bar on stderr while the block runs; lines if stderr is no terminal."""
    with progress_bar("episodes") as progress:
        yield EpisodeBar(progress, episodes)
