"""`python -m edge_runtime run`: the control loop as a process."""

from __future__ import annotations

import argparse
import contextlib
import gc
import signal
import threading
import time
from functools import partial
from typing import Any, List, Optional, Union

from edge_runtime import log, service
from edge_runtime.cli import ENDING_SIGNALS, handled
from edge_runtime.config import EACH_EPISODE, NONE, Config, add_run_flags, load_config
from edge_runtime.controller import Controller, ControllerConfig, shared_limits
from edge_runtime.link import Link, link_words, require_free, taken
from edge_runtime.loop import ControlLoop
from edge_runtime.policy import VERIFIED, Policy, load_policy
from edge_runtime.reach import Listener, why_no_link
from edge_runtime.tls import EDGE, TlsFiles, check_name, common_name, load_tls, rules_for_edge
from edge_runtime.transport import open_session, rearm_command
from edge_runtime.util import PathLike, UserError, ends_within, printable
from edge_runtime.vehicles import check_driver, find_vehicle, make_vehicle
from edge_runtime.vehicles.base import Vehicle, VehicleRunner, close_in_time

_ANNOUNCE_S, _CLOSE_S = 0.5, 2.0
_WAITING_PERIOD_S = 10.0

EXAMPLE = r"""examples:
  python -m edge_runtime run --policy my.onnx --public-key keys/policy.pub
  python -m edge_runtime run --policy my.onnx --vehicle hunter --bus socketcan:can0 \
      --connect tls/10.0.0.2:7447 --tls certs/edge-hunter01 --vehicle-id hunter01
  python -m edge_runtime run --config edge.toml"""
add_arguments = add_run_flags


def run(arguments: argparse.Namespace) -> int:
    flags = {name: getattr(arguments, name, None) for name in (*Config.__struct_fields__, "bus")}
    drive(config=arguments.config, **flags)
    for number in ENDING_SIGNALS:  # a second signal must not change the exit status
        signal.signal(number, signal.SIG_IGN)
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

    `vehicle` is a driver, which is closed in the end, or what `--vehicle` takes. `config` is a TOML
    file; `settings` are its other keys, and win over it. Signals end it in the main thread only.
    Returns False where a thread hangs and would hold the interpreter's exit. Raises UserError where
    it cannot begin, and where it gave way to another runtime of the same vehicle id.
    """
    driver = None if vehicle is None or isinstance(vehicle, str) else vehicle
    flags = {"policy": policy and str(policy), "connect": connect, **settings}
    runtime: Optional[_Runtime] = None

    def end(number: int, frame: Any) -> None:
        if runtime is None:
            raise KeyboardInterrupt
        runtime.stop()

    try:
        # `unbuilt` closes what a build that fails has opened.
        with handled(ENDING_SIGNALS, end), contextlib.ExitStack() as unbuilt:
            if driver is not None:
                check_driver(driver)
                unbuilt.callback(close_in_time, driver)
            loaded = load_config(config, {**flags, "vehicle": vehicle if driver is None else NONE})
            log.configure(loaded.log_level)
            runtime = _Runtime(loaded, driver, unbuilt)
            unbuilt.pop_all()
            ended = runtime.run(until)
    finally:
        written = log.close()
    return ended and written


class _Runtime:
    """Opens and connects all parts; `run` closes them. Raises UserError if one does not open."""

    def __init__(
        self, config: Config, vehicle: Optional[Vehicle], unbuilt: contextlib.ExitStack
    ) -> None:
        self._config = config
        self._tls: Optional[TlsFiles] = None
        if config.tls is not None:
            self._tls = load_tls(config.tls)
            name, expires = self._tls.name, self._tls.expires
            check_name(name, common_name(EDGE, config.vehicle_id))
            log.event("info", "certificate", of=name, expires=f"{expires:%Y-%m-%dT%H:%MZ}")
        if config.vehicle != NONE:
            find_vehicle(config.vehicle)  # first: a misspelt name fails before the policy loads
        self._policy = load_policy(str(config.policy), config.public_key, config.allow_unsigned)
        manifest = self._policy.manifest
        if config.vehicle != NONE:
            vehicle = make_vehicle(config.vehicle, config.vehicle_settings, manifest)
            unbuilt.callback(close_in_time, vehicle)
        if vehicle is not None:
            vehicle.take_bounds(config.bounds)
            if vehicle.allowed != config.bounds:  # the runtime would enforce no bounds
                raise UserError(f"vehicle {vehicle.name}: its take_bounds must call Vehicle's own")
        controller = _controller(config, self._policy, vehicle)
        # Both sessions hear only what this vehicle's edge may hear.
        access = None if self._tls is None else rules_for_edge(config.vehicle_id)
        connected = partial(open_session, connect=config.connect, tls=self._tls, access=access)
        self._open_client = partial(connected, mode="client")
        require_free(self._open_client, config.vehicle_id)
        self._session = connected(mode="peer")
        unbuilt.callback(self._session.close)  # An open one would hang the process at its exit.
        listener = None if self._tls is None else Listener(config.connect, self._tls)
        self._link = Link(self._session, config.vehicle_id, manifest, listener)
        self._vehicle: Optional[VehicleRunner] = None
        if vehicle is not None:
            names = [row.name for row in manifest.action]
            self._vehicle = VehicleRunner(vehicle, names, partial(self._link.send, "feedback"))
        self._notifier = service.Notifier()
        hint = rearm_command(config.connect, config.vehicle_id, self._tls)
        parts = (self._policy, controller, self._link, self._notifier, self._vehicle, hint)
        self._loop = ControlLoop(*parts)
        self.stop = self._loop.stop
        self._over = threading.Event()
        self._failures: List[BaseException] = []

    def run(self, until: Optional[threading.Event]) -> bool:
        """Drive until `stop` is called; return False where a thread hangs. Raises UserError."""
        if until is not None:
            threading.Thread(target=lambda: until.wait() and self.stop(), daemon=True).start()
        # A thread of its own: a stalled reader of stdout must not hold the watchdog (main thread).
        announcer = threading.Thread(target=self._announce, name="announce", daemon=True)
        # Loaded objects stay: the garbage collector need not scan them in the middle of a drive.
        gc.collect()
        gc.freeze()
        try:
            if self._vehicle is not None:
                self._vehicle.start(self._config.is_armed_at_start)
            self._loop.start()
            announcer.start()
            self._loop.run()
        finally:
            ended = self._close(announcer)
        if self._failures:
            raise self._failures[0]
        if self._link.gave_way:
            raise taken(self._config.vehicle_id)
        if self._tls is not None:
            self._tls.require_valid(time.time())
        return ended

    def _announce(self) -> None:
        """Declare the liveliness tokens, print "ready", and log why no states arrive."""
        config, policy = self._config, self._policy
        try:
            self._link.appear(self._open_client, self.stop)
            if policy.trust != VERIFIED:
                log.event("warning", "policy_not_verified", trust=policy.trust)
            health = self._loop.health()
            who = f"ready vehicle_id={config.vehicle_id} vehicle={health.vehicle}"
            what = f"policy_id={policy.policy_id} verified_by={policy.public_key or 'none'}"
            print(printable(f"{who} connect={config.connect} {what}"), flush=True)
            self._notifier.tell(f"READY=1\nSTATUS={health.mode}")
            while not self._over.wait(_WAITING_PERIOD_S) and not self._loop.has_heard():
                answers, why = why_no_link(config.connect, self._tls)
                state = f"answers, and sends no state for {config.vehicle_id}" if answers else why
                log.event("warning", "waiting", why=f"{config.connect}: {state}")
        except BaseException as error:  # the main thread raises it
            self._failures.append(error)
            self.stop()

    def _close(self, announcer: threading.Thread) -> bool:
        """End the threads, brake and close the vehicle; returns False where one of them hangs."""
        self._over.set()
        gc.unfreeze()  # another `drive` may follow in this process
        self._notifier.tell("STOPPING=1")
        ended = self._loop.close()
        if self._vehicle is not None:
            ended = self._vehicle.close() and ended
        if announcer.ident is not None:
            announcer.join(_ANNOUNCE_S)
            ended = ended and not announcer.is_alive()
        # A suspended peer may block it.
        ended = ends_within(_CLOSE_S, self._link.close) and ended
        health = self._loop.health()
        shown = ("accepted", "rejected", "deadline_misses", "safe_stops")
        fields = {name: getattr(health, name) for name in shown}
        log.event("info", "ended", **fields, link=link_words(health.link))
        return ended


def _controller(config: Config, policy: Policy, vehicle: Optional[Vehicle]) -> Controller:
    manifest, its_limits = policy.manifest, {}
    if vehicle is not None:
        vehicle.control_period_s = manifest.control_period_s
        its_limits = vehicle.allowed_limits
    rules = ControllerConfig(
        limits=shared_limits(manifest.action, its_limits),
        control_period_s=manifest.control_period_s,
        needs_rearm=vehicle is not None,
        armed_at_start=config.is_armed_at_start,
        task=policy.layout.task_text,
        ride_s=config.ride_through.max_s,
        each_episode=config.rearm == EACH_EPISODE,
    )
    return Controller(rules)
