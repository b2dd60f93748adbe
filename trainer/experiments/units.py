"""A unit: one training run of the experiments, and the id under which its result is found again."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from edge_runtime.errors import UserError
from edge_runtime.files import read_bytes
from trainer.conditions import COMMAND_NOISE
from trainer.drivers import EXPERTS, TRIGGERS, make_environment
from trainer.experiments.plan import HUMAN_MODEL, SETTINGS, Plan
from trainer.human.guide import HumanGuide
from trainer.human.model import MODEL_FILE
from trainer.learner.algorithms import ALGORITHMS
from trainer.learner.config import LearnerConfig
from trainer.scenarios import SCENARIOS, idm
from trainer.scenarios.ego import EgoVehicle, PathTracker
from trainer.scenarios.traffic import TrafficVehicle
from trainer.training.config import RunConfig

ID_LENGTH = 12
NOT_DECIDING = ("device", "threads", "checkpoint_every")
"""Fields of a run that change where and how fast it is computed. A unit always learns on one
thread; a GPU sums in another order, as another processor does, and is written beside the result."""
CODE = 1
"""Raise it with a change that no number below shows and that makes another result of a unit."""
MOTION = (EgoVehicle, PathTracker, TrafficVehicle, idm)
"""How cars move, beside the numbers of a scenario's config."""
NEUTRAL: dict[str, Any] = {
    "poor_guidance_share": 0.0,
    "latency": "none",
    "printed_reward": False,
    "left_turn_tests": "b1b2df6847a6",
    "congestion_tests": "082f423f4a49",
    "left_turn_dense": "8a0bc00c4c0a",
    "congestion_dense": "e2980480c2ca",
    "motion": "d975daa0e3e2",
    "code": 1,
}
"""Fields that came after the first results, with the value that means what was before them: left
out of the id while they hold it, so that no result is lost. Add a row with each new field."""


@dataclass(frozen=True)
class Unit:
    """One training run; `human_model` in the algorithm's place: a test of the human model alone."""

    scenario: str
    algorithm: str
    setting: str
    seed: int

    def __str__(self) -> str:
        return f"{self.scenario} {self.algorithm} {self.setting} seed {self.seed}"

    @property
    def trained(self) -> bool:
        """Whether anything is trained for it."""
        return self.algorithm != HUMAN_MODEL

    @property
    def needs_human(self) -> bool:
        """Whether a human model decides its result."""
        return not self.trained or ALGORITHMS[self.algorithm].guided


def obstacle(unit: Unit, humans: Path) -> str | None:
    """Why this version cannot compute a unit, in a few words; None where it can."""
    if unit.scenario not in SCENARIOS:
        return f"there is no scenario {unit.scenario}"
    if unit.trained and unit.algorithm not in ALGORITHMS:
        return f"there is no algorithm {unit.algorithm} in trainer/learner/algorithms.py"
    if unit.setting not in SETTINGS:
        return f"there is no setting {unit.setting}"
    if unit.needs_human and not human_file(unit.scenario, humans).is_file():
        directory = humans / unit.scenario
        return (
            f"there is no human model in {directory}; make it with "
            f"`python -m trainer human --scenario {unit.scenario} --out {directory}`"
        )
    return None


def run_config(unit: Unit, plan: Plan, humans: Path, device: str = "cpu") -> RunConfig:
    """The settings of a unit's training run.

    Raises:
        UserError: nothing is trained for this unit, or it cannot be computed.
    """
    reason = obstacle(unit, humans)
    if reason or not unit.trained:
        raise UserError(f"{unit}: {reason or 'nothing is trained for it'}")
    setting = SETTINGS[unit.setting]
    learner = replace(LearnerConfig(), **{**plan.learner, **setting.learner})
    return RunConfig(
        scenario=unit.scenario,
        algorithm=unit.algorithm,
        seed=unit.seed,
        episodes=plan.episodes[unit.scenario],
        human=str(humans / unit.scenario) if unit.needs_human else "expert",
        evaluate_every_steps=plan.evaluate_every_steps,
        evaluation_runs=plan.evaluation_runs,
        checkpoint_every=plan.checkpoint_every,
        device=device,
        threads=1,
        learner=learner,
        **setting.run,
    )


def deciding(unit: Unit, plan: Plan, humans: Path) -> dict[str, Any]:
    """What decides a unit's result, as plain values: what its id is made from.

    The human model counts by the contents of its file, when it takes over by the numbers of guide,
    trigger and the expert behind it, and neither where no human guides; the scenario by every
    number of its config, how cars move and the tests by theirs, and the code by ``CODE`` alone.
    """
    human = _fingerprint(human_file(unit.scenario, humans)) if unit.needs_human else "nobody"
    values: dict[str, Any] = {
        "unit": asdict(unit),
        "human": human,
        "test_runs": plan.test_runs,
        "scenario": _numbers_of(unit.scenario),
        f"{unit.scenario}_tests": _tests_of(unit.scenario),
        f"{unit.scenario}_dense": digest(_numbers_of(unit.scenario, "dense")),
        "motion": digest({kind.__name__: _constants_of(kind) for kind in MOTION}),
        "code": CODE,
    }
    if unit.trained:
        run = run_config(unit, plan, humans).as_dict()
        values["run"] = {name: run[name] for name in run if name not in (*NOT_DECIDING, "human")}
        values["switches"] = asdict(ALGORITHMS[unit.algorithm])
        if unit.needs_human:
            kinds = (HumanGuide, TRIGGERS[unit.scenario], EXPERTS[unit.scenario])
            values["taking_over"] = [_constants_of(kind) for kind in kinds]
    plain: dict[str, Any] = json.loads(json.dumps(without_neutral(values)))
    return plain


def unit_id(unit: Unit, plan: Plan, humans: Path) -> str:
    """A short SHA-256 of what decides the unit's result, in canonical JSON."""
    return digest(deciding(unit, plan, humans))


def digest(values: dict[str, Any]) -> str:
    """Hash of the values, whatever the order in which they stand."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:ID_LENGTH]


def without_neutral(values: dict[str, Any]) -> dict[str, Any]:
    """The values without the fields that hold what ``NEUTRAL`` says, at any depth."""
    return {
        name: without_neutral(value) if isinstance(value, dict) else value
        for name, value in values.items()
        if not (name in NEUTRAL and NEUTRAL[name] == value)
    }


def human_file(scenario: str, humans: Path) -> Path:
    """Where a scenario's human model is."""
    return humans / scenario / MODEL_FILE


@cache
def _numbers_of(scenario: str, condition: str = "nominal") -> dict[str, Any]:
    return asdict(make_environment(scenario, condition).config)


def _tests_of(scenario: str) -> str:
    """What decides the paper's tests beside the nominal scene."""
    return digest({"noise": COMMAND_NOISE, "variant": _numbers_of(scenario, "variant")})


def _constants_of(kind: Any) -> dict[str, Any]:
    """What a class or module gives names in capitals: numbers, and plans of them."""
    named = {name: value for name, value in vars(kind).items() if name.isupper()}
    return {name: vars(v) if is_dataclass(v) else v for name, v in named.items()}


def _fingerprint(path: Path) -> str:
    """Hash of a file; read again only when it has changed."""
    stat = path.stat()
    return _hash_file(path, stat.st_mtime_ns, stat.st_size)


@cache
def _hash_file(path: Path, changed_ns: int, size: int) -> str:
    return hashlib.sha256(read_bytes(path, "human model")).hexdigest()[:ID_LENGTH]
