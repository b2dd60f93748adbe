"""`python -m edge_runtime run`: the control loop as a process."""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
import os
import signal
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Callable, Dict, Optional

import zenoh

from edge_runtime import log, service
from edge_runtime.config import NONE, Config, add_flags, add_trust, load_config
from edge_runtime.controller import Controller, shared_limits
from edge_runtime.link import Link, require_free, taken, wait_for_router
from edge_runtime.loop import ControlLoop
from edge_runtime.policy import VERIFIED, load_policy
from edge_runtime.transport import is_tls, look, open_session
from edge_runtime.util import ending_signals

if TYPE_CHECKING:  # Loaded only where they are used.
    from edge_runtime.files import Hold
    from edge_runtime.tls import TlsFiles
    from edge_runtime.vehicles.base import Vehicle, VehicleRunner


_WAITING_PERIOD_S = 5.0
_POLL_S = 0.1


class _StopSignal:
    """Whatever would end it: remembered from the start, handed on once there is a loop to stop."""

    def __init__(self) -> None:
        self.came = False
        self.on_stop: Callable[[], None] = lambda: None
        for number in {signal.SIGTERM, signal.SIGINT, *ending_signals()}:
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: Any) -> None:
        self.came = True
        self.on_stop()


EXAMPLE = r"""examples:
  python -m edge_runtime run --policy results/policies/left_turn.onnx \
      --public-key results/policies/policy.pub
  python -m edge_runtime run --policy my.onnx --vehicle hunter --bus socketcan:can0 \
      --connect tls/10.0.0.2:7447 --tls certs/edge-hunter01 --vehicle-id hunter01
  python -m edge_runtime run --config edge.toml --log-format json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `run`."""
    parser.add_argument("--config", metavar="FILE.toml", help="settings; flags win over it")
    add_flags(parser)
    add_trust(parser)


def run(arguments: argparse.Namespace) -> int:
    """Verify, connect, drive until a signal comes. Raises UserError before the network opens."""
    flags = {name: getattr(arguments, name, None) for name in Config.__struct_fields__}
    config = load_config(arguments.config, flags)
    log.configure(config.log_level, config.log_format)
    try:
        if not _drive(config, _StopSignal()):
            # The policy's thread hangs in native code, and would hold the interpreter's exit.
            log.close()
            os._exit(0)
    finally:
        log.close()
    return 0


def _drive(config: Config, stop: _StopSignal) -> bool:
    """Drive until it is told to stop; False where a thread hangs.

    Raises UserError, and leaves nothing open, where the run cannot be made, and where it gave way.
    """
    tls: Optional[TlsFiles] = None
    access: Optional[Dict[str, Any]] = None
    if config.tls is not None:
        from edge_runtime.tls import EDGE, check_name, common_name, load_tls, rules_for_edge

        tls, access = load_tls(config.tls), rules_for_edge(config.vehicle_id)
        check_name(tls.name, common_name(EDGE, config.vehicle_id))
        log.event("info", "certificate", of=tls.name, expires=f"{tls.expires:%Y-%m-%dT%H:%MZ}")
    service.claim_resources(config.realtime_priority, config.cpus, config.lock_memory)
    policy = load_policy(str(config.policy), config.public_key, config.allow_unsigned)
    # Both of its sessions hear only what this vehicle's edge may hear.
    connected = partial(open_session, connect=config.connect, tls=tls, access=access)
    open_client = partial(connected, mode="client")
    notifier = service.Notifier()
    with contextlib.ExitStack() as undo:
        vehicle: Optional[Vehicle] = None
        if config.vehicle != NONE:
            from edge_runtime.vehicles import make_vehicle

            vehicle = make_vehicle(config.vehicle, config, policy.manifest.scenario)
            undo.callback(vehicle.close)
        limits = shared_limits(policy.manifest.action, vehicle.limits if vehicle else {})
        controller = Controller(
            limits, vehicle is not None, config.armed_at_start, policy.manifest.task
        )
        hold: Optional[Hold] = None
        if config.hold is not None:
            from edge_runtime.files import Hold

            hold = Hold(config.hold)
        has_router = require_free(open_client, config.vehicle_id)
        session = connected(mode="peer")
        undo.callback(session.close)  # An open one would hang the process at its exit.
        link = Link(session, config.vehicle_id, policy.manifest)
        runner: Optional[VehicleRunner] = None
        if vehicle is not None:
            from edge_runtime.vehicles.base import VehicleRunner

            runner = VehicleRunner(vehicle, list(limits), partial(link.send, "feedback"))
        rearm = rearm_command(config.connect, config.vehicle_id)
        loop = ControlLoop(policy, controller, link, runner, notifier, hold, rearm)
        undo.pop_all()
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
        if has_router:
            wait_for_router(session)
        link.appear(open_client, loop.stop)
        if policy.trust != VERIFIED:
            log.event("warning", "policy_not_verified", trust=policy.trust)
        print(
            f"ready vehicle_id={config.vehicle_id} vehicle={config.vehicle}"
            f" connect={config.connect} policy_id={policy.policy_id}",
            flush=True,
        )
        if session.info.routers_zid():  # then its first state may take as long
            waiting.next_s = time.monotonic() + _WAITING_PERIOD_S
        waiting.start()
        notifier.tell(f"READY=1\nSTATUS={controller.safety.mode.value}")
        if not stop.came:
            loop.run()
    finally:
        waiting.ended.set()
        notifier.tell("STOPPING=1")
        ended = loop.close()
        if runner is not None:
            runner.close()
        link.close()
        health = loop.health()
        log.event(
            "info",
            "ended",
            accepted=health.accepted,
            rejected=sum(health.rejected.values()),
            deadline_misses=health.deadline_misses,
            safe_stops=health.safe_stops,
            uptime_s=round(health.uptime_s, 1),
        )
    if link.gave_way:
        raise taken(config.vehicle_id)
    return ended


def rearm_command(connect: str, vehicle_id: str) -> str:
    """What an operator types to let a vehicle drive again."""
    tls = f" --tls certs/operator-{vehicle_id}" if is_tls(connect) else ""
    return f"python -m edge_runtime rearm --connect {connect} --vehicle-id {vehicle_id}{tls}"


class Waiting(threading.Thread):
    """Logs what is waited for, until a state comes or `ended` is set. A name server takes time."""

    def __init__(self, has_heard: Callable[[], bool], why: Callable[[], str]) -> None:
        super().__init__(name="waiting", daemon=True)
        self.next_s = -math.inf
        self.ended = threading.Event()
        self._has_heard, self._why = has_heard, why

    def look(self, now_s: float) -> bool:
        """Say what is waited for, at once and every 5 s; False once a state was heard."""
        if self._has_heard():
            return False
        if now_s >= self.next_s:
            self.next_s = now_s + _WAITING_PERIOD_S
            why = self._why()
            if why and not self._has_heard():
                log.event("info", "waiting", why=why)
        return True

    def run(self) -> None:
        """Look again and again."""
        while self.look(time.monotonic()) and not self.ended.wait(_POLL_S):
            pass


def why_no_state(
    session: zenoh.Session, connect: str, vehicle_id: str, tls: Optional[TlsFiles]
) -> str:
    """What keeps states away, on one line."""
    if not session.info.routers_zid():
        _, refusal = look(connect, tls)
        if not session.info.routers_zid():  # it may have come meanwhile
            return refusal or f"{connect} gives no link yet"
    return f"{connect} is there, and has sent no state for vehicle id {vehicle_id} yet"
