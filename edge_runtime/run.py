"""`python -m edge_runtime run`: the control loop as a process."""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import queue
import signal
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Callable, Dict, List, Optional, Union

import zenoh

from edge_runtime import log, service
from edge_runtime.actions import Ride, shared_limits
from edge_runtime.config import NONE, Config, add_flags, add_trust, load_config
from edge_runtime.controller import Controller
from edge_runtime.link import Link, require_free, taken, wait_for_router
from edge_runtime.link_quality import link_words
from edge_runtime.loop import ControlLoop
from edge_runtime.policy import VERIFIED, load_policy
from edge_runtime.transport import is_tls, open_session
from edge_runtime.util import PathLike, ending_signals, ends_within, printable, take_signals

if TYPE_CHECKING:  # Loaded only where they are used.
    from edge_runtime.tls import TlsFiles
    from edge_runtime.vehicles.base import Vehicle, VehicleRunner


_WAITING_PERIOD_S = 5.0
_ANNOUNCE_S, _CLOSE_S = 0.5, 2.0
_FORCE_S = 10.0  # longer than all that is waited for in the end


class _StopSignal:
    """Whatever would end it: remembered from the start, handed on once there is a loop to stop."""

    def __init__(self, until: Optional[threading.Event], undo: contextlib.ExitStack) -> None:
        self.came = False
        self.on_stop: Callable[[], None] = lambda: None
        self._signals: queue.SimpleQueue[Any] = queue.SimpleQueue()  # a handler may put at any time
        self._over = threading.Event()
        undo.callback(self._signals.put, None)
        undo.callback(self._over.set)
        threading.Thread(target=self._force, name="force", daemon=True).start()
        take_signals({signal.SIGTERM, signal.SIGINT, *ending_signals()}, self._handle, undo)
        if until is not None:
            threading.Thread(target=self._wait, args=(until,), daemon=True).start()

    def _wait(self, until: threading.Event) -> None:
        until.wait()
        self._handle()

    def _handle(self, *signalled: Any) -> None:
        self.came = True
        if signalled:
            self._signals.put(None)
        self.on_stop()

    def _force(self) -> None:
        """End the process where the main thread hangs, in a driver's constructor for one."""
        self._signals.get()
        if not self._over.wait(_FORCE_S):
            log.event("error", "ended_by_force", waited_s=_FORCE_S)
            log.close()
            os._exit(1)


EXAMPLE = r"""examples:
  python -m edge_runtime run --policy my.onnx --public-key keys/policy.pub
  python -m edge_runtime run --policy my.onnx --vehicle hunter --bus socketcan:can0 \
      --connect tls/10.0.0.2:7447 --tls certs/edge-hunter01 --vehicle-id hunter01
  python -m edge_runtime run --config edge.toml --log-format json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `run`."""
    parser.add_argument("--config", metavar="FILE.toml", help="settings; flags win over it")
    add_flags(parser)
    add_trust(parser)


def run(arguments: argparse.Namespace) -> int:
    """`drive` with the command line's settings."""
    flags = {name: getattr(arguments, name, None) for name in (*Config.__struct_fields__, "bus")}
    ended = drive(config=arguments.config, **flags)
    for number in ending_signals():  # a second one must not change how it has ended
        signal.signal(number, signal.SIG_IGN)
    if not ended:
        # A thread hangs in native code or in a write, and would hold the interpreter's exit.
        os._exit(0)
    return 0


def drive(
    policy: Optional[PathLike] = None,
    *,
    connect: Optional[str] = None,
    vehicle: Union[Vehicle, str, None] = None,
    config: Optional[PathLike] = None,
    until: Optional[threading.Event] = None,
    **settings: Any,
) -> bool:
    """Verify a policy, connect, drive until a signal comes or `until` is set: `run`, from Python.

    `vehicle` is a driver, or what `--vehicle` takes; a driver is closed in the end. `config` is a
    TOML file; `settings` are its other keys (`config.example.toml`), and win over it. Signals end
    it in the main thread only. Returns False where a thread hangs and would hold the interpreter's
    exit. Raises UserError where it cannot begin, and where it gave way to another
    runtime of the same vehicle id.
    """
    driver = None if vehicle is None or isinstance(vehicle, str) else vehicle
    if driver is not None:
        from edge_runtime.vehicles import check_driver

        check_driver(driver)
    flags = {"policy": policy and str(policy), "connect": connect, **settings}
    try:
        loaded = load_config(config, {**flags, "vehicle": vehicle if driver is None else NONE})
        log.configure(loaded.log_level, loaded.log_format)
    except BaseException:
        if driver is not None:
            _close_in_time(driver)
        raise
    try:
        with contextlib.ExitStack() as undo:
            ended = _drive(loaded, _StopSignal(until, undo), driver)
    finally:
        written = log.close()
    return ended and written


def _close_in_time(vehicle: Vehicle) -> None:
    from edge_runtime.vehicles.base import close_in_time

    close_in_time(vehicle)


def _drive(config: Config, stop: _StopSignal, vehicle: Optional[Vehicle] = None) -> bool:
    """Drive until it is told to stop; False where a thread hangs.

    Raises UserError, and leaves nothing open, where the run cannot be made, and where it gave way.
    """
    with contextlib.ExitStack() as undo:
        if vehicle is not None:
            undo.callback(_close_in_time, vehicle)
        tls: Optional[TlsFiles] = None
        access: Optional[Dict[str, Any]] = None
        if config.tls is not None:
            from edge_runtime.tls import EDGE, check_name, common_name, load_tls, rules_for_edge

            tls, access = load_tls(config.tls), rules_for_edge(config.vehicle_id)
            check_name(tls.name, common_name(EDGE, config.vehicle_id))
            log.event("info", "certificate", of=tls.name, expires=f"{tls.expires:%Y-%m-%dT%H:%MZ}")
        if config.vehicle != NONE:
            from edge_runtime.vehicles import find_vehicle, make_vehicle

            # Now: nobody need wait for the policy to hear of a misprint.
            find_vehicle(config.vehicle)
        claim = (config.realtime_priority, config.cpus, config.lock_memory)
        if any(claim):
            service.claim_resources(*claim)
        policy = load_policy(str(config.policy), config.public_key, config.allow_unsigned)
        # Both of its sessions hear only what this vehicle's edge may hear.
        connected = partial(open_session, connect=config.connect, tls=tls, access=access)
        open_client = partial(connected, mode="client")
        notifier = service.Notifier()
        period_s = policy.manifest.control_period_s
        if config.vehicle != NONE:
            vehicle = make_vehicle(config.vehicle, config.vehicle_settings, policy.manifest)
            undo.callback(_close_in_time, vehicle)
        name, its_limits = NONE, {}
        if vehicle is not None:
            vehicle.control_period_s = period_s
            name, its_limits = vehicle.name, vehicle.limits
        limits = shared_limits(policy.manifest.action, its_limits)
        ride = None
        # On hold its vehicle must get nothing, and nobody sees what follows when the hold ends.
        armed = config.armed_at_start and config.hold is None
        if config.ride_through.max_s:
            ride = Ride(config.ride_through.max_s, period_s, limits, plays=vehicle is not None)
        task, needs_rearm = policy.layout.task_text, vehicle is not None
        controller = Controller(limits, period_s, needs_rearm, armed, task, ride)
        hold: Optional[service.Hold] = None
        if config.hold is not None:
            hold = service.Hold(config.hold)
        has_router = require_free(open_client, config.vehicle_id)
        session = connected(mode="peer")
        undo.callback(session.close)  # An open one would hang the process at its exit.
        link = Link(session, config.vehicle_id, policy.manifest)
        if tls is not None:
            from edge_runtime.reach import Listener

            link.listener = Listener(config.connect, tls)
        runner: Optional[VehicleRunner] = None
        if vehicle is not None:
            from edge_runtime.vehicles.base import VehicleRunner

            runner = VehicleRunner(vehicle, list(limits), partial(link.send, "feedback"))
        rearm = rearm_command(config.connect, config.vehicle_id)
        loop = ControlLoop(policy, controller, link, runner, notifier, hold, rearm)
        undo.pop_all()
    stop.on_stop = loop.stop
    why = partial(why_no_state, session, config.connect, config.vehicle_id, tls)
    over = threading.Event()
    failures: List[BaseException] = []

    def announce() -> None:
        try:
            if has_router:
                wait_for_router(session)
            link.appear(open_client, loop.stop)
            if policy.trust != VERIFIED:
                log.event("warning", "policy_not_verified", trust=policy.trust)
            print(
                f"ready vehicle_id={config.vehicle_id} vehicle={name}"
                f" connect={config.connect} policy_id={policy.policy_id}"
                f" verified_by={printable(policy.public_key or 'none')}",
                flush=True,
            )
            notifier.tell(f"READY=1\nSTATUS={controller.safety.mode.value}")
            # One that is linked already has some time for its first state.
            grace_s = _WAITING_PERIOD_S if session.info.routers_zid() else 0.0
            say_what_is_missing(loop.has_heard, why, over, time.monotonic() + grace_s)
        except BaseException as error:  # the main thread raises it
            failures.append(error)
            loop.stop()

    # Apart from the watchdog, which is the main thread: whoever reads stdout may stand still.
    announcer = threading.Thread(target=announce, name="announce", daemon=True)
    # What is loaded stays: the collector need not look at it again in the middle of a drive.
    gc.collect()
    gc.freeze()
    try:
        if runner is not None:
            runner.start(armed)
        loop.start()
        announcer.start()
        if not stop.came:
            loop.run()
    finally:
        over.set()
        gc.unfreeze()  # In Python another drive may follow.
        notifier.tell("STOPPING=1")
        ended = loop.close()
        if runner is not None:
            ended = runner.close() and ended
        if announcer.ident is not None:
            announcer.join(_ANNOUNCE_S)
            ended = ended and not announcer.is_alive()
        ended = ends_within(_CLOSE_S, link.close) and ended  # a peer that was stopped holds it
        health = loop.health()
        log.event(
            "info",
            "ended",
            accepted=health.accepted,
            rejected=sum(health.rejected.values()),
            deadline_misses=health.deadline_misses,
            safe_stops=health.safe_stops,
            uptime_s=round(health.uptime_s, 1),
            link=link_words(health.link),
        )
    if failures:
        raise failures[0]
    if link.gave_way:
        raise taken(config.vehicle_id)
    if tls is not None:
        tls.require_valid(time.time())
    return ended


def rearm_command(connect: str, vehicle_id: str) -> str:
    """What an operator types to let a vehicle drive again."""
    tls = f" --tls certs/operator-{vehicle_id}" if is_tls(connect) else ""
    return f"python -m edge_runtime rearm --connect {connect} --vehicle-id {vehicle_id}{tls}"


def say_what_is_missing(
    has_heard: Callable[[], bool], why: Callable[[], str], over: threading.Event, next_s: float
) -> None:
    """Log what is waited for, from `next_s` on and every 5 s, until a state comes or it is over."""
    while not over.wait(max(0.0, next_s - time.monotonic())) and not has_heard():
        next_s = time.monotonic() + _WAITING_PERIOD_S
        words = why()  # a name server takes time
        if not has_heard():
            log.event("warning", "waiting", why=words)


def why_no_state(
    session: zenoh.Session, connect: str, vehicle_id: str, tls: Optional[TlsFiles]
) -> str:
    """What keeps states away, on one line."""
    from edge_runtime.reach import look  # Here: mostly the simulator is there first.

    def is_linked() -> bool:
        return bool(session.info.routers_zid() or session.info.peers_zid())

    if not is_linked():
        _, refusal = look(connect, tls)
        if not is_linked():  # it may have come meanwhile
            return f"{connect}: {refusal or 'no link yet'}"
    return f"{connect} is there, and has sent no state for vehicle id {vehicle_id} yet"
