"""`python -m edge_runtime jog`: the first moves of a vehicle whose wheels are up, one Enter each.

An operator goes through STEPS. Each says what will move, waits for Enter, has the driver do it,
measures by the vehicle's feedback, and brakes. Whatever is not as expected ends the jog with a
stop. It calls the driver as the runtime does, within the operator's bounds and its own.
"""

from __future__ import annotations

import argparse
import math
import sys
import termios
import time
from functools import partial
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

from edge_runtime import log
from edge_runtime.bounds import STEERING, Bounds, Leash, narrowed
from edge_runtime.cli import ENDING_SIGNALS, examples, handled
from edge_runtime.config import NONE, add_flags, load_config
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.manifest import Action, Car, Entry, Manifest
from edge_runtime.util import UserError, printable
from edge_runtime.vehicles import make_vehicle
from edge_runtime.vehicles.base import Vehicle, VehicleReport, close_in_time
from edge_runtime.vehicles.plausibility import OVER_CAP, OVER_CAP_MPS, PEDAL

CRAWL_MPS, CRAWLS_S, STEERS_RAD = 0.2, 2.0, math.radians(5.0)
SPEED_OFF, STEERING_OFF = 0.25, 0.4  # of what was asked: so far from it is as expected
PEDAL_SHARE = 0.5  # of full throttle, up to the crawl
STEERING_SHARE = 0.1  # of full lock, where the driver does not know its angle
STANDS_MPS = 0.04
CONTROL_PERIOD_S, LOOK_S, HOLDS_S, SOON_S, LATER_S = 0.1, 0.02, 0.5, 1.0, 4.0
BRAKES_S = 0.8  # a Hunter's driver locks the parking brake after 1 s
PERSON_S, PERSON_CRAWLS_S = 30.0, 10.0  # to reach for a button
PASSED, FAILED, NOT_TRIED = "passed", "failed", "not_tried"
REMOTE, ESTOP, SILENCE, TURNS = "remote_control", "emergency_stop", "silence", "steering_at_a_stand"
EXAMPLE = examples(
    "python -m edge_runtime jog --config edge.toml --out jog.json",
    "python -m edge_runtime jog --vehicle hunter --bus socketcan:can0",
)
Condition = Callable[[VehicleReport], Any]
nothing: Condition = lambda it: False  # noqa: E731
stands: Condition = lambda it: abs(it.speed_mps) <= STANDS_MPS  # noqa: E731


class UnexpectedError(Exception):
    """What was measured, or done, in place of what was expected."""


def bench_manifest(task: str, period_s: float) -> Manifest:
    """Return that of a policy which no file holds, to open a driver with: +1 steers to the left."""
    return Manifest(
        task=task, observation={"frames": Entry(dtype="uint8", shape=[1])},
        action=[Action(name=name, low=-1.0, high=1.0) for name in (PEDAL, STEERING)],
        car=Car(throttle_mps2=3.0, brake_mps2=4.0, max_speed_mps=6.0, full_steering_rad=0.5,
                wheelbase_m=5.0),
        control_period_s=period_s, algorithm="", training={}, created="",
    )  # fmt: skip


class Jog:
    """Calls a driver, and looks at each of its reports.

    `ask` is passed the step's name and what the operator is to do or to confirm; it raises
    UnexpectedError otherwise. `left`: the sign of a steering to the left. Raises UserError where
    the bounds are above the model's.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        bounds: Bounds,
        ask: Callable[[str, str], None],
        left: float = 1.0,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.vehicle, self.now, self._ask, self._sleep = vehicle, now, ask, sleep
        self.step, self.last = "", VehicleReport({}, 0.0, True, [])
        vehicle.control_period_s, model = CONTROL_PERIOD_S, vehicle.model_limits
        vehicle.take_bounds(bounds)  # refuses what the model cannot do
        self.crawl_mps = min(CRAWL_MPS, bounds.max_speed_mps, model.max_speed_mps)
        knows_angle = model.full_steering_rad < math.inf
        most_rad = min(STEERS_RAD, bounds.max_steering_rad, model.max_steering_rad)
        own = Bounds(self.crawl_mps, most_rad if knows_angle else math.inf, bounds.leash_m)
        vehicle.take_bounds(own)
        limits = narrowed(vehicle.limits, own, model)
        self._still = {name: min(max(0.0, row.low), row.high) for name, row in limits.items()}
        self._throttle = 0.0
        if PEDAL in limits:
            self._still[PEDAL], self._throttle = limits[PEDAL].low, PEDAL_SHARE * limits[PEDAL].high
        self.turns: List[float] = []  # to the left, to the right
        if STEERING in limits:
            ends, share = limits[STEERING][:2], 1.0 if knows_angle else STEERING_SHARE
            self.turns = sorted((share * end for end in ends), reverse=left > 0)
        self.has = {PEDAL} & limits.keys() | vehicle.outranked_by.keys()
        if self.turns and vehicle.steers_at_a_stand:
            self.has.add(TURNS)
        if type(vehicle).mute is not Vehicle.mute:
            self.has.add(SILENCE)
        self._leash, self.steering, self.most_mps = Leash(bounds.leash_m), 0.0, STANDS_MPS

    def ask(self, text: str) -> None:
        self._ask(self.step, text)

    def go_on(
        self,
        drives: Optional[bool],
        limit_s: float,
        until: Optional[Condition] = None,
        never: Condition = lambda it: it.faults,
    ) -> float:
        """Command a crawl or a stand (None: nothing) for a time; return how long it took `until`.

        Raises UnexpectedError where that does not come, and at once where the vehicle is too fast
        or goes backwards, has used up its leash, or does what it must `never`.
        """
        begin_s, comes = self.now(), False
        while not comes and (now_s := self.now()) - begin_s <= limit_s:
            if drives is not None:
                self.vehicle.command(self._action(drives), now_s)
            self.last = it = self.vehicle.feedback(now_s)
            self._leash.note(it.speed_mps, now_s)
            is_within = -STANDS_MPS <= it.speed_mps <= self.most_mps  # NaN is not
            if not is_within or self._leash.is_used(LOOK_S) or never(it):
                raise UnexpectedError(self.measured())
            comes = until is not None and until(it)
            self._sleep(LOOK_S)
        if until is not None and not comes:
            raise UnexpectedError(f"{self.measured()}, after {limit_s:g} s")
        return now_s - begin_s

    def measured(self) -> str:
        """Return the newest report in words."""
        it = self.last
        numbers = [f"{name} {value:.2f}" for name, value in it.action.items()]
        battery = [f"battery {it.battery_v:.1f} V"] if it.battery_v is not None else []
        brakes = ["brakes by itself"] if it.self_braking else []
        leash = ["the leash is used up"] if self._leash.is_used(LOOK_S) else []
        told = dict.fromkeys([*it.faults, *it.standing])
        return ", ".join([f"{it.speed_mps:.2f} m/s", *numbers, *battery, *brakes, *leash, *told])

    def _action(self, drives: bool) -> Dict[str, float]:
        action = dict(self._still)
        if STEERING in action:
            action[STEERING] = self.steering
        if drives:  # a driver without a cap of its own gets no more throttle at the crawl
            action[PEDAL] = self._throttle if self.last.speed_mps < self.crawl_mps else 0.0
        return action

    def begin(self) -> None:
        """Take control of a vehicle that stands: the operator's Enter is its re-arm."""
        self.steering, self.most_mps = 0.0, STANDS_MPS
        self.go_on(None, LATER_S, lambda it: not it.standing, never=nothing)
        self._leash.begin()
        self.vehicle.enable(self.now())
        self.go_on(False, LATER_S, lambda it: not it.self_braking)

    def crawl(self) -> None:
        """Begin, and come to the crawl."""
        self.begin()
        self.most_mps = OVER_CAP * self.crawl_mps + OVER_CAP_MPS
        self.go_on(True, LATER_S, lambda it: it.speed_mps >= (1 - SPEED_OFF) * self.crawl_mps)

    def stop(self) -> None:
        self.vehicle.brake(self.now())
        self.go_on(None, LATER_S, stands, never=nothing)

    def stays_stopped(self) -> None:
        """Ask for a crawl, which a stopped vehicle must not obey."""
        self.most_mps = STANDS_MPS
        self.go_on(PEDAL in self.has, HOLDS_S, never=nothing)

    def tells(self, cause: str, drives: bool, limit_s: float) -> None:
        """Wait until the driver tells of what outranks it."""
        words = self.vehicle.outranked_by[cause]
        self.go_on(drives, limit_s, lambda it: words in it.standing, never=nothing)

    def refuses(self, cause: str) -> None:
        """Have it enabled in vain while the cause is there; without it, it waits to be enabled."""
        self.stays_stopped()
        self.tells(cause, False, HOLDS_S)  # so the runtime refuses a re-arm
        self.vehicle.enable(self.now())
        self.go_on(False, HOLDS_S, never=lambda it: not it.self_braking)
        self.vehicle.brake(self.now())
        self.tells(cause, False, HOLDS_S)
        self.ask("let go of it; nothing moves")
        self.go_on(None, LATER_S, lambda it: not it.standing, never=nothing)
        self.stays_stopped()


def _feedback(jog: Jog) -> str:
    jog.go_on(None, SOON_S, lambda it: not it.standing)
    jog.go_on(None, SOON_S, never=lambda it: it.standing or it.faults)
    jog.begin()
    jog.go_on(False, HOLDS_S)
    return jog.measured()


def _outranked(jog: Jog, cause: str) -> str:
    jog.begin()
    jog.tells(cause, False, PERSON_S)
    measured = jog.measured()
    jog.refuses(cause)
    return measured


def _steering(jog: Jog) -> str:
    shares = []
    for asked, side in zip(jog.turns, ("LEFT", "RIGHT")):
        jog.ask(f"the front wheels turn a little to the {side}, and back")
        jog.begin()
        jog.steering = asked
        jog.go_on(False, SOON_S)
        shares.append(jog.last.action[STEERING] / asked)
        if not abs(shares[-1] - 1.0) <= STEERING_OFF:
            raise UnexpectedError(f"{side}: {shares[-1]:.0%} of what was asked")
        jog.steering = 0.0
        jog.go_on(False, SOON_S)
        jog.stop()
        jog.ask(f"they did turn to the {side}")
    return ", ".join(f"{share:.0%}" for share in shares) + " of what was asked"


def _crawl(jog: Jog) -> str:
    jog.crawl()
    least_mps = (1 - 2 * SPEED_OFF) * jog.crawl_mps
    jog.go_on(True, CRAWLS_S, never=lambda it: it.faults or it.speed_mps < least_mps)
    measured = jog.measured()
    jog.stop()
    jog.ask("they did turn FORWARDS")
    return measured


def _brake(jog: Jog) -> str:
    jog.crawl()
    jog.vehicle.brake(jog.now())
    took_s = jog.go_on(True, BRAKES_S, stands, never=nothing)
    jog.stays_stopped()
    return f"stood after {took_s:.2f} s"


def _silence(jog: Jog, mutes: bool) -> str:
    jog.crawl()
    if mutes:
        jog.vehicle.mute()
    took_s = jog.go_on(True if mutes else None, SOON_S, stands, never=nothing)
    return f"stood after {took_s:.2f} s"


def _rearm(jog: Jog) -> str:
    jog.crawl()
    jog.tells(ESTOP, True, PERSON_CRAWLS_S)
    took_s = jog.go_on(None, BRAKES_S, stands, never=nothing)
    jog.refuses(ESTOP)
    return f"stood after {took_s:.2f} s"


class Step(NamedTuple):
    """`needs`: of `Jog.has`. `do` returns what was measured; UnexpectedError: the jog is over."""

    name: str
    needs: Tuple[str, ...]
    moves: str  # what will move, and what the operator does
    expected: str
    do: Callable[[Jog], str]


_SLOW = f"the wheels turn forwards, at {CRAWL_MPS:g} m/s at most"
_WAITS = "stops and tells why; refuses until let go, then stands until a re-arm"
_PRESS = "press the emergency stop, and hold it, within"
STEPS = (
    Step("feedback", (), "nothing moves; its brake is released", "alive, stands, no fault",
         _feedback),
    Step(REMOTE, (REMOTE,), f"nothing moves: take over by remote control within {PERSON_S:g} s, and"
         " leave its sticks alone", _WAITS, partial(_outranked, cause=REMOTE)),
    Step(ESTOP, (ESTOP,), f"nothing moves: {_PRESS} {PERSON_S:g} s", _WAITS,
         partial(_outranked, cause=ESTOP)),
    Step("steering", (TURNS,), "the front wheels only, twice", f"{1 - STEERING_OFF:.0%} to"
         f" {1 + STEERING_OFF:.0%} of {math.degrees(STEERS_RAD):.0f} degrees or less", _steering),
    Step("crawl", (PEDAL,), f"{_SLOW}, for {CRAWLS_S:g} s", f"{1 - SPEED_OFF:.0%} to {OVER_CAP:.0%}"
         " of that, or of a lower cap", _crawl),
    Step("brake", (PEDAL,), f"{_SLOW}, and are braked",
         f"stands within {BRAKES_S:g} s, and no command moves it", _brake),
    Step("watchdog", (PEDAL,), f"{_SLOW}, until no command comes",
         f"stands within {SOON_S:g} s", partial(_silence, mutes=False)),
    Step("link_watchdog", (PEDAL, SILENCE), f"{_SLOW}, until the driver sends nothing",
         f"stands within {SOON_S:g} s", partial(_silence, mutes=True)),
    Step("rearm_refused", (PEDAL, ESTOP), f"{_SLOW}: {_PRESS} {PERSON_CRAWLS_S:g} s",
         f"stands within {BRAKES_S:g} s; {_WAITS}", _rearm),
)  # fmt: skip


def walk(jog: Jog, rows: List[Dict[str, str]]) -> None:
    """Go through the steps until one is not as expected; add a row for each, the rest too."""
    over = ""
    for step in STEPS:
        lacks = [need for need in step.needs if need not in jog.has]
        measured = over or "".join(f"the driver has no {need}. " for need in lacks).rstrip()
        result = NOT_TRIED if measured else PASSED
        if not measured:
            jog.step = step.name
            try:
                jog.ask(step.moves)
                measured = step.do(jog)
                jog.stop()
            except (Exception, KeyboardInterrupt) as error:  # a driver raises anything
                close_in_time(jog.vehicle)
                known = isinstance(error, UnexpectedError)
                result, measured = FAILED, printable(str(error) if known else repr(error))
                over = f"{step.name} was not as expected"
        rows.append(
            {"name": step.name, "expected": step.expected, "measured": measured, "result": result}
        )
        print(f"{result:<9} {step.name}: {measured}", flush=True)


def ask(name: str, text: str) -> None:
    """Wait for Enter. What was typed before the question is no answer to it."""
    print(f"{name}: {text}\n    Enter: yes; q: stop", flush=True)
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    if (line := sys.stdin.readline()).strip() or not line:
        raise UnexpectedError("ended by the operator")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", metavar="FILE.toml", help="settings file, as for `run`")
    add_flags(parser, "vehicle", "bus")
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def run(arguments: argparse.Namespace) -> int:
    """Return 0 where all was as expected that the driver can do, else 1."""
    out = check_writable(arguments.out)
    flags = {"policy": "none", "vehicle": arguments.vehicle, "bus": arguments.bus}
    config = load_config(arguments.config, flags, opens_link=False)
    if config.vehicle == NONE:
        raise UserError("no vehicle to jog: name it with --vehicle")
    log.configure("error")
    manifest = bench_manifest("jog", CONTROL_PERIOD_S)
    vehicle = make_vehicle(config.vehicle, config.vehicle_settings, manifest)
    car = config.vehicle_settings.get(vehicle.name, {}).get("car", {})
    interrupted: List[int] = []

    def interrupt(number: int, frame: Any) -> None:
        interrupted.append(number)
        if len(interrupted) == 1:  # a second one must not keep it from its end
            raise KeyboardInterrupt

    rows: List[Dict[str, str]] = []
    with handled(ENDING_SIGNALS, interrupt):
        try:
            walk(Jog(vehicle, config.bounds, ask, car.get("full_steering_rad", 1.0)), rows)
        finally:
            close_in_time(vehicle)
            passed = len(rows) == len(STEPS) and all(row["result"] != FAILED for row in rows)
            if rows:
                report = {"steps": rows, "result": PASSED if passed else FAILED}
                write_json_out(out, report)
    log.close()
    return 0 if passed else 1
