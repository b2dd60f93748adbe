"""The battery: a voltage that falls with the charge, and sags under current. Pure."""

from __future__ import annotations

from hil_tests.mock_hunter.parameters import Parameters

_NEARLY_EMPTY = 0.05


class Battery:
    """Its charge as a fraction of full."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._fraction = 1.0
        self._current_a = parameters.idle_a
        self._before_empty: float | None = None

    @property
    def volts(self) -> float:
        """At its terminals, now."""
        p = self._parameters
        open_v = p.empty_v + (p.full_v - p.empty_v) * self._fraction
        return open_v - p.resistance_ohm * self._current_a

    @property
    def amperes(self) -> float:
        """Drawn from it now."""
        return self._current_a

    @property
    def too_low(self) -> bool:
        """Whether the chassis calls it undervoltage."""
        return self.volts < self._parameters.undervoltage_v

    def advance(self, speed_mps: float, acceleration_mps2: float, step_s: float) -> None:
        """Draw what this motion takes; braking gives nothing back."""
        p = self._parameters
        drive_a = p.drive_a_per_mps * abs(speed_mps)
        self._current_a = p.idle_a + drive_a + p.drive_a_per_mps2 * max(0.0, acceleration_mps2)
        used = self._current_a * step_s / p.capacity_as
        self._fraction = max(0.0, self._fraction - used)

    def empty(self, on: bool) -> None:
        """Be nearly empty, or as full as before."""
        if on and self._before_empty is None:
            self._before_empty, self._fraction = self._fraction, _NEARLY_EMPTY
        elif not on and self._before_empty is not None:
            self._fraction, self._before_empty = self._before_empty, None
