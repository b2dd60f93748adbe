import math
from types import SimpleNamespace

import pytest

from edge_runtime.controller import ActionLimit
from edge_runtime.vehicles.mock import MockVehicle
from hil_tests.__main__ import main
from hil_tests.conformance import RULES
from hil_tests.faults.rig import Chassis, free_bus
from hil_tests.tests.shared.commands import exit_status

LIMITS = {
    "frozen": {**MockVehicle.limits, "steering": ActionLimit(0.5, 0.5)},
    "dead": {**MockVehicle.limits, "pedal": ActionLimit(-1.0, 0.0, math.inf)},
}


def flawed(flaw, clock):
    """The mock, wrong in one way."""

    class Flawed(MockVehicle):
        name = "flawed"
        limits = LIMITS.get(flaw, MockVehicle.limits)
        braked = False

        def enable(self, now_s):
            super().enable(now_s)
            if flaw == "slow":
                clock.sleep(0.051)
            if flaw == "never again" and self.braked:
                super().brake(now_s)
            if flaw == "moves at once":
                super().command({"pedal": 1.0}, now_s)

        def command(self, action, now_s, *speed_mps):
            if flaw == "exits":
                raise SystemExit
            if flaw == "takes nan":
                action = {name: 0.0 if value != value else value for name, value in action.items()}
            if flaw == "takes anything":
                action = {"pedal": 0.0, **action}
            if flaw in ("moves disabled", "never latches"):
                self._latched = False
            super().command(action, now_s, *speed_mps)

        def brake(self, now_s, latch=True):
            self.braked = True
            if flaw != "no brake":
                super().brake(now_s, latch or flaw == "latches always")

        def feedback(self, now_s):
            report = super().feedback(now_s)
            if flaw == "silent brake":
                report = report._replace(self_braking=False)
            if flaw == "impatient":
                report = report._replace(self_braking=now_s - self._commanded_s > 0.1)
            if flaw == "complains":
                report = report._replace(faults=["battery low"])
            if flaw == "leaves its limits":
                return report._replace(action=dict.fromkeys(report.action, 2.0))
            return report._replace(action={}) if flaw == "no actions" else report

        def close(self):
            if flaw != "moves closed":
                super().close()

    return Flawed


@pytest.fixture
def clock(monkeypatch):
    """Made-up time: whoever sleeps sets it forward."""
    now_s = 100.0

    def sleep(seconds):
        nonlocal now_s
        now_s += seconds

    clock = SimpleNamespace(monotonic=lambda: now_s, sleep=sleep)
    monkeypatch.setattr("hil_tests.conformance.time", clock)
    return clock


@pytest.mark.parametrize(
    ("flaw", "rule"),
    [
        ("", ""),
        ("slow", "no call takes longer"),
        ("frozen", "each action has a range"),
        ("dead", "commands move it"),
        ("complains", "commands move it, and it tells of no fault"),
        ("exits", "commands move it"),
        ("never again", "`enable` after a stop"),
        ("moves disabled", "no command moves it before"),
        ("moves at once", "enabled, it stands until"),
        ("impatient", "holds for 1.5 T"),
        ("silent brake", "brakes by itself after 2 T"),
        ("no brake", "within 2 T of a stop"),
        ("never latches", "a stop is latched"),
        ("latches always", "ends with the next command"),
        ("takes nan", "NaN and infinity"),
        ("takes anything", "lacks its actions"),
        ("leaves its limits", "far beyond its limits"),
        ("no actions", "each report has its actions"),
        ("moves closed", "it closes twice"),
    ],
)
def test_a_driver_that_breaks_a_rule_is_told_so(flaw, rule, monkeypatch, capsys, clock):
    monkeypatch.setattr(f"{__name__}.Driver", flawed(flaw, clock), raising=False)
    status = exit_status(main, ["conformance", "--vehicle", f"{__name__}:Driver"])
    assert status == (1 if flaw else 0)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(RULES) + 1
    assert not any("VehicleReport" in line or "[" in line for line in lines)  # Words, no reprs
    broken = [line for line in lines if line.startswith("broken")]
    assert any(rule in line for line in broken) if flaw else not broken, lines


def test_the_hunter_keeps_every_rule_over_the_mock_chassis(tmp_path, capsys):
    bus, config = free_bus(), tmp_path / "edge.toml"
    link = "connect = 'tls/10.0.0.1:7447'"  # It opens none, and has no --tls.
    config.write_text(f"{link}\nvehicle.driver = 'hunter'\nvehicle.hunter.bus = '{bus}'\n")
    with Chassis(bus):
        status = exit_status(main, ["conformance", "--config", str(config)])
    assert status == 0, capsys.readouterr().out
