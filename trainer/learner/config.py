"""Algorithms as rows of a table of switches, and hyper-parameters.

The hyper-parameters are tables A5 and A6, what differs from them, and what the paper leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from edge_runtime.util import UserError
from trainer.util import ABOVE_ZERO, ANY, FROM_ONE, FROM_ZERO, SHARE, check_ranges


@dataclass(frozen=True)
class Algorithm:
    """What one algorithm does with the human. All rows share one training loop and learner."""

    guided: bool = True
    """The human takes over when the trigger says so."""
    penalty: bool = True
    """The first step of an intervention is penalised (eq. 17)."""
    behaviour_cloning: bool = True
    """The actor also imitates the human's actions (eq. 23, second term)."""
    td_weight: float = 1.0
    """Weight of |delta| in the priority of the policy's own transitions."""
    human_td_weight: float = 1.0
    """Weight of |delta| in the priority of the human's transitions."""
    separate_buffers: bool = False
    """The human's transitions and the policy's lie in a buffer each (section VII-A: RD2); from
    which one is drawn goes by how much there is in each."""
    advantage_weight: float = 1.0
    """Weight of the Q advantage in the priority of the human's transitions (eq. 21)."""


PHIL = Algorithm()

ALGORITHMS: dict[str, Algorithm] = {
    "phil_td3": PHIL,
    "ia_td3": replace(PHIL, advantage_weight=0.0),
    "hi_td3": replace(PHIL, advantage_weight=0.0, behaviour_cloning=False),
    # The paper does not say whether RD2-TD3 clones; here it does, so that each row differs from
    # PHIL-TD3 in what figure 13 is about.
    "rd2_td3": replace(PHIL, advantage_weight=0.0, separate_buffers=True),
    "rd2_phil": replace(PHIL, separate_buffers=True),
    "per_td3": Algorithm(
        guided=False, penalty=False, behaviour_cloning=False, advantage_weight=0.0
    ),
    "phil_td_only": replace(PHIL, human_td_weight=2.0, advantage_weight=0.0),
    "phil_q_advantage_only": replace(PHIL, human_td_weight=0.0),
    "phil_advantage_0.1": replace(PHIL, advantage_weight=0.1),
    "phil_advantage_100": replace(PHIL, advantage_weight=100.0),
    "phil_without_cloning": replace(PHIL, behaviour_cloning=False),
    "phil_without_shaping": replace(PHIL, penalty=False),
}
"""Command-line name -> switches. The first six are the paper's; the rest take PHIL-TD3 apart."""


@dataclass(frozen=True)
class LearnerConfig:
    """One field a hyper-parameter; the paper's value where the docstring names its table."""

    frames: int = 2
    """Newest frames that actor and critics see: eq. 28's two, or the tough setting's one."""
    batch_size: int = 128
    """Transitions in a minibatch (table A5: N)."""
    actor_learning_rate: float = 1e-4
    """Of the actor's optimiser (table A5: 5e-4). Adam's steps are as long for a small gradient as
    for a large one, and where the actor has little left to learn, its gradient is the critics'
    error. Five times as fast, it followed that error away from what it had learned."""
    critic_learning_rate: float = 1e-3
    """Of the critics' (table A5: 2e-4). Normalised critics learn slower, and an actor should follow
    critics that are ahead of it."""
    learning_rate_decay: float = 1.0
    """Factor on both learning rates, once an episode (table A5: 0.996). By steps is
    fairer: a policy that fails early has many short episodes."""
    learning_rate_final: float = 0.0
    """Share of both learning rates that is left at the end of the run; they fall to it linearly.
    The paper's is 1. With rates that stay high, the late policy swings about what it learned."""
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
    exploration_initial: float = 0.1
    """Standard deviation of the exploration noise at first (table A5: 1). With 0.3 the congestion
    is not learned: the noise alone makes the car crash, a return of several steps holds what the
    noise brought and not what the action was worth, and a human takes over for the noise's sake."""
    exploration_correlation: float = 0.9
    """Correlation of the noise in two control periods in a row; the paper's is 0. A tenth of a
    second of steering moves the car by nothing that a critic could see, a second of it does: noise
    that lasts shows what an action is worth (Ornstein-Uhlenbeck, as in DDPG; Lillicrap et al.,
    2016)."""
    exploration_final: float = 0.05
    """Least standard deviation of the exploration noise (table A5)."""
    exploration_share: float = 0.5
    """Share of the run in which the deviation falls linearly from the first to the least. By
    steps, not by episodes: a policy that fails early has many short ones, and would stop exploring
    before it has learned anything. The paper names no law."""
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
    cloning_weight: float = 40.0
    """Weight of the behaviour cloning term (omega of eq. 23; no value in the paper). Chosen
    on single runs, in which a small weight let the policy forget the human before the critic knew
    better."""
    intervention_penalty: float = -10.0
    """What an intervention costs (eq. 17: r_pen = r_fail)."""
    penalty_on: str = "overruled"
    """What an intervention's penalty is charged to: ``overruled``, the policy's action that made
    the human take over, whose value it becomes; a return of several steps ends there, too. Or
    ``human``, the reward of the human's own first action, as printed, which teaches the critic that
    rescuing is as bad as crashing."""
    action_bound: float = 0.25
    """Bound of the initial weights with which the action joins the picture in the critics' first
    connected layer; 0: that of one more feature among 1,792 (0.02), as the paper's networks begin.
    There the action hardly counts in the value at first, and the actor's gradient is noise."""
    critic_norm: bool = True
    """Layer normalisation in the critics (RLPD; Ball et al., 2023). Beside a good human there are
    few failures to learn from, and without it the critics promise most for actions that nobody
    has tried: the actor follows, and unlearns what it was shown."""
    picture_shift: int = 3
    """Pixels by which the pictures of a minibatch are shifted at random, up, down and aside, at
    most (DrQ; Kostrikov et al., 2020); the paper has none. What counts is where cars are to one
    another, and a network that has seen each picture in many places learns that from fewer."""
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
    "learning_rate_final": SHARE,
    "gamma": SHARE,
    "return_steps": FROM_ONE,
    "tau": SHARE,
    "policy_delay": FROM_ONE,
    "target_noise": FROM_ZERO,
    "target_noise_bound": FROM_ZERO,
    "exploration_initial": FROM_ZERO,
    "exploration_correlation": SHARE,
    "exploration_final": FROM_ZERO,
    "exploration_share": ABOVE_ZERO,
    "exploration_bound": FROM_ZERO,
    "replay_capacity": (1, 10**9),
    "alpha": SHARE,
    "priority_offset": ABOVE_ZERO,
    "advantage_bound": FROM_ZERO,
    "beta": SHARE,
    "cloning_weight": FROM_ZERO,
    "intervention_penalty": ANY,
    "action_bound": FROM_ZERO,
    "picture_shift": (0, 20),
    "warmup_steps": FROM_ONE,
    "saturation_weight": FROM_ZERO,
}
"""What each number may be."""

PRINTED_LEARNER = LearnerConfig(
    exploration_initial=1.0,
    exploration_correlation=0.0,
    actor_learning_rate=5e-4,
    critic_learning_rate=2e-4,
    learning_rate_decay=0.996,
    learning_rate_final=1.0,
    return_steps=1,
    tau=1e-3,
    split_loss=True,
    penalty_on=HUMANS_ACTION,
    action_bound=0.0,
    critic_norm=False,
    picture_shift=0,
    saturation_weight=0.0,
)
"""Tables A5 and A6 and the equations as they are printed. The weight on cloning, for which the
paper has no value, is ours."""
