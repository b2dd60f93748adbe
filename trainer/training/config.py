"""What a training run is: everything that decides its result."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from trainer.learner.config import LearnerConfig
from trainer.ranges import FROM_ONE, FROM_ZERO, SHARE, check_ranges

MOST_THREADS = 1024
"""More than a machine could use. Torch dies where the system has fewer than it asks for."""
RANGES = {
    "seed": (0, 2**63 - 1),
    "episodes": FROM_ONE,
    "guided_share": FROM_ONE,
    "poor_guidance_share": SHARE,
    "evaluate_every": FROM_ZERO,
    "evaluation_runs": FROM_ONE,
    "checkpoint_every": FROM_ONE,
    "threads": (0, MOST_THREADS),
}
"""What each number may be."""


@dataclass(frozen=True)
class RunConfig:
    """A run's settings; the same settings on the same machine give the same
    weights (with the compiled kernel or without it, not across the two).
    """

    scenario: str = "left_turn"
    algorithm: str = "phil_td3"
    seed: int = 0
    episodes: int = 400
    """Episodes to train (table A5: at most 400)."""
    human: str = "expert"
    """Who guides: the word expert, or a human model's directory."""
    guided_share: int = 1
    """The human watches one episode in this many. (The authors' code: 3 in the left turn.)"""
    penalise_stuck: bool = False
    """Whether taking over from a car that only waits too long is penalised, too. A stuck car
    looks like one that rightly waits, so the penalty teaches to fear waiting."""
    averaged_actor: bool = True
    """Whether the target actor is what is validated, kept and exported. It is a running average
    (Polyak and Juditsky, 1992) of the actor that learns, which swings from episode to episode."""
    poor_guidance_share: float = 0.0
    """Share of the human's actions that are replaced by random ones (section VII-E: one third)."""
    printed_reward: bool = False
    """Weight 1 on the term of eq. 31 or 32, as the equations are printed, instead of the scenario's
    own (``LeftTurnConfig.speed_weight``, ``CongestionConfig.steer_weight``)."""
    evaluate_every: int = 20
    """Episodes between two evaluations on the validation seeds; 0: never."""
    evaluation_runs: int = 20
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

    @staticmethod
    def completed(values: dict[str, Any]) -> dict[str, Any]:
        """A config of before the network, or before the switch of the reward, with their fields."""
        later = {"latency": RunConfig.latency, "printed_reward": RunConfig.printed_reward}
        return {**later, **values}
