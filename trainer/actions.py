"""The one action of each scenario, as a policy file describes it (contract section 4)."""

from __future__ import annotations

from edge_runtime.policy_file import Action
from trainer.scenarios.congestion import CongestionConfig

ACTIONS = {
    "left_turn": Action(
        name="pedal",
        meaning="positive opens the throttle, negative brakes",
        unit="aperture",
        low=-1.0,
        high=1.0,
    ),
    "congestion": Action(
        name="steering",
        meaning="positive turns right, negative left (eq. 29)",
        unit=f"share of the front wheels' {CongestionConfig().lambda_rad:g} rad",
        low=-1.0,
        high=1.0,
    ),
}
"""Scenario -> what its action means to a vehicle."""
