"""``python -m hil_tests conformance``: test a vehicle's driver against the safety rules.

The driver and the clock are real; the vehicle may be a mock. As in the edge runtime, one thread
calls the driver. The vehicle will drive, with each action at its highest: lift the wheels.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time
from collections.abc import Callable
from typing import Any

from edge_runtime import log
from edge_runtime.cli import examples
from edge_runtime.config import NONE, load_config
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.jog import bench_manifest, in_words
from edge_runtime.util import UserError, printable
from edge_runtime.vehicles import make_vehicle
from edge_runtime.vehicles.base import Vehicle, VehicleReport, close_in_time

LATE_S = 0.05  # allowed lateness of a driver, besides a fifth of T
CALL_S = 0.05  # a longer call would delay the runtime's feedback
MOVES_MPS, STANDS_MPS = 0.1, 0.05
ROUNDING = 1e-3
PATIENCE_S = 10.0  # limit until the vehicle moves, or stands
EXAMPLE = examples(
    "python -m hil_tests conformance --vehicle mock",
    "python -m hil_tests conformance --vehicle my_vehicle:Rover --config edge.toml",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--vehicle", metavar="NAME|MODULE:CLASS", help="the driver (default: that of --config)")
    add("--config", metavar="FILE.toml", help="its settings, as for `edge_runtime run`")
    add("--out", metavar="R.json", type=check_writable, help="write the report to this file")
    add("--period-s", type=float, default=0.1, metavar="S", help="the policy's control period T")


def run(arguments: argparse.Namespace) -> int:
    """Print a line for each rule; return 0 if the driver keeps all, 1 if it breaks one."""
    flags = {"policy": "any", "vehicle": arguments.vehicle}
    config = load_config(arguments.config, flags, opens_link=False)
    if config.vehicle == NONE:
        raise UserError("no vehicle to try: name it with --vehicle")
    log.configure("error")
    manifest = bench_manifest("conformance", arguments.period_s)
    vehicle = make_vehicle(config.vehicle, config.vehicle_settings, manifest)
    bench, rules = Bench(vehicle, arguments.period_s), dict[str, str]()
    try:
        for rule, is_kept in RULES.items():
            try:
                wrong = "" if is_kept(bench) else f"last report: {in_words(bench.last)}"
            # A driver may raise anything; the next rule is tried all the same.
            except (Exception, SystemExit) as error:
                wrong = f"{type(error).__name__}: {error}"
            rules[rule] = printable(wrong)
            print(f"broken  {rule}: {rules[rule]}" if wrong else f"kept    {rule}", flush=True)
    finally:
        close_in_time(vehicle)  # the last rule has closed it, if it was reached
        log.close()
    kept = list(rules.values()).count("")
    write_json_out(arguments.out, {"vehicle": vehicle.name, "rules": rules})
    print(f"{vehicle.name}: {kept} rules kept, {len(RULES) - kept} broken")
    return 0 if kept == len(RULES) else 1


class Bench:
    """Calls a driver as the runtime does, times the calls and keeps the last report."""

    def __init__(self, vehicle: Vehicle, period_s: float) -> None:
        self.vehicle, self.period_s, self.pause_s = vehicle, period_s, min(period_s / 4, 0.02)
        vehicle.control_period_s = period_s
        self.go = {name: limit.high for name, limit in vehicle.limits.items()}
        self.longest_s, self.well_formed = 0.0, True
        self.last = VehicleReport({}, 0.0, True, [])

    def call(self, name: str, *arguments: Any, **options: Any) -> Any:
        now_s = time.monotonic()
        more = {"command": (now_s, None), "close": ()}.get(name, (now_s,))
        try:
            return getattr(self.vehicle, name)(*arguments, *more, **options)
        finally:
            self.longest_s = max(self.longest_s, time.monotonic() - now_s)

    def report(self, after_s: float = 0.0) -> VehicleReport:
        """Return the vehicle's report, after ``after_s`` in which no command is sent."""
        end_s = time.monotonic() + after_s
        while time.monotonic() < end_s:
            self.call("feedback")
            time.sleep(self.pause_s)
        self.last = report = self.call("feedback")
        numbers = (*report.action.values(), report.speed_mps)
        has_all = report.action.keys() == self.go.keys() and type(report.faults) is list
        self.well_formed &= has_all and all(map(math.isfinite, numbers))
        return report

    def until(self, moves: bool, limit_s: float = PATIENCE_S, commands: bool = False) -> bool:
        """Return whether the vehicle begins to move, or to stand; ``commands``: drive each T."""
        end_s, next_s = time.monotonic() + limit_s, -math.inf
        while True:
            now_s = time.monotonic()
            if commands and now_s >= next_s:
                self.call("command", self.go)
                next_s = now_s + self.period_s
            speed_mps = abs(self.report().speed_mps)
            if speed_mps > MOVES_MPS if moves else speed_mps <= STANDS_MPS:
                return True
            if now_s >= end_s:
                return False
            time.sleep(self.pause_s)

    def goes(self, limit_s: float = PATIENCE_S) -> bool:
        return self.until(moves=True, limit_s=limit_s, commands=True)

    def starts(self) -> bool:
        """Enable the vehicle; return whether commands move it from a stand."""
        self.call("enable")
        return self.until(moves=False) and self.goes()

    def waits(self) -> bool:
        self.call("enable")
        return not self.until(moves=True, limit_s=0.5)

    def brakes_alone(self, periods: float) -> bool:
        """Return whether it reports self-braking so many T after a last command."""
        self.call("command", self.go)
        return bool(self.report(periods * self.period_s).self_braking)

    def brakes(self) -> bool:
        self.call("brake")
        # Commands go on: without them it would brake by itself.
        if self.until(moves=False, limit_s=2 * self.period_s + LATE_S, commands=True):
            return True
        before_mps, after_mps = (abs(self.report(LATE_S).speed_mps) for _ in range(2))
        return after_mps < before_mps and self.until(moves=False)

    def stands_for_now(self) -> bool:
        self.call("brake", latch=False)
        return self.until(moves=False)

    def refuses(self, *actions: dict[str, float]) -> bool:
        for action in actions:
            with contextlib.suppress(ValueError):
                self.call("command", action)
                return False
        return True

    def stays_within(self) -> bool:
        for _ in range(10):
            self.call("command", {name: 10.0 * value for name, value in self.go.items()})
            action = self.report(self.period_s / 2).action
            for name, limit in self.vehicle.limits.items():
                if not limit.low - ROUNDING <= action[name] <= limit.high + ROUNDING:
                    return False
        return True

    def closes(self) -> bool:
        self.stands_for_now()
        self.call("close")
        self.call("close")
        with contextlib.suppress(Exception):  # a closed driver may raise
            return not self.goes(limit_s=1.0)
        return True


# In this order, because each rule begins in the state that the one before leaves.
RULES: dict[str, Callable[[Bench], bool]] = {
    "each action has a range": lambda it: (
        bool(it.go) and all(limit.low < limit.high for limit in it.vehicle.limits.values())
    ),
    "no command moves it before `enable`": lambda it: not it.goes(5 * it.period_s),
    "enabled, it stands until the first command": Bench.waits,
    "commands move it, and it tells of no fault": lambda it: it.goes() and not it.report().faults,
    "a command holds for 1.5 T": lambda it: it.goes() and not it.brakes_alone(1.5),
    "it brakes by itself after 2 T without a command": lambda it: (
        it.starts() and it.brakes_alone(2.2 + LATE_S / it.period_s) and it.until(moves=False)
    ),
    "it brakes within 2 T of a stop": lambda it: it.starts() and it.brakes(),
    "a stop is latched: no command moves it": lambda it: not it.goes(10 * it.period_s),
    "`enable` after a stop: it stands, then commands move it": lambda it: it.waits() and it.goes(),
    "a stop without a latch ends with the next command": lambda it: (
        it.stands_for_now() and it.goes()
    ),
    "NaN and infinity are a ValueError": lambda it: it.refuses(
        *({**it.go, name: float(text)} for name in it.go for text in ("nan", "inf", "-inf"))
    ),
    "a command that lacks its actions is a ValueError": lambda it: it.refuses({}, {"": 0.5}),
    "far beyond its limits it stays within them": Bench.stays_within,
    "each report has its actions, finite numbers, a list of faults": lambda it: it.well_formed,
    f"no call takes longer than {CALL_S * 1e3:.0f} ms": lambda it: it.longest_s <= CALL_S,
    "it closes twice, and nothing moves it then": Bench.closes,
}
