"""Who decides what the car is told: one colour each, in every view, on light and on dark ground."""

from __future__ import annotations

from types import MappingProxyType

Colour = tuple[int, int, int]
POLICY: Colour = (40, 120, 230)
HUMAN: Colour = (60, 170, 90)
RETURNING: Colour = (185, 140, 255)
"""The person has let go, and the action is on its way back to the policy's."""
APPLIED: Colour = (235, 140, 40)
"""What the car was told, whoever decided it."""
BY_NAME = MappingProxyType(
    {"policy": POLICY, "human": HUMAN, "returning": RETURNING, "applied": APPLIED}
)
