"""Algorithms as rows of a table of switches, and hyper-parameters.

The hyper-parameters are those of tables A5 and A6, our changes, and values that the paper omits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from edge_runtime.util import UserError
from trainer.util import ABOVE_ZERO, ANY, FROM_ONE, PERIOD_S, SHARE, check_ranges


@dataclass(frozen=True)
class Algorithm:
    """How an algorithm uses the human. All rows share one training loop and learner."""

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
    """Human and policy transitions have a buffer each (section VII-A: RD2); a minibatch draws from
    each in proportion to its size."""
    advantage_weight: float = 1.0
    """Weight of the Q advantage in the priority of the human's transitions (eq. 21)."""
    weighted_cloning: bool = False
    """The more the critic prefers the policy's action, the less a human's is imitated."""
    q_term: bool = True  # The actor maximises the critic's value (eq. 23, first term)
    rewarded: bool = True
    """The environment's reward counts. Without it only take-overs count, all of them, even those
    from a car that waits too long."""
    proxy_values: bool = False
    """The critics learn the values 1 for the human's action and -1 for the overruled one."""
    human_share: float = 0.0  # Human share of each minibatch; 0: by priority
    asks: float = 0.0
    """Share of the steps in which the robot asks for help, those where its critics disagree most;
    0: the human watches, and takes over without being asked."""
    foresight: int = 0
    """Number of predicted steps in which a further loss prefers the human's action to the overruled
    one; 0: no such loss."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters that replace the common ones in this row: its paper's, where ours do not
    fit."""


PHIL = Algorithm()
IA = replace(PHIL, advantage_weight=0.0)
UNIFORM = {"alpha": 0.0}
UNIT_VALUES = {"saturation_weight": 3e-3}
"""Q values lie in [-1, 1], a tenth of ours, so the saturation penalty shrinks with them."""
UNEXPLORED = {"exploration_initial": 0.0, "exploration_final": 0.0}
FASTER = {"actor_learning_rate": 3e-4}  # Chosen by the tuning (results/choices/rows.csv)
PVP = Algorithm(
    penalty=False, behaviour_cloning=False, advantage_weight=0.0, rewarded=False,
    proxy_values=True, human_share=0.5,
    settings={
        **UNIFORM, **UNIT_VALUES, **FASTER, "return_steps": 1, "cloning_weight": 1.0
    },
)  # fmt: skip

ALGORITHMS: dict[str, Algorithm] = {
    "phil_td3": PHIL,
    "ia_td3": IA,
    "hi_td3": replace(IA, behaviour_cloning=False),
    # The paper does not say whether RD2-TD3 clones; here it does, so that each row differs from
    # PHIL-TD3 only in the subject of figure 13.
    "rd2_td3": replace(IA, separate_buffers=True),
    "rd2_phil": replace(PHIL, separate_buffers=True),
    "per_td3": Algorithm(
        guided=False, penalty=False, behaviour_cloning=False, advantage_weight=0.0
    ),
    "phil_td_only": replace(PHIL, human_td_weight=2.0, advantage_weight=0.0),
    "phil_q_advantage_only": replace(PHIL, human_td_weight=0.0),
    "phil_advantage_0.1": replace(PHIL, advantage_weight=0.1),
    "phil_advantage_100": replace(PHIL, advantage_weight=100.0),
    # For humans who err: the settings limit how much, and how long, a few wrong actions count.
    "phil_weighted": replace(
        PHIL,
        weighted_cloning=True,
        settings={**FASTER, "cloning_share": 0.5, "cloning_bound": 0.1},
    ),
    "phil_without_cloning": replace(PHIL, behaviour_cloning=False),
    "phil_without_shaping": replace(PHIL, penalty=False),
    # HG-DAgger (1810.02890), with the replay of the others: IA-TD3 without reinforcement learning,
    # and so without exploration.
    "cloning_only": replace(IA, q_term=False, settings=UNEXPLORED),
    # RLIF (2311.12996): -1 where an intervention begins, here charged to the action that the human
    # overruled, and 0 elsewhere.
    "rlif_td3": replace(
        IA, behaviour_cloning=False, rewarded=False,
        settings={**UNIT_VALUES, **FASTER, "intervention_penalty": -1.0},
    ),
    # Proxy value propagation (2502.03369, NeurIPS 2023), and with cloning (2503.04969). Its
    # authors do not explore; here the validations were higher on average where it does.
    "pvp_td3": PVP,
    "pvp4real_td3": replace(PVP, behaviour_cloning=True),
    # RLPD (2302.02948): demonstrations come first; a human may also take over, as in HIL-SERL
    # (2410.21845). No cloning, no penalty. Two critics, not ten, and two updates a step, not 20:
    # with so few, one-step targets never carried back a far goal, hence the returns of all rows.
    # Without failures of its own the critics rate every action good.
    "rlpd_td3": Algorithm(
        penalty=False, behaviour_cloning=False, advantage_weight=0.0, human_share=0.5,
        settings={**UNIFORM, **FASTER, "policy_delay": 2, "updates_per_step": 2},
    ),
    # Predictive preference learning (2510.01545): in the L = 4 states to which the overruled action
    # would have led, the human's is preferred. Cloning counts as much. No Q term.
    "ppl_td3": replace(
        IA, penalty=False, q_term=False, rewarded=False, human_share=0.5, foresight=4,
        settings={
            **UNIFORM, **UNIT_VALUES, **UNEXPLORED, "cloning_weight": 1.0, "preference_beta": 1.0
        },
    ),
    # The robot asks where its critics disagree, with a budget, as in ThriftyDAgger (2109.08273);
    # AIM (2506.09176) trains a critic of its own for that. Until 500 doubts are known the human
    # watches; only take-overs of that time are penalised.
    "phil_gated": replace(PHIL, asks=0.05, settings={"cloning_weight": 10.0}),
}  # fmt: skip
"""Command-line name -> switches. The first six are the paper's, the next six take PHIL-TD3 apart,
and the others are other authors' methods and our own."""
PLUGIN_GROUP = "phil.algorithms"  # Entry points of other packages' rows


def find_algorithm(name: str) -> Algorithm:
    """Return the row of this name: of the table, of an installed package, or ``module:ROW``.

    Raises UserError: no such row.
    """
    if name in ALGORITHMS:
        return ALGORITHMS[name]
    rows = list(entry_points(group=PLUGIN_GROUP, name=name))
    if not rows and ":" in name:
        rows = [EntryPoint(name, name, PLUGIN_GROUP)]
    if not rows:
        plugged = entry_points(group=PLUGIN_GROUP).names
        known = ", ".join([*ALGORITHMS, *sorted(plugged)])
        raise UserError(f"no algorithm {name!r}; known are {known}, or module:ROW")
    try:
        row = rows[0].load()
    except Exception as error:  # A module may raise anything when it is imported.
        raise UserError(f"no algorithm {name!r}: {type(error).__name__}: {error}") from error
    if not isinstance(row, Algorithm):
        raise UserError(f"{name!r} is not an Algorithm of trainer.learner.config")
    return row


@dataclass(frozen=True)
class LearnerConfig:
    """The learner's hyper-parameters, with the paper's table, and its value if it differs."""

    frames: int = 2
    """Newest frames that actor and critics see: eq. 28's two, or the tough setting's one."""
    batch_size: int = 128
    """Transitions in a minibatch (table A5: N)."""
    actor_learning_rate: float = 1e-4
    """Learning rate of the actor (table A5: 5e-4). Adam's steps do not shrink with the
    gradient. Once the actor has little left to learn, its gradient is the critics' error; at five
    times this rate it followed that error away from what it had learned."""
    critic_learning_rate: float = 1e-3
    """Learning rate of the critics (table A5: 2e-4). Normalised critics learn slower, and an actor
    should follow critics that are ahead of it."""
    learning_rate_decay: float = 1.0
    """Factor on both learning rates, once an episode (table A5: 0.996). A decay by steps is
    fairer: a policy that fails early has many short episodes."""
    learning_rate_final: float = 0.0
    """Share of both learning rates at the end of the run, to which they fall linearly (the paper:
    1). With rates that stay high, the late policy oscillates."""
    gamma: float = 0.95
    """Discount factor of one control period (table A5). Default where T is below 0.1 s: the same
    discount in 0.1 s."""
    return_steps: int = 8
    """Rewards that a target sums up before it bootstraps (n of n-step returns; Hessel et al.,
    2018); the paper has 1. Goal and failure are 30 to 70 steps away, and one-step targets hardly
    carry them back."""
    tau: float = 5e-3
    """Share of the online weights that each soft update moves into the targets (table A5: 1e-3)."""
    updates_per_step: int = 1
    """Updates for each environment step (algorithm 1)."""
    policy_delay: int = 1
    """Critic updates for each actor update (table A5: d)."""
    target_noise: float = 0.2
    """Standard deviation of the target policy smoothing (table A5: noise scale)."""
    target_noise_bound: float = 0.5
    """Bound of that noise; TD3's own value, the paper has none."""
    exploration_initial: float = 0.1
    """Standard deviation of the exploration noise at first (table A5: 1). With 0.3 the congestion
    is not learned: the noise alone makes the car crash, a return of several steps measures the
    noise instead of the action, and a human takes over because of the noise. Default without
    human and pictures: 0.6, falling to 0.3."""
    exploration_searching: float = 0.0
    """Standard deviation of the noise in every other episode, until one of the rest succeeds or
    half of a validation; 0: no such episodes. The noise has no bound there: it must outweigh a
    policy that has learned that moving costs. Default without human and pictures: 4, mostly full
    actions. Only the first episode searches if it does not tell whether it succeeded."""
    exploration_correlation: float = 0.9
    """Correlation of the noise in two successive steps (the paper: 0). A critic cannot see what a
    tenth of a second of steering does, but it sees a second of it: lasting noise shows what an
    action is worth (Ornstein-Uhlenbeck, as in DDPG; Lillicrap et al., 2016). Default where T
    is below 0.1 s: the same correlation over 0.1 s."""
    exploration_final: float = 0.05
    """Least standard deviation of the exploration noise (table A5)."""
    exploration_share: float = 0.5
    """Share of the run over which the deviation falls linearly from ``exploration_initial`` to
    ``exploration_final``, counted in steps: in episodes, a policy that fails early would stop
    exploring before it has learned anything. The paper gives no schedule."""
    exploration_bound: float = 1.0
    """Bound of the exploration noise (table A5: c), but for searching episodes."""
    replay_capacity: int = 100_000
    """Transitions kept (table A6)."""
    alpha: float = 0.6
    """Priority scaling factor (table A6)."""
    priority_offset: float = 1e-3
    """Constant that keeps every transition drawable (table A6: epsilon)."""
    advantage_bound: float = 4.0
    """Bound of the exponent in the Q advantage. Without it a critic that is far off makes one
    priority infinite."""
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
    """Weight of the behaviour cloning term (omega of eq. 23; no value in the paper). Chosen on
    single runs: with a small weight the policy forgot the human before the critic knew better."""
    cloning_share: float = 0.0
    """Share of the run over which the cloning weight falls linearly to 0; 0: it is constant, and a
    human's errors are imitated to the end."""
    cloning_bound: float = 0.0
    """Distance from the human's action beyond which the cloning loss grows linearly instead of
    quadratically; 0: never. A few wrong actions then count little beside the right ones."""
    cloning_batch_size: int = 0
    """Size of a separate batch of human transitions, drawn uniformly, for cloning with a separate
    optimiser; 0: cloning uses the common minibatch. Default without pictures: 128. Few labels are
    soon fitted exactly; from then on a common optimiser follows the critics' error alone, at full
    step length, whatever the weights."""
    cloning_learning_rate: float = 1e-3
    """Learning rate of the separate cloning optimiser."""
    fresh_actors: int = 0
    """How often in a run, evenly spaced, the actor is replaced by a fresh one fitted to all human
    actions so far. An actor that began with few of them generalises worse (Ash and Adams, 2020).
    Default without pictures: 3."""
    fresh_actor_at_end: bool = False
    """One more when the run ends. Default without pictures where a row only imitates: true."""
    preference_beta: float = 0.1
    """Sharpness of a preference, per squared distance (2510.01545: beta); with a low value the loss
    keeps pulling when the actor is already nearer to the preferred action."""
    intervention_penalty: float = -10.0
    """Penalty of an intervention (eq. 17: r_pen = r_fail)."""
    penalty_on: str = "overruled"
    """Action that the penalty is charged to. ``overruled``: the policy's action that made the human
    take over; the penalty becomes its value, n-step returns end there, and its error, if larger,
    replaces |delta| in the transition's priority (eq. 21). ``human``: the human's own first action,
    as printed, which teaches the critic that rescuing is as bad as crashing."""
    action_bound: float = 0.25
    """Bound of the action's initial weights in the critics' first connected layer. 0: that of one
    more feature among 1,792 (0.02), as in the paper's networks; the action then hardly counts at
    first, and the actor's gradient is noise."""
    critic_norm: bool = True
    """Layer normalisation in the critics (RLPD; Ball et al., 2023). With a good human there are few
    failures to learn from, and without it the critics overrate actions that nobody has tried: the
    actor follows them, and unlearns what it was shown."""
    picture_shift: int = 3
    """Maximum random shift of a minibatch's pictures, up, down and aside, in pixels (DrQ; Kostrikov
    et al., 2020; the paper has none). Only the cars' places relative to one another count, and
    shifted pictures teach that with fewer of them."""
    warmup_steps: int = 256
    """Transitions stored before the first update."""
    saturation_weight: float = 0.03
    """Saturation penalty: weight of the mean squared action before tanh in the actor's loss. Not in
    the paper. Without it the policy saturates before the critic knows anything, and its gradient
    vanishes."""
    precision: str = "bfloat16"
    """Precision of convolutions and first connected layers while learning: float32, or bfloat16
    where the processor multiplies it faster. Acting is always float32."""

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)
        for name, words in WORDS.items():
            if getattr(self, name) not in words:
                raise UserError(f"{name} must be one of {', '.join(words)}: {getattr(self, name)}")


OVERRULED_ACTION, HUMANS_ACTION = "overruled", "human"
WORDS = {"precision": ("float32", "bfloat16"), "penalty_on": (OVERRULED_ACTION, HUMANS_ACTION)}
RANGES = {
    FROM_ONE: ("return_steps", "policy_delay", "updates_per_step", "warmup_steps"),
    SHARE: ("learning_rate_decay", "learning_rate_final", "gamma", "tau",
            "exploration_correlation", "alpha", "beta", "cloning_share"),
    ABOVE_ZERO: ("exploration_share", "priority_offset"),
    ANY: ("intervention_penalty",),
    (1, 2): ("frames",),
    (1, 10**6): ("batch_size",),
    (0, 10**6): ("cloning_batch_size", "fresh_actors"),
    (1, 10**9): ("replay_capacity",),
    (0, 20): ("picture_shift",),
}  # fmt: skip
"""Ranges of these numbers; all others are at least 0."""

UNGUIDED_NUMBERS = {
    "exploration_searching": 4.0, "exploration_initial": 0.6, "exploration_final": 0.3,
}  # fmt: skip
"""Without a human only noise finds rewards, and without pictures it does little harm."""
IMITATED_NUMBERS = {"cloning_batch_size": 128, "fresh_actors": 3}
"""Observations of numbers are cheap, so cloning can have a batch of its own."""


def task_settings(row: Algorithm, numbers: bool, period_s: float) -> dict[str, float]:
    """Return the hyper-parameters that replace the common ones in a task.

    ``numbers``: no entry of its observation is a picture. ``period_s`` is T: below 0.1 s,
    discounting and noise last as many seconds as at 0.1 s; a longer period keeps the common ones.
    """
    shorter, usual = min(period_s / PERIOD_S, 1.0), LearnerConfig()
    names = ("gamma", "exploration_correlation")
    lasting = {name: getattr(usual, name) ** shorter for name in names}
    if not numbers:
        return lasting
    imitated = IMITATED_NUMBERS if row.behaviour_cloning else {}
    if row.behaviour_cloning and not (row.q_term or row.foresight):
        imitated = {**imitated, "fresh_actor_at_end": True}
    return lasting | imitated | ({} if row.guided else UNGUIDED_NUMBERS)


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
