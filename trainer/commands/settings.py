"""``--set NAME=VALUE``: the settings of a training that have no option of their own."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from edge_runtime.util import UserError
from trainer.learner.config import LearnerConfig
from trainer.training.config import RunConfig

DEFAULTS = RunConfig()
LEARNERS = tuple(field.name for field in fields(LearnerConfig))
OWN = (
    "averaged_actor",
    "guided_share",
    "guided_until_step",
    "penalise_stuck",
    "printed_reward",
    "poor_guidance_share",
    "poor_guidance",
    "evaluate_every_steps",
    "evaluation_runs",
    "checkpoint_every",
)
"""The run's own that may be set; those of the learner may all be."""

EXPECTED = {bool: "true or false", int: "a whole number", float: "a number"}


def settings() -> dict[str, Any]:
    """Every setting that ``--set`` may change, with its default."""
    own = {name: getattr(DEFAULTS, name) for name in OWN}
    return own | {name: getattr(DEFAULTS.learner, name) for name in LEARNERS}


def with_setting(config: RunConfig, assignment: str) -> RunConfig:
    """The config with one NAME=VALUE.

    Raises:
        UserError: no such setting, or no such value of it.
    """
    name, given, text = assignment.partition("=")
    if not given:
        raise UserError(f"--set {assignment}: expected NAME=VALUE")
    known = settings()
    if name not in known:
        raise UserError(f"--set {assignment}: no setting {name!r}; there is {', '.join(known)}")
    kind = type(known[name])
    try:
        value: Any = {"true": True, "false": False}[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        raise UserError(f"--set {assignment}: expected {EXPECTED[kind]}, got {text!r}") from None
    if name in LEARNERS:
        return replace(config, learner=replace(config.learner, **{name: value}))
    return replace(config, **{name: value})
