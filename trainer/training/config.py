"""What a training run is: everything that decides its result."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from edge_runtime.manifest import MAX_PERIOD_S, MIN_PERIOD_S
from edge_runtime.util import UserError
from trainer.learner.config import PRINTED_LEARNER, LearnerConfig
from trainer.util import FROM_ONE, SHARE, check_ranges

MOST_THREADS = 1024
"""More than a machine could use. Torch dies where the system has fewer than it asks for."""
RANGES = {
    FROM_ONE: ("episodes", "evaluation_runs", "checkpoint_every"),
    SHARE: ("guided_share", "poor_guidance_share", "missed_share"),
    (0, 2**63 - 1): ("seed",),
    (0, MOST_THREADS): ("threads",),
    (MIN_PERIOD_S, MAX_PERIOD_S): ("period_s",),
}
"""What these numbers may be; all others are at least 0."""
LATER = (
    "guided_until_episode", "late_from_s", "late_to_s", "missed_share",
    "period_s",
    "q_term", "rewarded", "proxy_values", "human_share", "updates_per_step", "asks",
    "foresight", "preference_beta",
)  # fmt: skip
"""Fields of a run's config and of an algorithm's row that came after the first records. A run or a
record without one had its default."""
GONE = {"snapshots": (False, True), "delay_known": (False,)}
"""Former settings, and those of their values with which a run trained as it does today."""
CURVE_FILE = "learning_curve.png"
EXTENT = ("episodes", "steps")  # How long a run is: it may go on for longer
CONFIG_FILE, CONFIG_TOML = "config.json", "config.toml"
"""A run's settings in its directory; the first with the source's revision, the second for
``--config``."""
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
    """Who guides: the word expert, ``module:Class`` of another script, or a human model's
    directory."""
    guided_share: float = 1.0
    """Share of the episodes that the human watches. (The authors' code: a third in the left
    turn.)"""
    guided_until_step: int = 0
    """Environment steps after which the human leaves for good; 0: never."""
    guided_until_episode: int = 0
    """Episodes after which the human gives up; 0: never."""
    late_from_s: float = 0.0
    """Least time by which the human takes over too late; each take-over's is drawn anew."""
    late_to_s: float = 0.0
    """Longest such time."""
    missed_share: float = 0.0
    """Share of the reasons to take over that the human overlooks, for 15 control periods each."""
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
    period_s: float = 0.0
    """Seconds of a step, whatever the environment says; 0: what it says."""
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
        if self.late_to_s < self.late_from_s:
            raise UserError(f"late_to_s {self.late_to_s} is below late_from_s {self.late_from_s}")

    def guided(self, episode: int, steps: int) -> bool:
        """Whether the human watches an episode that begins after so many environment steps."""
        if self.guided_until_step and steps >= self.guided_until_step:
            return False
        if self.guided_until_episode and episode >= self.guided_until_episode:
            return False
        return math.ceil((episode + 1) * self.guided_share) > math.ceil(episode * self.guided_share)

    def as_toml(self) -> str:
        """A file for ``--config``."""
        values = asdict(self)
        parts = values, values.pop("learner")
        own, learner = (
            [f"{n} = {json.dumps(v, ensure_ascii=False)}" for n, v in part.items()]
            for part in parts
        )
        return "\n".join([*own, "", "[learner]", *learner, ""])

    @property
    def kept_actor(self) -> str:
        """The learner's network that is validated and kept."""
        return "target_actor" if self.averaged_actor else "actor"

    def label(self, episode: int) -> dict[str, Any]:
        """What a file of the run says of its run and episode."""
        return {
            "scenario": self.scenario,
            "algorithm": self.algorithm,
            "seed": self.seed,
            "episode": episode,
        }


def period_of(config: Mapping[str, Any]) -> float | None:
    """How long a step was in a saved run, s; None where the environment said it.

    Raises UserError where its config is damaged.
    """
    period_s = config.get("period_s", 0.0)
    if not isinstance(period_s, int | float):
        raise UserError(f"period_s of the run's config is no number: {period_s!r}")
    return period_s or None


PRINTED = RunConfig(averaged_actor=False, printed_reward=True, learner=PRINTED_LEARNER)
"""As the paper prints it; but a human who frees a stuck car is no penalty (eq. 17), and eq. 21b's
exponent has a bound. Where the paper can be read in two ways, table A5's noise scale of 0.2 is that
of TD3's target smoothing, which eq. 22 does not show, its rates of 1 and 0.05 are deviations of the
exploration noise (eq. 18b), and eq. 32 counts steering in units of full action. What it leaves open
is ours: cloning weight, precision, 256 steps before the first update, the best actor kept."""
PRESETS = {"ours": RunConfig(), "printed": PRINTED}
"""Where the settings of a training start from, by the word behind ``--preset``."""
