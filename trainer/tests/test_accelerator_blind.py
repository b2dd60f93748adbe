"""The learner on torch's meta device, which has shapes and no values: reading one back raises."""

from contextlib import nullcontext

import pytest
import torch

from trainer.learner import td3
from trainer.learner.algorithms import ALGORITHMS
from trainer.learner.td3 import TD3Learner
from trainer.tests.accelerating import fill, observation, small

pytestmark = pytest.mark.usefixtures("one_thread")


class NoGenerator:
    """The meta device has none; torch takes None for one."""

    def __init__(self, device: torch.device) -> None: ...

    def manual_seed(self, seed: int) -> None:
        return None


@pytest.fixture
def blind(monkeypatch):
    """``AcceleratorLearning`` on the meta device, with what that lacks: generators, autocast and
    a fused Adam, none of which reads a value back on CUDA.
    """
    monkeypatch.setattr(torch, "Generator", NoGenerator)
    monkeypatch.setattr(TD3Learner, "_precision", lambda self: nullcontext())
    monkeypatch.setattr(
        td3, "make_adam", lambda module, rate, device: torch.optim.Adam(module.parameters(), rate)
    )
    return lambda **changes: small("meta", **changes)


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
@pytest.mark.parametrize("split", [False, True])
def test_storing_and_learning_read_no_value_back(blind, algorithm, split):
    learning = blind(algorithm=algorithm, split_loss=split, policy_delay=2, saturation_weight=0.1)
    for _ in range(3):
        learning.begin(0.3)
        learning.finish()
        fill(learning, 2)
    learning.learner.decay_learning_rates()


def test_only_the_action_and_the_episodes_end_read_values_back(blind):
    learning = blind()
    learning.begin(0.0)
    learning._seen.row()["frames"] = observation(0)
    learning._seen.send()
    learning._choose_action()
    # Pins down that the device without values refuses, and where.
    for reading in (learning.replay.mean_priorities, learning.end_episode):
        with pytest.raises(NotImplementedError, match="no data"):
            reading()
