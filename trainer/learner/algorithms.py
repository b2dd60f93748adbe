"""Every algorithm of the paper as one row of a table of switches (section VII-A)."""

from __future__ import annotations

from dataclasses import dataclass, replace


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
