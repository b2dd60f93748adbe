"""The fast learner against the plain one: same weights, same batches, same result."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from trainer.learner.config import ALGORITHMS, PHIL, Algorithm, LearnerConfig
from trainer.learner.td3 import TD3Learner
from trainer.tests.reference import ReferenceLearner, q
from trainer.tests.test_td3 import SMALL, make_batch, same_weights, weights_of


def both(config: LearnerConfig, algorithm: Algorithm) -> tuple[TD3Learner, ReferenceLearner]:
    """With targets that differ from the online networks, as they do after some updates."""
    fast = TD3Learner(config, algorithm, seed=2)
    plain = ReferenceLearner(replace(config, precision="float32"), algorithm, seed=2)
    for learner in (fast, plain):
        random = torch.Generator().manual_seed(5)
        with torch.no_grad():
            for module in (learner.target_actor, learner.target_critics):
                for p in module.parameters():
                    p.add_(0.02 * torch.randn(p.shape, generator=random))
            # Fresh critics hardly feel the action: without this, whose it was would not show.
            learner.target_actor.head.output.bias.add_(0.5)
            for critic in learner.target_critics.pair:
                critic.action.weight += 0.5
    return fast, plain


def check(config: LearnerConfig, algorithm: Algorithm, humans: int = 4) -> None:
    fast, plain = both(config, algorithm)
    start = weights_of(fast)
    for seed in range(2):
        batch, off = make_batch(seed, humans), 1e-3 if seed else 1e-5
        ours, wanted = fast.update(batch, beta=0.5), plain.update(batch, beta=0.5)
        np.testing.assert_allclose(ours[:4], wanted[:4], rtol=off, atol=0.01 * off)
        np.testing.assert_allclose(ours.priorities, wanted.priorities, rtol=max(off, 1e-4))
        modules = (fast.actor, plain.actor), (fast.critics, plain.critics)
        for pair in () if seed else modules:
            for p, right_p in zip(*(module.parameters() for module in pair), strict=True):
                if right_p.grad is not None:  # a delayed policy's turn is still to come
                    assert p.grad is not None
                    assert (p.grad - right_p.grad).norm() <= 1e-3 * right_p.grad.norm()
    for name, flat in weights_of(fast).items():
        # Adam amplifies rounding where a gradient is nearly nothing: compare the step as a whole.
        right = weights_of(plain)[name]
        step = (right - start[name]).norm()
        assert (flat - right).norm() <= 0.02 * step, name


# To the learner the others are one of these: they differ in what is stored, and how it is drawn.
ALIKE = {"rd2_td3", "rd2_phil", "rlpd_td3", "phil_gated"}


@pytest.mark.parametrize("name", sorted(ALGORITHMS.keys() - ALIKE))
def test_every_algorithm(name):
    check(replace(SMALL, **ALGORITHMS[name].settings), ALGORITHMS[name])


@pytest.mark.parametrize(
    "change",
    [
        {"split_loss": True},
        {"policy_delay": 2},
        {"normalise_importance": False},
        {"frames": 1},
        {"saturation_weight": 0.3},
        {"gamma": 0.5, "tau": 0.1},
        {"target_noise": 0.5},
        {"penalty_on": "human"},
        {"critic_norm": False},
    ],
    ids=lambda change: "-".join(change),
)
def test_every_switch(change):
    check(replace(SMALL, **change), PHIL)


@pytest.mark.parametrize("humans", [0, 12])
def test_batches_of_one_kind(humans):
    check(replace(SMALL, split_loss=True), PHIL, humans)


def test_reduced_precision_is_near_and_repeatable():
    """bfloat16 keeps 8 bits of each factor: the gradients stay within a few percent."""
    fast, plain = both(replace(SMALL, precision="bfloat16"), PHIL)
    again, _ = both(replace(SMALL, precision="bfloat16"), PHIL)
    batch = make_batch(0)
    ours, wanted = fast.update(batch), plain.update(batch)
    again.update(batch)
    np.testing.assert_allclose(ours.critic_loss, wanted.critic_loss, rtol=0.02)
    np.testing.assert_allclose(ours.priorities, wanted.priorities, rtol=0.1, atol=0.02)
    for got, right in zip(fast.actor.parameters(), plain.actor.parameters(), strict=True):
        assert got.grad is not None
        assert right.grad is not None
        assert torch.cosine_similarity(got.grad.flatten(), right.grad.flatten(), dim=0) > 0.99
    assert same_weights(fast, again)


def test_the_doubt_is_how_far_the_critics_are_apart():
    fast, plain = both(SMALL, ALGORITHMS["phil_gated"])
    batch = make_batch(0)
    seen, actions = torch.from_numpy(batch.frames[:1].copy()), torch.from_numpy(batch.actions[:1])
    one, other = (float(q(critic, seen, actions)) for critic in plain.critics.pair)
    assert fast.doubt(batch.frames[0], batch.actions[0]) == pytest.approx(
        abs(one - other), rel=1e-3
    )
