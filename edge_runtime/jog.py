"""`python -m edge_runtime jog`: the first moves of a vehicle whose wheels are up, one Enter each.

Each of STEPS announces a move, waits for Enter, commands the driver as the runtime would, checks
the vehicle's feedback, and brakes. An unexpected result ends the jog with a stop.
"""

from __future__ import annotations

import argparse
import math
import sys
import termios
import time
from functools import partial
from typing import Any, Callable, Dict, List, Optional, Tuple

from edge_runtime import log
from edge_runtime.bounds import STEERING, Bounds, Leash, narrowed
from edge_runtime.cli import ENDING_SIGNALS, examples, handled
from edge_runtime.config import NONE, add_flags, load_config
from edge_runtime.controller import neutral_action
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.manifest import Action, Car, Entry, Manifest
from edge_runtime.util import UserError
from edge_runtime.vehicles import make_vehicle
from edge_runtime.vehicles.base import Vehicle, VehicleReport, close_in_time
from edge_runtime.vehicles.plausibility import OVER_CAP, OVER_CAP_MPS, PEDAL

CRAWL_MPS, CRAWLS_S, STEERS_RAD = 0.2, 2.0, math.radians(5.0)
SPEED_OFF, STEERING_OFF = 0.25, 0.4  # tolerances, as a share of what was asked
PEDAL_SHARE = 0.5  # of full throttle, up to the crawl
STEERING_SHARE = 0.1  # of full lock, if the driver does not know its angle
STANDS_MPS = 0.04
CONTROL_PERIOD_S, LOOK_S, HOLDS_S, SOON_S, LATER_S = 0.1, 0.02, 0.5, 1.0, 4.0
BRAKES_S = 0.8  # a Hunter's driver locks the parking brake after 1 s
PERSON_S, PERSON_CRAWLS_S = 30.0, 10.0  # to reach for a button
PASSED, FAILED, NOT_TRIED = "passed", "failed", "not_tried"
REMOTE, ESTOP = "remote_control", "emergency_stop"
SILENCE, TURNS = "way_to_fall_silent", "steering_at_a_stand"
EXAMPLE = examples("python -m edge_runtime jog --config edge.toml --out jog.json")
Condition = Callable[[Any], Any]  # of a report
Ask = Callable[[str, str], None]


def faults(report: Any) -> Any:
    return report.faults


def nothing(report: Any) -> bool:
    return False


def stands(report: Any) -> bool:
    return abs(report.speed_mps) <= STANDS_MPS


def in_words(report: VehicleReport) -> str:
    numbers = [f"{name} {value:.2f}" for name, value in report.action.items()]
    battery = [] if report.battery_v is None else [f"battery {report.battery_v:.1f} V"]
    brakes = ["brakes by itself"] if report.self_braking else []
    reasons = dict.fromkeys([*report.faults, *report.standing])
    return ", ".join([f"{report.speed_mps:.2f} m/s", *numbers, *battery, *brakes, *reasons])


def bench_manifest(task: str, period_s: float) -> Manifest:
    """Make a manifest that opens a driver without a policy; steering +1 is to the left."""
    return Manifest(
        task=task, observation={"frames": Entry(dtype="uint8", shape=[1])},
        action=[Action(name=name, low=-1.0, high=1.0) for name in (PEDAL, STEERING)],
        car=Car(throttle_mps2=3.0, brake_mps2=4.0, max_speed_mps=6.0, full_steering_rad=0.5,
                wheelbase_m=5.0),
        control_period_s=period_s, algorithm="", training={}, created="",
    )  # fmt: skip


class Jog:
    """Commands a driver within the operator's and the jog's bounds, and checks each of its reports.

    `ask` shows the operator a step's name and a text, and raises if the answer is no. `left` is the
    sign of a steering to the left. Raises UserError for bounds above the model's.
    """

    def __init__(
        self, vehicle: Vehicle, bounds: Bounds, ask: Ask, left: float = 1.0, clock: Any = time
    ) -> None:
        self.vehicle, self.ask = vehicle, ask
        self.now, self._sleep = clock.monotonic, clock.sleep
        vehicle.control_period_s, model = CONTROL_PERIOD_S, vehicle.model_limits
        knows_angle = model.full_steering_rad < math.inf
        most_rad = min(STEERS_RAD, bounds.max_steering_rad, model.max_steering_rad)
        self.crawl_mps = min(CRAWL_MPS, bounds.max_speed_mps, model.max_speed_mps)
        own = Bounds(self.crawl_mps, most_rad if knows_angle else math.inf, bounds.leash_m)
        for each in (bounds, own):
            vehicle.take_bounds(each)
        limits = narrowed(vehicle.limits, own, model)
        self._still, self._throttle = dict(zip(limits, neutral_action(limits))), 0.0
        if PEDAL in limits:
            self._still[PEDAL], self._throttle = limits[PEDAL].low, PEDAL_SHARE * limits[PEDAL].high
        share, ends = 1.0 if knows_angle else STEERING_SHARE, limits.get(STEERING, ())[:2]
        self.turns = sorted((share * end for end in ends), reverse=left > 0)  # left, right
        can = {TURNS: bool(ends) and vehicle.steers_at_a_stand, PEDAL: PEDAL in limits}
        can[SILENCE] = type(vehicle).mute is not Vehicle.mute
        self.has = {*vehicle.outranked_by, *(name for name in can if can[name])}
        self._leash, self.last = Leash(bounds.leash_m), VehicleReport({}, 0.0, True, [])
        self.steering, self._most_mps = 0.0, STANDS_MPS

    def go_on(
        self, drives: Optional[bool], limit_s: float, until: Any = None, never: Condition = faults
    ) -> float:
        """Command a crawl, a stand or (None) nothing until `until` holds; return the seconds taken.

        Raises UserError if `until` does not hold within `limit_s`, and at once if the vehicle is
        too fast, goes backwards, has used up its leash, or if `never` holds.
        """
        begin_s, holds = self.now(), False
        while not holds and (now_s := self.now()) - begin_s <= limit_s:
            if drives is not None:
                self.vehicle.command(self._action(drives), now_s)
            self.last = report = self.vehicle.feedback(now_s)
            self._leash.note(report.speed_mps, now_s)
            is_within = -STANDS_MPS <= report.speed_mps <= self._most_mps  # NaN is not
            if not is_within or self._leash.is_used(LOOK_S) or never(report):
                raise UserError(self.measured())
            holds = until is not None and until(report)
            self._sleep(LOOK_S)
        if until is not None and not holds:
            raise UserError(f"{self.measured()}, after {limit_s:g} s")
        return float(now_s - begin_s)

    def measured(self) -> str:
        used = self._leash.is_used(LOOK_S)
        return in_words(self.last) + (", the leash is used up" if used else "")

    def _action(self, drives: bool) -> Dict[str, float]:
        action = dict(self._still)
        if STEERING in action:
            action[STEERING] = self.steering
        if drives:  # no throttle above the crawl, for a driver without a speed cap
            action[PEDAL] = self._throttle if self.last.speed_mps < self.crawl_mps else 0.0
        return action

    def begin(self, crawls: bool = False) -> None:
        """Take control of a vehicle that stands: the operator's Enter is its re-arm."""
        self.steering, self._most_mps = 0.0, STANDS_MPS
        self.go_on(None, LATER_S, lambda it: not it.standing, never=nothing)
        self._leash.begin()
        self.vehicle.enable(self.now())
        self.go_on(False, LATER_S, lambda it: not it.self_braking)
        if crawls:
            self._most_mps = OVER_CAP * self.crawl_mps + OVER_CAP_MPS

    def crawl(self) -> None:
        self.begin(crawls=True)
        self.go_on(True, LATER_S, lambda it: it.speed_mps >= (1 - SPEED_OFF) * self.crawl_mps)

    def stop(self) -> None:
        """Brake; then check that a commanded crawl moves nothing."""
        self.vehicle.brake(self.now())
        self.go_on(None, LATER_S, stands, never=nothing)
        self._most_mps = STANDS_MPS
        self.go_on(PEDAL in self.has or None, HOLDS_S, never=nothing)

    def tells(self, cause: str, drives: bool, limit_s: float) -> None:
        words = self.vehicle.outranked_by[cause]
        self.go_on(drives, limit_s, lambda it: words in it.standing, never=nothing)


def _feedback(jog: Jog, name: str) -> str:
    jog.go_on(None, SOON_S, lambda it: not it.standing)
    jog.go_on(None, SOON_S, never=lambda it: it.standing or it.faults)
    jog.begin()
    jog.go_on(False, HOLDS_S)
    return jog.measured()


def _outranked(
    jog: Jog, name: str, cause: str, crawls: bool = False, limit_s: float = PERSON_S
) -> str:
    jog.begin(crawls)
    jog.tells(cause, crawls, limit_s)
    took_s = jog.go_on(None, BRAKES_S, stands, never=nothing)
    jog.stop()
    jog.tells(cause, False, HOLDS_S)  # the runtime then refuses a re-arm, and so must the driver:
    jog.vehicle.enable(jog.now())
    jog.go_on(False, HOLDS_S, never=lambda it: not it.self_braking)
    jog.vehicle.brake(jog.now())
    jog.tells(cause, False, HOLDS_S)
    measured = f"stood after {took_s:.2f} s: {jog.measured()}"
    jog.ask(name, "now let go of it; nothing moves")
    jog.go_on(None, LATER_S, lambda it: not it.standing, never=nothing)
    return measured


def _steering(jog: Jog, name: str) -> str:
    shares = []
    for asked, side in zip(jog.turns, ("LEFT", "RIGHT")):
        jog.ask(name, f"what moves: the front wheels, a little to the {side} and back")
        jog.begin()
        jog.steering = asked
        jog.go_on(False, SOON_S)
        shares.append(jog.last.action[STEERING] / asked)
        if not abs(shares[-1] - 1.0) <= STEERING_OFF:
            raise UserError(f"{side}: {shares[-1]:.0%} of what was asked")
        jog.steering = 0.0
        jog.go_on(False, SOON_S)
        jog.stop()
        jog.ask(name, f"did they turn to the {side}?")
    return ", ".join(f"{share:.0%}" for share in shares) + " of what was asked"


def _crawl(jog: Jog, name: str) -> str:
    jog.crawl()
    least_mps = (1 - 2 * SPEED_OFF) * jog.crawl_mps
    jog.go_on(True, CRAWLS_S, never=lambda it: it.faults or it.speed_mps < least_mps)
    measured = jog.measured()
    jog.stop()
    jog.ask(name, "did they turn FORWARDS?")
    return measured


def _stops(
    jog: Jog, name: str, by: Callable[[Any], Any], commands: Any = True, limit_s: float = SOON_S
) -> str:
    jog.crawl()
    by(jog)
    return f"stood after {jog.go_on(commands, limit_s, stands, never=nothing):.2f} s"


_SLOW = f"the wheels turn forwards, at {CRAWL_MPS:g} m/s at most"
_WAITS = f"stops within {BRAKES_S:g} s, tells why, and refuses a re-arm until it is let go of"
_PRESS = "after Enter press the emergency stop within"
_CRAWL = f"{1 - SPEED_OFF:.0%} to {OVER_CAP:.0%} of {CRAWL_MPS:g} m/s, or of a lower cap"
_ANGLE = f"{1 - STEERING_OFF:.0%} to {1 + STEERING_OFF:.0%} of the angle asked, at most 5 degrees"
# Name, abilities that the driver needs (`Jog.has`), what moves and what the operator does, expected
# result, and a function that returns the measurement; its exception ends the jog.
Step = Tuple[str, Tuple[str, ...], str, str, Callable[[Jog, str], str]]
STEPS: Tuple[Step, ...] = (
    ("feedback", (), "nothing; the brake is released", "alive, no fault, stands", _feedback),
    (REMOTE, (REMOTE,), f"nothing; after Enter take over by remote control, its sticks at rest,"
     f" within {PERSON_S:g} s", _WAITS, partial(_outranked, cause=REMOTE)),
    (ESTOP, (ESTOP,), f"nothing; {_PRESS} {PERSON_S:g} s", _WAITS,
     partial(_outranked, cause=ESTOP)),
    ("steering", (TURNS,), "the front wheels only", _ANGLE, _steering),
    ("crawl", (PEDAL,), f"{_SLOW}, for {CRAWLS_S:g} s", _CRAWL, _crawl),
    ("brake", (PEDAL,), f"{_SLOW}, and are braked", f"stands within {BRAKES_S:g} s, latched",
     partial(_stops, by=lambda it: it.vehicle.brake(it.now()), limit_s=BRAKES_S)),
    ("watchdog", (PEDAL,), f"{_SLOW}, until no command comes", f"stands within {SOON_S:g} s",
     partial(_stops, by=nothing, commands=None)),
    ("link_watchdog", (PEDAL, SILENCE), f"{_SLOW}, until the driver sends nothing",
     f"stands within {SOON_S:g} s", partial(_stops, by=lambda it: it.vehicle.mute())),
    ("rearm_refused", (PEDAL, ESTOP), f"{_SLOW}; {_PRESS} {PERSON_CRAWLS_S:g} s", _WAITS,
     partial(_outranked, cause=ESTOP, crawls=True, limit_s=PERSON_CRAWLS_S)),
)  # fmt: skip


def walk(jog: Jog, rows: List[Dict[str, str]]) -> None:
    """Run the steps until one fails; add a row for each step, also for those not tried."""
    over = ""
    for name, needs, moves, expected, do in STEPS:
        lacks = [need.replace("_", " ") for need in needs if need not in jog.has]
        measured = over or ", ".join(f"the driver knows of no {it}" for it in lacks)
        result = NOT_TRIED
        if not measured:
            try:
                jog.ask(name, f"what moves: {moves}")
                measured = do(jog, name)
                jog.stop()
                result = PASSED
            except BaseException as error:  # a driver raises anything, and exits
                close_in_time(jog.vehicle)
                result, measured = FAILED, str(UserError(str(error) or type(error).__name__))
                over = f"{name} was not as expected"
        row = {"name": name, "expected": expected, "measured": measured, "result": result}
        rows.append(row)
        print(f"{result:<9} {name}: {measured}", flush=True)


def ask(name: str, text: str) -> None:
    """Wait for Enter; discard what was typed before the question."""
    print(f"{name}: {text}\n    Enter: yes; q: stop", flush=True)
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    if (line := sys.stdin.readline()).strip() or not line:
        raise UserError("ended by the operator")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", metavar="FILE.toml", help="settings file, as for `run`")
    add_flags(parser, "vehicle", "bus")
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def run(arguments: argparse.Namespace) -> int:
    """Return 0 if every step that the driver is able to do has passed, else 1."""
    out = check_writable(arguments.out)
    flags = {"policy": "none", "vehicle": arguments.vehicle, "bus": arguments.bus}
    config = load_config(arguments.config, flags, opens_link=False)
    if config.vehicle == NONE:
        raise UserError("no vehicle to jog: name it with --vehicle")
    log.configure("error")
    tables = config.vehicle_settings
    rows: List[Dict[str, str]] = []
    vehicle = make_vehicle(config.vehicle, tables, bench_manifest("jog", CONTROL_PERIOD_S))
    car = tables.get(vehicle.name, {}).get("car")
    left = car.get("full_steering_rad", 1.0) if isinstance(car, dict) else 1.0
    interrupted = passed = False

    def interrupt(number: int, frame: Any) -> None:
        nonlocal interrupted
        if not interrupted:  # a second signal must not interrupt the closing
            interrupted = True
            raise KeyboardInterrupt

    with handled(ENDING_SIGNALS, interrupt):
        try:
            walk(Jog(vehicle, config.bounds, ask, left), rows)
            passed = all(row["result"] != FAILED for row in rows)
        except KeyboardInterrupt:  # between two steps
            pass
        finally:
            close_in_time(vehicle)
            if rows:
                write_json_out(out, {"steps": rows, "result": PASSED if passed else FAILED})
            log.close()
    return 0 if passed else 1
