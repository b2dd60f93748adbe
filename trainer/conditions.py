"""The test conditions: which scene is driven, and what disturbs the command."""

from __future__ import annotations

from typing import NamedTuple

from trainer.scenarios.environment import Scene

COMMAND_NOISE = 0.05 * 2.0
"""Standard deviation of the noise condition: 5 % of the whole control domain (section VII-D)."""


class Condition(NamedTuple):
    """How test episodes are driven."""

    scene: Scene
    noise_std: float
    """Of Gaussian noise on the command."""
    meaning: str


CONDITIONS = {
    "nominal": Condition("nominal", 0.0, "the scene that is trained in"),
    "noise": Condition(
        "nominal", COMMAND_NOISE, "Gaussian noise of 5 % of the control domain on the command"
    ),
    "variant": Condition("variant", 0.0, "more vehicles, and other types of them"),
    "dense": Condition("dense", 0.0, "closer and less even traffic"),
}
"""Only the first is trained and validated in."""
