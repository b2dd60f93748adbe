"""What a training run is: everything that decides its result."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from edge_runtime.util import UserError
from trainer.learner.config import PRINTED_LEARNER, LearnerConfig
from trainer.util import FROM_ONE, FROM_ZERO, SHARE, check_ranges

MOST_THREADS = 1024
"""More than a machine could use. Torch dies where the system has fewer than it asks for."""
RANGES = {
    "seed": (0, 2**63 - 1),
    "episodes": FROM_ONE,
    "steps": FROM_ZERO,
    "guided_share": SHARE,
    "guided_until_step": FROM_ZERO,
    "poor_guidance_share": SHARE,
    "evaluate_every_steps": FROM_ZERO,
    "evaluation_runs": FROM_ONE,
    "checkpoint_every": FROM_ONE,
    "threads": (0, MOST_THREADS),
}
"""What each number may be."""
RANDOM, BIASED = GUIDANCE = ("random", "biased")
"""How a human of poor guidance is wrong: each time another way, or always the same."""


@dataclass(frozen=True)
class RunConfig:
    """A run's settings; the same settings on the same machine give the same
    weights (with the compiled kernel or without it, not across the two).
    """

    scenario: str = "left_turn"
    algorithm: str = "phil_td3"
    seed: int = 0
    episodes: int = 400
    """Episodes to train, at most (table A5: 400)."""
    steps: int = 0
    """Environment steps after which the episode under way is the last; 0: episodes decide."""
    human: str = "expert"
    """Who guides: the word expert, or a human model's directory."""
    guided_share: float = 1.0
    """Share of the episodes that the human watches. (The authors' code: a third in the left
    turn.)"""
    guided_until_step: int = 0
    """Environment steps after which the human leaves for good; 0: never."""
    penalise_stuck: bool = False
    """Whether taking over from a car that only waits too long is penalised, too. A stuck car
    looks like one that rightly waits, so the penalty teaches to fear waiting."""
    averaged_actor: bool = True
    """Whether the target actor is what is validated, kept and exported. It is a running average
    (Polyak and Juditsky, 1992) of the actor that learns, which swings from episode to episode."""
    poor_guidance_share: float = 0.0
    """Share of the human's actions that are replaced by wrong ones (section VII-E: one third)."""
    poor_guidance: str = RANDOM
    """How they are wrong: ``random`` (the paper's), or ``biased``, always the same."""
    printed_reward: bool = False
    """Weight 1 on the term of eq. 31 or 32, as the equations are printed, instead of the scenario's
    own (``LeftTurnConfig.speed_weight``, ``CongestionConfig.steer_weight``)."""
    evaluate_every_steps: int = 500
    """Environment steps between two evaluations on the validation seeds; 0: never."""
    evaluation_runs: int = 30
    """Episodes of such an evaluation."""
    checkpoint_every: int = 10
    """Episodes between two checkpoints."""
    latency: str = "none"
    """The network between policy and vehicle, in training and validation alike, in the words of
    ``bridge simulate --latency``."""
    device: str = "cpu"
    threads: int = 0
    """Processor threads of the learner, set by whoever starts the run; 0: as many as torch takes.
    Another number sums in another order, and gives other weights."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)
        if self.poor_guidance not in GUIDANCE:
            raise UserError(
                f"poor_guidance must be one of {', '.join(GUIDANCE)}: {self.poor_guidance}"
            )

    def guided(self, episode: int, steps: int) -> bool:
        """Whether the human watches an episode that begins after so many environment steps."""
        if self.guided_until_step and steps >= self.guided_until_step:
            return False
        return math.ceil((episode + 1) * self.guided_share) > math.ceil(episode * self.guided_share)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)

    @property
    def kept_actor(self) -> str:
        """The learner's network that is validated and kept."""
        return "target_actor" if self.averaged_actor else "actor"

    def label(self, episode: int) -> dict[str, Any]:
        """What a file of the run says of whose it is, and of when."""
        return {
            "scenario": self.scenario,
            "algorithm": self.algorithm,
            "seed": self.seed,
            "episode": episode,
        }


PRINTED = RunConfig(averaged_actor=False, printed_reward=True, learner=PRINTED_LEARNER)
"""What the paper prints, to the letter, and its least where it leaves a thing open."""
PRESETS = {"ours": RunConfig(), "printed": PRINTED}
"""Where the settings of a training start from, by the word behind ``--preset``."""
