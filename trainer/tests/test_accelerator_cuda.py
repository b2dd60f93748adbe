"""The learner on CUDA, with its graphs."""

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from trainer.learner.algorithms import PHIL
from trainer.learner.minibatch import Minibatch
from trainer.learner.td3 import TD3Learner
from trainer.tests.accelerating import SMALL, fill, observation, small, weights
from trainer.training.accelerator import AcceleratorLearning

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(
        not torch.cuda.is_available(), reason="no CUDA device: graphs cannot be captured"
    ),
]


def uncaptured(learning: Any) -> Any:
    """The same without graphs."""
    learning._graph = lambda name, function, learning=False: function
    return learning


@pytest.mark.parametrize("delay", [1, 2])
def test_graphs_do_what_the_functions_do(delay):
    graphs = AcceleratorLearning(replace(SMALL, policy_delay=delay), PHIL, 1, 1)
    plain = uncaptured(AcceleratorLearning(replace(SMALL, policy_delay=delay), PHIL, 1, 1))
    for learning in (graphs, plain):
        fill(learning)
        for number in range(5):
            learning.begin(0.0)
            fill(learning, 3)
            learning.act(observation(number))
            learning.learner.decay_learning_rates()
    torch.testing.assert_close(weights(graphs.learner), weights(plain.learner))
    torch.testing.assert_close(graphs.replay.priorities, plain.replay.priorities)
    ours, theirs = (learning.act(observation(9)) for learning in (graphs, plain))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    assert torch.equal(graphs._drawing.get_state(), plain._drawing.get_state())
    assert graphs.end_episode().learning_s > 0


def test_cuda_learns_what_the_processor_learns():
    """From the same batch: the first update's weights and priorities."""
    on_cuda, batch = small("cuda"), small().replay.draw(8, torch.Generator().manual_seed(0))[1]
    there = Minibatch(*(column.cuda() for column in batch))
    config = replace(SMALL, target_noise=0.0)
    learners = [TD3Learner(config, PHIL, 1, device=device) for device in ("cpu", "cuda")]
    found = [
        learner.step(where, torch.zeros((), device=learner.device))
        for learner, where in zip(learners, (batch, there), strict=True)
    ]
    torch.testing.assert_close(found[0].losses, found[1].losses.cpu(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found[0].priorities, found[1].priorities.cpu(), rtol=1e-3, atol=1e-4)
    assert len(on_cuda.replay) == 20


def test_a_graph_runs_without_any_synchronisation():
    learning = small("cuda")
    for _ in range(2):
        learning.act(observation(0))
        learning.begin(0.0)
        fill(learning, 1)
    torch.cuda.set_sync_debug_mode("error")
    try:
        learning.begin(0.5)
        fill(learning, 1)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_a_restored_one_on_cuda_goes_on_like_one_unbroken():
    whole = small("cuda")
    for _ in range(4):
        whole.begin(0.0)
    whole.end_episode()
    resumed = AcceleratorLearning(SMALL, PHIL, seed=99, action_size=1)
    state = copy.deepcopy(whole.state_dict())
    resumed.load_state_dict(state)
    for learning in (whole, resumed):
        fill(learning, 5)
        for _ in range(4):
            learning.begin(0.0)
        learning.end_episode()
    assert torch.equal(weights(whole.learner), weights(resumed.learner))
