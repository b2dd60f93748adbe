"""What bridge and trainer show in rerun alike, and the colours of every view."""

from __future__ import annotations

import os
from types import MappingProxyType

# Read when rerun is imported. It has several lines for a viewer that is gone; ours says it all.
os.environ.setdefault("RUST_LOG", "warn,re_grpc_client=off,re_sdk=off")

# Who decides what the car is told: one colour each, on light and on dark ground.
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
