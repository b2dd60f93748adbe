"""The manifest inside a policy file: what the policy sees, does, and where it comes from.

Contract, section 4. It is JSON in the ONNX metadata under MANIFEST_KEY.
"""

from __future__ import annotations

import math
from typing import Any, Dict, List, Sequence, Tuple

import msgspec

from edge_runtime import wire
from edge_runtime.errors import UserError

MANIFEST_KEY = "phil.manifest"
MANIFEST_SCHEMA = 1

# The runtime must know how to stop each action safely (limiter.py), so it takes only these.
ACTION_NAMES = ("pedal", "steering")
FULL_BRAKE = -1.0


class Observation(msgspec.Struct, frozen=True, kw_only=True):
    """The network's input. `order` says which frame is the newer one."""

    name: str = "frames"
    shape: List[int] = msgspec.field(default_factory=lambda: list(wire.FRAMES_SHAPE))
    dtype: str = "uint8"
    order: str = "[t-1, t]"


class Action(msgspec.Struct, frozen=True, kw_only=True):
    """One number of the network's output, its physical meaning, unit and range."""

    name: str
    meaning: str
    unit: str
    low: float
    high: float


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """All of it. `training` holds at least seed, episodes, config and source revision.

    `created` is ISO 8601 in UTC. A field that is not listed, like an earlier version's `policy_id`,
    is not looked at.
    """

    scenario: str
    algorithm: str
    observation: Observation
    action: List[Action]
    training: Dict[str, Any]
    created: str
    control_period_s: float = wire.CONTROL_PERIOD_S
    schema: int = MANIFEST_SCHEMA

    @property
    def task(self) -> str:
        """What the policy is for: what it is compared by when it meets a simulator."""
        return task_text(self.scenario, [(row.name, row.low, row.high) for row in self.action])


def task_text(scenario: str, actions: Sequence[Tuple[str, float, float]]) -> str:
    """Scenario, and each action's name, low and high: `left_turn, pedal -1 to 1`."""
    rows = (f"{name} {low:g} to {high:g}" for name, low, high in actions)
    return ", ".join((scenario, *rows))[: wire.MAX_TEXT_CHARS]


def encode_manifest(manifest: Manifest) -> str:
    """The JSON text that goes into the file."""
    return msgspec.json.encode(manifest).decode()


def decode_manifest(text: str) -> Manifest:
    """The manifest of a policy file. Raises UserError where it is none, or none we can drive."""
    try:
        manifest = msgspec.json.decode(text.encode(), type=Manifest)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"the manifest in the policy file is not valid: {error}") from None
    _check(manifest)
    return manifest


def _check(manifest: Manifest) -> None:
    if manifest.schema != MANIFEST_SCHEMA:
        raise UserError(
            f"the manifest has schema {manifest.schema}, this runtime reads {MANIFEST_SCHEMA}"
        )
    if manifest.control_period_s != wire.CONTROL_PERIOD_S:
        raise UserError(
            f"the policy was made for a control period of {manifest.control_period_s} s,"
            f" this runtime runs at {wire.CONTROL_PERIOD_S} s"
        )
    if manifest.observation != Observation():
        raise UserError(
            "the manifest's observation is not the wire's:"
            f" {Observation()} is needed, {manifest.observation} was found"
        )
    if not manifest.action:
        raise UserError("the manifest names no action")
    for action in manifest.action:
        _check_action(action)
    names = [action.name for action in manifest.action]
    if len(set(names)) != len(names):
        raise UserError(f"the manifest names an action twice: {', '.join(names)}")


def _check_action(action: Action) -> None:
    if action.name not in ACTION_NAMES:
        raise UserError(
            f"the runtime does not know how to stop the action {action.name!r} safely;"
            f" it knows {', '.join(ACTION_NAMES)}"
        )
    finite = math.isfinite(action.low) and math.isfinite(action.high)
    if not (finite and -1.0 <= action.low < action.high <= 1.0):
        raise UserError(
            f"the range of {action.name} is {action.low} to {action.high}; it must lie in -1 to 1"
        )
    if action.name == "pedal" and action.low != FULL_BRAKE:
        raise UserError(
            f"the range of pedal begins at {action.low}, not {FULL_BRAKE}: it could not brake"
            " fully in a safe stop"
        )
