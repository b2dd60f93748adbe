"""Hyper-parameters: tables A5 and A6, what differs from them, and what the paper leaves open."""

from __future__ import annotations

from dataclasses import dataclass

from edge_runtime.errors import UserError
from trainer.util import ABOVE_ZERO, ANY, FROM_ONE, FROM_ZERO, SHARE, check_ranges


@dataclass(frozen=True)
class LearnerConfig:
    """One field a hyper-parameter; the paper's value where the docstring names its table."""

    frames: int = 2
    """Newest frames that actor and critics see: eq. 28's two, or the tough setting's one."""
    batch_size: int = 128
    """Transitions in a minibatch (table A5: N)."""
    actor_learning_rate: float = 2e-4
    """As in the authors' code, which has the two rates of table A5 the other way round. Chosen on
    single runs; the experiment ``switches`` compares the two over seeds."""
    critic_learning_rate: float = 5e-4
    """As above."""
    learning_rate_decay: float = 0.996
    """Factor on both rates, once an episode (table A5)."""
    gamma: float = 0.95
    """Discount factor of one control period (table A5)."""
    return_steps: int = 8
    """Rewards that a target sums up before it bootstraps (n of n-step returns; Hessel et al.,
    2018); the paper has 1. Goal and failure are 30 to 70 steps away, and one-step targets hardly
    carry them back."""
    tau: float = 5e-3
    """Share of the online weights that each soft update moves into the targets (table A5: 1e-3)."""
    policy_delay: int = 1
    """Critic updates for each actor update (table A5: d)."""
    target_noise: float = 0.2
    """Standard deviation of the target policy smoothing (table A5: noise scale)."""
    target_noise_bound: float = 0.5
    """Bound of that noise; TD3's own value, the paper has none."""
    exploration_initial: float = 0.5
    """Standard deviation of the exploration noise in the first episode (table A5: 1). More of it,
    and the human takes over for the noise's sake: the policy hardly drives, and the critic sees
    hardly anything but the human's steps. Less, and the left turn learns more slowly."""
    exploration_final: float = 0.05
    """What it falls to (table A5)."""
    exploration_decay: float = 0.985
    """Factor on it, once an episode: 0.05 is reached after 153 episodes. Not in the paper."""
    exploration_bound: float = 1.0
    """Bound of the exploration noise (table A5: c)."""
    replay_capacity: int = 100_000
    """Transitions kept (table A6)."""
    alpha: float = 0.6
    """Priority scaling factor (table A6)."""
    priority_offset: float = 1e-3
    """Constant that keeps every transition drawable (table A6: epsilon)."""
    advantage_bound: float = 4.0
    """Bound of the exponent in the Q advantage. A critic that is off by more than float can take
    the exponential of would otherwise make one priority infinite."""
    importance_sampling: bool = False
    """Weigh the critic's losses by eq. 15 and 16, which the paper calls optional."""
    beta: float = 1.0
    """Initial importance exponent (table A6); it falls linearly to zero over the run."""
    normalise_importance: bool = True
    """Divide importance weights by their largest (not in eq. 15)."""
    split_loss: bool = False
    """Exact eq. 22 and 23: separate means over policy and human samples. Off: one mean over the
    batch, as in the authors' code, since the exact form gives a handful of demonstrations half of
    the critic's loss."""
    cloning_weight: float = 10.0
    """Weight of the behaviour cloning term (omega of eq. 23; no value in the paper). Chosen
    on single runs, in which a small weight let the policy forget the human before the critic knew
    better."""
    intervention_penalty: float = -10.0
    """What an intervention costs (eq. 17: r_pen = r_fail)."""
    penalty_on: str = "overruled"
    """What it is charged to: ``overruled``, the policy's action that made the human take over,
    whose value it becomes; or ``human``, the reward of the human's own first action, as printed,
    which teaches the critic that rescuing is as bad as crashing."""
    warmup_steps: int = 256
    """Transitions stored before the first update."""
    saturation_weight: float = 0.03
    """Price on saturation: weight of the mean squared action before tanh in the actor's loss. Not
    in the paper. Without it the policy saturates before the critic knows anything, and its
    gradient vanishes."""
    precision: str = "bfloat16"
    """Of the products in convolutions and first connected layers while learning: float32, or
    bfloat16 where the processor multiplies that faster. Acting is always float32."""

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)
        for name, words in WORDS.items():
            if getattr(self, name) not in words:
                raise UserError(f"{name} must be one of {', '.join(words)}: {getattr(self, name)}")


OVERRULED_ACTION, HUMANS_ACTION = "overruled", "human"
WORDS = {
    "precision": ("float32", "bfloat16"),
    "penalty_on": (OVERRULED_ACTION, HUMANS_ACTION),
}
"""What each word may be."""
RANGES = {
    "frames": (1, 2),
    "batch_size": FROM_ONE,
    "actor_learning_rate": FROM_ZERO,
    "critic_learning_rate": FROM_ZERO,
    "learning_rate_decay": SHARE,
    "gamma": SHARE,
    "return_steps": FROM_ONE,
    "tau": SHARE,
    "policy_delay": FROM_ONE,
    "target_noise": FROM_ZERO,
    "target_noise_bound": FROM_ZERO,
    "exploration_initial": FROM_ZERO,
    "exploration_final": FROM_ZERO,
    "exploration_decay": SHARE,
    "exploration_bound": FROM_ZERO,
    "replay_capacity": (1, 10**9),
    "alpha": SHARE,
    "priority_offset": ABOVE_ZERO,
    "advantage_bound": FROM_ZERO,
    "beta": SHARE,
    "cloning_weight": FROM_ZERO,
    "intervention_penalty": ANY,
    "warmup_steps": FROM_ONE,
    "saturation_weight": FROM_ZERO,
}
"""What each number may be."""

PRINTED_LEARNER = LearnerConfig(
    exploration_initial=1.0,
    actor_learning_rate=5e-4,
    critic_learning_rate=2e-4,
    return_steps=1,
    tau=1e-3,
    split_loss=True,
    penalty_on=HUMANS_ACTION,
    saturation_weight=0.0,
)
"""Tables A5 and A6 and the equations as they are printed. The weight on cloning, for which the
paper has no value, is ours."""
