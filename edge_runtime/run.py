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
from typing import TYPE_CHECKING, Any, Callable, Dict, Optional, Tuple

import zenoh

from edge_runtime import log, service
from edge_runtime.config import NONE, Config, add_flags, add_trust, load_config
from edge_runtime.controller import Controller, limit_rows
from edge_runtime.link import Link, require_free, taken, wait_for_router
from edge_runtime.loop import ControlLoop
from edge_runtime.policy import load_policy
from edge_runtime.policy_file import VERIFIED
from edge_runtime.transport import is_tls, look, open_session
from edge_runtime.util import UserError, ending_signals
from edge_runtime.wire import key

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
    text = "settings; flags on the command line win over it"
    parser.add_argument("--config", metavar="FILE.toml", help=text)
    add_flags(parser)
    add_trust(parser)


def run(arguments: argparse.Namespace) -> int:
    """Verify, connect, drive until a signal comes. Raises UserError before the network opens."""
    flags = {name: getattr(arguments, name, None) for name in Config.__struct_fields__}
    config = load_config(arguments.config, flags)
    log.configure(config.log_level, config.log_format)
    try:
        stop = _StopSignal()
        runtime = _Runtime(config)
        stop.on_stop = runtime.loop.stop
        if not runtime.drive(stop):
            # The policy's thread hangs in native code, and would hold the interpreter's exit.
            log.close()
            os._exit(0)
    finally:
        log.close()
    return 0


class _Runtime:
    """All that one run is made of. UserError, and nothing left open, where it cannot be made."""

    def __init__(self, config: Config) -> None:
        tls, access = _certificate(config)
        if config.realtime_priority or config.cpus or config.lock_memory:
            from edge_runtime import realtime

            realtime.configure(config.realtime_priority, config.cpus, config.lock_memory)
        self._config = config
        self._policy = load_policy(str(config.policy), config.public_key, config.allow_unsigned)
        manifest = self._policy.manifest
        # Both of its sessions hear only what this vehicle's edge may hear.
        connected = partial(open_session, connect=config.connect, tls=tls, access=access)
        self._open_client = partial(connected, mode="client")
        self._notifier = service.Notifier()
        self._rival: Optional[UserError] = None
        with contextlib.ExitStack() as undo:
            vehicle: Optional[Vehicle] = None
            if config.vehicle != NONE:
                from edge_runtime.vehicles.registry import make_vehicle

                vehicle = make_vehicle(config.vehicle, config, manifest.scenario)
                undo.callback(vehicle.close)
            rows = limit_rows(manifest.action, vehicle.limits if vehicle else {})
            self._controller = Controller(
                rows, vehicle is not None, config.armed_at_start, manifest.task
            )
            hold: Optional[Hold] = None
            if config.hold is not None:
                from edge_runtime.files import Hold

                hold = Hold(config.hold)
            alive = key(config.vehicle_id, "alive")
            self._has_router = require_free(self._open_client, alive, config.vehicle_id)
            self._session = connected(mode="peer")
            undo.callback(self._session.close)  # An open one would hang the process at its exit.
            self._link = Link(self._session, config.vehicle_id, manifest)
            self._runner: Optional[VehicleRunner] = None
            if vehicle is not None:
                from edge_runtime.vehicles.base import VehicleRunner

                names = [action.name for action in manifest.action]
                self._runner = VehicleRunner(vehicle, names, partial(self._link.send, "feedback"))
            self.loop = ControlLoop(
                self._policy,
                self._controller,
                self._link,
                self._runner,
                self._notifier,
                hold,
                rearm_command(config.connect, config.vehicle_id),
            )
            undo.pop_all()
        why = partial(why_no_state, self._session, config.connect, config.vehicle_id, tls)
        self._waiting = Waiting(self.loop.has_heard, why)
        # What is loaded stays: the collector need not look at it again in the middle of a drive.
        gc.collect()
        gc.freeze()

    def drive(self, stop: _StopSignal) -> bool:
        """Until it is told to stop; False where a thread hangs. UserError where it gave way."""
        config, policy = self._config, self._policy
        try:
            if self._runner is not None:
                self._runner.start(config.armed_at_start)
            self.loop.start()
            if self._has_router:
                wait_for_router(self._session)
            self._link.appear(self._open_client, self._give_way)
            if policy.trust != VERIFIED:
                log.event("warning", "policy_not_verified", trust=policy.trust)
            print(
                f"ready vehicle_id={config.vehicle_id} vehicle={config.vehicle}"
                f" connect={config.connect} policy_id={policy.policy_id}",
                flush=True,
            )
            self._waiting.start(bool(self._session.info.routers_zid()))
            self._notifier.tell(f"READY=1\nSTATUS={self._controller.safety.mode.value}")
            if not stop.came:
                self.loop.run()
        finally:
            self._waiting.stop()
            self._notifier.tell("STOPPING=1")
            ended = self.loop.close()
            if self._runner is not None:
                self._runner.close()
            self._link.close()
            health = self.loop.health()
            log.event(
                "info",
                "ended",
                accepted=health.accepted,
                rejected=sum(health.rejected.values()),
                deadline_misses=health.deadline_misses,
                safe_stops=health.safe_stops,
                uptime_s=round(health.uptime_s, 1),
            )
        if self._rival is not None:
            raise self._rival
        return ended

    def _give_way(self) -> None:
        self._rival = taken(self._config.vehicle_id)
        self._link.mute()
        self.loop.stop()


def _certificate(config: Config) -> Tuple[Optional[TlsFiles], Optional[Dict[str, Any]]]:
    """The files of --tls, and Zenoh's access control for their party; None each without it."""
    if config.tls is None:
        return None, None
    from edge_runtime import tls

    files = tls.load_tls(config.tls)
    tls.check_name(files.name, tls.common_name(tls.EDGE, config.vehicle_id))
    log.event("info", "certificate", of=files.name, expires=f"{files.expires:%Y-%m-%dT%H:%MZ}")
    return files, tls.rules_for_edge(config.vehicle_id)


def rearm_command(connect: str, vehicle_id: str) -> str:
    """What an operator types to let a vehicle drive again."""
    tls = f" --tls certs/operator-{vehicle_id}" if is_tls(connect) else ""
    return f"python -m edge_runtime rearm --connect {connect} --vehicle-id {vehicle_id}{tls}"


class Waiting:
    """`look` says it where that is due; `start` has a thread look: a name server takes its time."""

    def __init__(self, has_heard: Callable[[], bool], why: Callable[[], str]) -> None:
        self._has_heard = has_heard
        self._why = why
        self._next_s = -math.inf
        self._ended = threading.Event()

    def look(self, now_s: float) -> bool:
        """Say what is waited for, at once and every 5 s; False once a state was heard."""
        if self._has_heard():
            return False
        if now_s >= self._next_s:
            self._next_s = now_s + _WAITING_PERIOD_S
            why = self._why()
            if why and not self._has_heard():
                log.event("info", "waiting", why=why)
        return True

    def start(self, is_linked: bool) -> None:
        """Look until a state comes, or `stop`. One that is linked has 5 s for its first state."""
        if is_linked:
            self._next_s = time.monotonic() + _WAITING_PERIOD_S
        threading.Thread(target=self._run, name="waiting", daemon=True).start()

    def stop(self) -> None:
        """Say nothing more. Never waits."""
        self._ended.set()

    def _run(self) -> None:
        while self.look(time.monotonic()) and not self._ended.wait(_POLL_S):
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
