"""How much better the human's action was, in the critic's opinion."""

from __future__ import annotations

import torch

from trainer.learner.networks import Critic
from trainer.viewer.entries import Correction


@torch.no_grad()
def q_advantage(critic: Critic, correction: Correction) -> float:
    """Q'(s, a_human) - Q'(s, a_policy): eq. 21b's exponent, for the action that was overruled.

    One picture at a time: that takes this thread alone, where a batch would bring a second pool of
    threads beside the learner's.
    """
    picture = critic.embed(torch.from_numpy(correction.frames)[None])
    actions = torch.tensor([correction.action.tolist(), correction.policy_action.tolist()])
    human, policy = critic.value(picture.expand(2, -1), actions).tolist()
    return human - policy
