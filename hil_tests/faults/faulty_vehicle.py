"""The mock vehicle with a switch: a file that holds ``silent``, ``stuck``, ``lying`` or nothing."""

from __future__ import annotations

from pathlib import Path

from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.mock import MockVehicle

_STUCK_AT = -1.0
_LEAP_MPS = 8.0


class FaultyMockVehicle(MockVehicle):
    """Works as the mock does until the switch says otherwise."""

    def __init__(self, switch: Path) -> None:
        super().__init__()
        self._switch = switch
        self._last: VehicleReport | None = None

    def feedback(self, now_s: float) -> VehicleReport:
        """The mock's report; an old one, one of stuck actuators, or an impossible one."""
        word = self._switch.read_text().strip() if self._switch.exists() else ""
        report = super().feedback(now_s)
        if word == "silent":
            raise TimeoutError("the vehicle says nothing")
        if word == "stuck":
            action = dict.fromkeys(report.action, _STUCK_AT)
            report = report._replace(action=action)
        if word == "lying":
            report = report._replace(speed_mps=report.speed_mps + _LEAP_MPS)
        return report
