"""What a vehicle driver must do. A driver lives in a folder of its own beside this file.

Time is passed in as monotonic seconds. A driver is called by one thread at a time (runner.py).
"""

from __future__ import annotations

import abc
from typing import ClassVar, Dict, List, NamedTuple, Optional, Sequence


class ActionLimit(NamedTuple):
    """A vehicle's row for one action: its range, and the fastest change per second (inf: any)."""

    low: float
    high: float
    slew_per_s: float


class VehicleReport(NamedTuple):
    """What the vehicle does. `action` is what its actuators have reached, in -1 to 1.

    `faults` says in words why it does not drive, until it is enabled again; `standing` are those
    whose cause is there now, so that enabling would be in vain. A vehicle that takes a speed
    instead of a pedal says which one it is asked for (m/s of its own), and what its own speed is
    in the scenario; its pedal is then worked out from its speed.
    """

    action: Dict[str, float]
    speed_mps: float
    self_braking: bool
    faults: List[str]
    standing: Sequence[str] = ()
    scenario_speed_mps: Optional[float] = None
    commanded_speed_mps: Optional[float] = None
    battery_v: Optional[float] = None


class Vehicle(abc.ABC):
    """A vehicle under command. `limits` is keyed by the action names of the manifest."""

    name: ClassVar[str]
    limits: Dict[str, ActionLimit]

    @abc.abstractmethod
    def enable(self, now_s: float) -> None:
        """Take control, at the start and again at each re-arm: what stopped it is forgotten.

        Does not wait: until the vehicle confirms, it stands, and `feedback` says how it goes. It
        stands as well until the first command.
        """

    @abc.abstractmethod
    def command(
        self, action: Dict[str, float], now_s: float, scenario_speed_mps: Optional[float] = None
    ) -> None:
        """Ask for an action; it holds for 2 T, after which the vehicle brakes by itself.

        Raises ValueError for one that lacks what the vehicle needs: it never guesses.

        `scenario_speed_mps` is the speed of the scenario's car: what a policy without a pedal
        has in place of one. Moves nothing while the vehicle is stopped (`brake`, or a fault).
        """

    @abc.abstractmethod
    def brake(self, now_s: float, latch: bool = True) -> None:
        """Full brake at once, steering held; it needs no repetition.

        It moves again only after `enable`; with `latch` False (the end of an episode) already
        with the next command.
        """

    @abc.abstractmethod
    def feedback(self, now_s: float) -> VehicleReport:
        """What the vehicle does now."""

    @abc.abstractmethod
    def close(self) -> None:
        """Brake, give control back and free what the driver holds. Safe to call twice."""
