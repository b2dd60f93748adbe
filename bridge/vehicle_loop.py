"""What ``--loop vehicle`` adds to a drive: who must be there, what is applied, what is reported."""

from __future__ import annotations

from collections import Counter
from typing import Any

from bridge.actions import Apply, vehicle_action
from bridge.port import SimulatorPort
from bridge.report import quantiles
from bridge.vehicle_clock import VehicleClock


class VehicleInLoop:
    """A vehicle that reports through ``port``; UserError if none does within ``wait_s``."""

    def __init__(self, clock: VehicleClock, port: SimulatorPort, wait_s: float) -> None:
        self.clock = clock
        manifest = port.edge_manifest()
        self._action_names = [action.name for action in manifest.action] if manifest else []
        self.apply: Apply = vehicle_action(self._action_names)
        port.on_feedback(clock.receive_feedback)
        clock.wait_for_vehicle(wait_s, port.vehicle_id)

    def rejected(self) -> Counter[str]:
        """Return the feedback that was not believed, as ``feedback_REASON``."""
        counts = dict(self.clock.feedback_check.rejected)  # Its own thread goes on counting.
        return Counter({f"feedback_{name}": n for name, n in counts.items()})

    def report(self) -> dict[str, Any]:
        """Return the report's part ``vehicle``."""
        return {
            **self.clock.tracking.report(self._action_names),
            "feedback_age_ms": quantiles(self.clock.feedback_ages_ms),
            "moving_starts": self.clock.moving_starts,
        }
