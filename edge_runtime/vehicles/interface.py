"""What a vehicle driver must do. A driver lives in one file beside this one.

Time is passed in as monotonic seconds. A driver is called by one thread at a time (runner.py).
"""

from __future__ import annotations

import abc
from typing import ClassVar, Dict, List, NamedTuple


class ActionLimit(NamedTuple):
    """A vehicle's row for one action: its range, and the fastest change per second."""

    low: float
    high: float
    slew_per_s: float


class VehicleReport(NamedTuple):
    """What the vehicle does. `action` is what its actuators have reached, in -1 to 1."""

    action: Dict[str, float]
    speed_mps: float
    self_braking: bool
    faults: List[str]


class Vehicle(abc.ABC):
    """A vehicle under command. `limits` is keyed by the action names of the manifest."""

    name: ClassVar[str]
    limits: ClassVar[Dict[str, ActionLimit]]

    @abc.abstractmethod
    def enable(self, now_s: float) -> None:
        """Take control. Until the first command the vehicle holds its brake."""

    @abc.abstractmethod
    def command(self, action: Dict[str, float], now_s: float) -> None:
        """Ask for an action; it holds for 2 T, after which the vehicle brakes by itself."""

    @abc.abstractmethod
    def brake(self, now_s: float) -> None:
        """Full brake at once, steering held."""

    @abc.abstractmethod
    def feedback(self, now_s: float) -> VehicleReport:
        """What the vehicle does now."""

    @abc.abstractmethod
    def close(self) -> None:
        """Brake, give control back and free what the driver holds. Safe to call twice."""
