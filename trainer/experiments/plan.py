"""How much is trained and tested for the paper's experiments: one table of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

HUMAN_MODEL = "human_model"
"""Stands in an algorithm's place where the human model itself is tested: nothing is trained."""


@dataclass(frozen=True)
class Setting:
    """How the runs of a setting differ from the normal ones."""

    meaning: str
    run: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the run's config that it changes."""
    learner: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters that it changes."""


NORMAL, TOUGH, POOR, REMEDY = "normal", "tough", "poor", "remedy"
EXACT_LOSSES, IMPORTANCE, WEAK_CLONING = "exact_losses", "importance", "weak_cloning"
PRINTED_RATES, PRINTED_REWARD, LAST_ACTOR = "printed_rates", "printed_reward", "last_actor"
NETWORK = "network"
SETTINGS: Mapping[str, Setting] = {
    NORMAL: Setting("section VI's definition"),
    TOUGH: Setting("one frame instead of two", learner={"frames": 1}),
    POOR: Setting(
        "one third of the demonstrations replaced by random actions (section VII-E)",
        run={"poor_guidance_share": 1.0 / 3.0},
    ),
    # Not in the paper; the weight was measured on one run of a prototype.
    REMEDY: Setting(
        "a price on the action before tanh, for algorithms whose policy saturates",
        learner={"saturation_weight": 0.1},
    ),
    EXACT_LOSSES: Setting("losses as eq. 22 and 23 are printed", learner={"split_loss": True}),
    IMPORTANCE: Setting(
        "the importance weights that the paper calls optional",
        learner={"importance_sampling": True},
    ),
    WEAK_CLONING: Setting(
        "a tenth of the weight on behaviour cloning, for which the paper gives no value",
        learner={"cloning_weight": 1.0},
    ),
    PRINTED_RATES: Setting(
        "table A5's learning rates, which the authors' code has the other way round",
        learner={"actor_learning_rate": 5e-4, "critic_learning_rate": 2e-4},
    ),
    PRINTED_REWARD: Setting(
        "weight 1 on the reward's term of speed or steering", run={"printed_reward": True}
    ),
    LAST_ACTOR: Setting(
        "the actor as it stands judged, not its average", run={"averaged_actor": False}
    ),
    NETWORK: Setting(
        "training behind a network, as with `trainer train --latency`",
        run={"latency": "delay=100ms,jitter=20ms,loss=2%"},
    ),
}


class Scene(NamedTuple):
    """A test scene."""

    scenario: str
    condition: str
    label: str
    """As in the paper's fig. 9."""
    title: str


SCENES = (
    Scene("left_turn", "nominal", "L", "left turn"),
    Scene("left_turn", "noise", "L-N", "left turn, noise"),
    Scene("left_turn", "variant", "L-V", "left turn, variant"),
    Scene("congestion", "nominal", "C", "congestion"),
    Scene("congestion", "noise", "C-N", "congestion, noise"),
    Scene("congestion", "variant", "C-V", "congestion, variant"),
)
"""The six of section VII-D, which the paper's figures and claims are about."""
DENSE_SCENES = (
    Scene("left_turn", "dense", "L-D", "left turn, dense"),
    Scene("congestion", "dense", "C-D", "congestion, dense"),
)
"""Beside the paper's six: scenes that leave room above a good policy."""
SCENARIO_TITLES = {"left_turn": "left turn", "congestion": "congestion"}
FULL_PATH_M = {"left_turn": 21.0, "congestion": 80.0}
"""Distance from start to goal."""


@dataclass(frozen=True)
class Plan:
    """What every training run of the experiments has in common."""

    episodes: Mapping[str, int]
    """Scenario -> episodes of a run."""
    evaluate_every_steps: int = 10
    """Episodes between two validations; the best validated actor is the one that is tested."""
    evaluation_runs: int = 100
    """Episodes of a validation."""
    test_runs: int = 50
    """Test episodes in each scene, with the seeds 0, 1, ... for every policy (section VII-D)."""
    checkpoint_every: int = 5
    """Episodes between two checkpoints; it decides what a kill costs, not what a run gives."""
    learner: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters that differ from the defaults, for every algorithm alike."""
    timed_steps: int = 10_000
    """Training steps of each algorithm that are timed (the paper's table of time efficiency)."""
    turn_steps: int = 100
    """Least steps of an algorithm before the next one has its turn."""


PLAN = Plan(episodes={"left_turn": 200, "congestion": 100})
QUICK = Plan(
    episodes={"left_turn": 3, "congestion": 3},
    evaluate_every_steps=2,
    evaluation_runs=1,
    test_runs=3,
    checkpoint_every=1,
    learner={"batch_size": 4, "warmup_steps": 16},
    timed_steps=40,
    turn_steps=10,
)
"""A look at the whole way in a minute or two; its figures mean nothing."""
