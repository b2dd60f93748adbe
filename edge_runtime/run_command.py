"""`python -m edge_runtime run`: the control loop as a process."""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import signal
import sys
from functools import partial
from typing import Any, Callable, Iterator, Optional

from edge_runtime import access, log, presence, realtime
from edge_runtime.config import Config, load_config
from edge_runtime.controller import Controller
from edge_runtime.hold import Hold
from edge_runtime.limiter import limit_rows
from edge_runtime.link import Link
from edge_runtime.loop import ControlLoop
from edge_runtime.operator_commands import rearm_command
from edge_runtime.policy import Policy, load_policy
from edge_runtime.sd_notify import Notifier
from edge_runtime.signals import ending_signals
from edge_runtime.tls import TlsFiles, tls_for
from edge_runtime.transport import open_session
from edge_runtime.vehicles.interface import Vehicle
from edge_runtime.vehicles.registry import make_vehicle
from edge_runtime.vehicles.runner import VehicleRunner
from edge_runtime.waiting import Waiting, why_no_state
from edge_runtime.wire import key


class StopSignal:
    """Whatever would end it: remembered from the start, handed on once there is a loop to stop."""

    def __init__(self) -> None:
        self.came = False
        self.on_stop: Callable[[], None] = lambda: None
        for number in {signal.SIGTERM, signal.SIGINT, *ending_signals()}:
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: Any) -> None:
        self.came = True
        self.on_stop()


def run(arguments: argparse.Namespace) -> int:
    """Verify, connect, drive until a signal comes. Raises UserError before the network opens."""
    flags = {name: getattr(arguments, name, None) for name in Config.__struct_fields__}
    config = load_config(arguments.config, flags)
    log.configure(config.log_level, config.log_format)
    try:
        return _run(config)
    finally:
        log.close()


def _run(config: Config) -> int:
    stop = StopSignal()
    tls = _certificate(config)
    realtime.configure(config.realtime_priority, config.cpus, config.lock_memory)
    policy = load_policy(str(config.policy), config.public_key, config.allow_unsigned)
    vehicle = make_vehicle(config.vehicle, config.vehicle_setup(policy.manifest.scenario))
    with _closed_on_error(vehicle):
        rows = limit_rows(policy.manifest.action, vehicle.limits if vehicle else {})
    task = policy.manifest.task
    controller = Controller(rows, vehicle is not None, config.armed_at_start, task)
    return _serve(config, tls, policy, controller, vehicle, stop)


@contextlib.contextmanager
def _closed_on_error(vehicle: Optional[Vehicle]) -> Iterator[None]:
    """For what may fail while the vehicle has no runner yet, who would close it."""
    try:
        yield
    except BaseException:
        if vehicle is not None:
            vehicle.close()
        raise


def _certificate(config: Config) -> Optional[TlsFiles]:
    tls = tls_for(config.tls, config.connect)
    if tls is not None:
        access.check_name(tls.name, access.common_name(access.EDGE, config.vehicle_id))
    return tls


def _serve(
    config: Config,
    tls: Optional[TlsFiles],
    policy: Policy,
    controller: Controller,
    vehicle: Optional[Vehicle],
    stop: StopSignal,
) -> int:
    # Both of its sessions hear only whom this vehicle's edge may hear.
    rules = None if tls is None else access.rules_for_edge(config.vehicle_id)
    connected = partial(open_session, connect=config.connect, tls=tls, access=rules)
    open_client = partial(connected, mode="client")
    notifier = Notifier()
    with _closed_on_error(vehicle):
        alive = key(config.vehicle_id, "alive")
        router_is_there = presence.require_free(open_client, alive, config.vehicle_id)
        session = connected(mode="peer")
        try:
            link = Link(session, config.vehicle_id, policy.manifest)
            runner = _attach(vehicle, policy, link)
            rearm = rearm_command(config.connect, config.vehicle_id)
            loop = ControlLoop(policy, controller, link, runner, notifier, Hold(config.hold), rearm)
        except BaseException:
            session.close()  # An open session would hang the process at its exit.
            raise
    taken = []

    def give_way() -> None:
        taken.append(presence.taken(config.vehicle_id))
        link.mute()
        loop.stop()

    stop.on_stop = loop.stop
    why = partial(why_no_state, session, config.connect, config.vehicle_id, tls)
    waiting = Waiting(loop.has_heard, why)
    # What is loaded stays: the collector need not look at it again in the middle of a drive.
    gc.collect()
    gc.freeze()
    try:
        if runner is not None:
            runner.start(config.armed_at_start)
        loop.start()
        if router_is_there:
            presence.wait_for_router(session)
        link.appear(open_client, give_way)
        _say_ready(config, policy, tls)
        waiting.start(bool(session.info.routers_zid()))
        notifier.ready(controller.safety.mode.value)
        if not stop.came:
            loop.run()
    finally:
        waiting.stop()
        notifier.stopping()
        ended = loop.close()
        if runner is not None:
            runner.close()
        link.close()
        log.event("info", "ended", **_totals(loop))
    if taken:
        raise taken[0]
    if not ended:
        # The policy's thread hangs in native code, and would hold the interpreter's exit.
        log.close()
        os._exit(0)
    return 0


def _attach(vehicle: Optional[Vehicle], policy: Policy, link: Link) -> Optional[VehicleRunner]:
    if vehicle is None:
        return None
    names = [action.name for action in policy.manifest.action]
    return VehicleRunner(vehicle, names, lambda feedback: link.send("feedback", feedback))


def _say_ready(config: Config, policy: Policy, tls: Optional[TlsFiles]) -> None:
    if policy.trust != "verified":
        log.event("warning", "policy_not_verified", trust=policy.trust)
    if tls is not None:
        log.event("info", "certificate", of=tls.name, expires=f"{tls.expires:%Y-%m-%dT%H:%MZ}")
    print(
        f"ready vehicle_id={config.vehicle_id} vehicle={config.vehicle}"
        f" connect={config.connect} policy_id={policy.policy_id}",
        flush=True,
    )
    sys.stdout.flush()


def _totals(loop: ControlLoop) -> dict:
    health = loop.health()
    return {
        "accepted": health.accepted,
        "rejected": sum(health.rejected.values()),
        "deadline_misses": health.deadline_misses,
        "safe_stops": health.safe_stops,
        "uptime_s": round(health.uptime_s, 1),
    }
