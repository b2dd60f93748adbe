"""The fast learner against the plain one: same weights, same batches, same result."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from trainer.learner.config import ALGORITHMS, PHIL, Algorithm, LearnerConfig
from trainer.learner.td3 import TD3Learner
from trainer.tests.reference import ReferenceLearner
from trainer.tests.test_td3 import SMALL, make_batch, weights_of

UPDATES = 3


def both(config: LearnerConfig, algorithm: Algorithm) -> tuple[TD3Learner, ReferenceLearner]:
    fast = TD3Learner(config, algorithm, seed=2)
    plain = ReferenceLearner(replace(config, precision="float32"), algorithm, seed=2)
    return fast, plain


def check(config: LearnerConfig, algorithm: Algorithm, humans: int = 4) -> None:
    fast, plain = both(config, algorithm)
    start = weights_of(fast)
    for seed in range(UPDATES):
        batch = make_batch(seed, humans)
        ours, wanted = fast.update(batch, beta=0.5), plain.update(batch, beta=0.5)
        np.testing.assert_allclose(ours[:4], wanted[:4], rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(ours.priorities, wanted.priorities, rtol=1e-3)
    for name, flat in weights_of(fast).items():
        # Adam amplifies rounding where a gradient is nearly nothing: compare the step as a whole.
        right = weights_of(plain)[name]
        step = (right - start[name]).norm()
        assert (flat - right).norm() <= 0.02 * step, name


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm(name):
    check(SMALL, ALGORITHMS[name])


@pytest.mark.parametrize(
    "change",
    [
        {"split_loss": True},
        {"policy_delay": 2},
        {"normalise_importance": False},
        {"frames": 1},
        {"saturation_weight": 0.3},
        {"cloning_weight": 0.0},
        {"gamma": 0.5, "tau": 0.1},
        {"target_noise": 0.0},
        {"penalty_on": "human"},
        {"intervention_penalty": -3.0},
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
    np.testing.assert_allclose(ours.critic, wanted.critic, rtol=0.02)
    np.testing.assert_allclose(ours.priorities, wanted.priorities, rtol=0.1, atol=0.02)
    for got, right in zip(fast.actor.parameters(), plain.actor.parameters(), strict=True):
        assert got.grad is not None
        assert right.grad is not None
        cosine = torch.cosine_similarity(got.grad.flatten(), right.grad.flatten(), dim=0)
        assert cosine > 0.99
    for name, flat in weights_of(fast).items():
        assert torch.equal(flat, weights_of(again)[name])
