"""What is captured as a graph, and that capturing leaves nothing behind."""

import copy
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch

from trainer.learner.algorithms import PHIL
from trainer.learner.captured import captured, changed_by_learning, preserved
from trainer.learner.optimiser import load_adam, make_adam
from trainer.learner.td3 import TD3Learner
from trainer.tests.accelerating import SMALL, small, weights

pytestmark = pytest.mark.usefixtures("one_thread")


def test_warming_up_changes_nothing():
    """Weights, moments, priorities, losses and generators, at the very same addresses."""
    learning, untouched = small(), small()
    changed = changed_by_learning(learning.learner)
    changed += [learning.replay.priorities, learning._loss_sums]
    generators = [learning.learner.noise, learning._drawing]
    places = [tensor.data_ptr() for tensor in changed]
    assert torch.equal(weights(learning.learner), weights(untouched.learner))
    with preserved(changed, generators):
        for _ in range(3):
            learning._update(with_policy=True)
        assert not torch.equal(weights(learning.learner), weights(untouched.learner))
    assert [tensor.data_ptr() for tensor in changed] == places
    for each in (learning, untouched):
        for _ in range(3):
            each.begin(0.0)
    assert torch.equal(weights(learning.learner), weights(untouched.learner))
    assert torch.equal(learning.replay.priorities, untouched.replay.priorities)
    assert torch.equal(learning._loss_sums, untouched._loss_sums)


def test_moments_are_among_what_is_put_back_before_the_first_step():
    learner = TD3Learner(SMALL, PHIL, seed=1)
    parameters = sum(1 for n in (learner.actor, learner.critics) for _ in n.parameters())
    # Online and target, and of each online parameter two moments and a step count.
    assert len(changed_by_learning(learner)) == 2 * parameters + 3 * parameters
    assert all(state["step"] == 0 for state in learner.actor_optimiser.state.values())


def test_a_recording_comes_after_runs_that_leave_nothing_behind(monkeypatch):
    """With a stand-in for torch's own part: what is done, in which order."""
    done: list[Any] = []
    number, drawing = torch.zeros(1), torch.Generator().manual_seed(0)
    before = drawing.get_state()

    def function():
        done.append((float(number), torch.rand(1, generator=drawing).item()))
        number.add_(1.0)

    class Graph:
        def register_generator_state(self, generator):
            assert generator is drawing
            assert torch.equal(generator.get_state(), before)
            done.append("registered")

        def replay(self):
            done.append("replayed")

    @contextmanager
    def recording(graph):
        assert isinstance(graph, Graph)
        done.append("recording")
        yield
        done.append("recorded")

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", recording)
    monkeypatch.setattr(torch.cuda, "Stream", MagicMock())
    monkeypatch.setattr(torch.cuda, "current_stream", MagicMock())
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    replay = captured(function, torch.device("cuda"), [number], [drawing])
    replay()
    assert [run if isinstance(run, str) else run[0] for run in done] == [
        0.0, 1.0, 2.0, "registered", "recording", 0.0, "recorded", "replayed",
    ]  # fmt: skip
    assert done[5] == done[0]


def test_elsewhere_than_on_cuda_a_function_is_its_own_graph():
    assert captured(print, torch.device("cpu")) is print


def test_a_loaded_optimiser_keeps_its_rate_where_it_was():
    """On CUDA it is a tensor there, which a graph reads; a checkpoint is read to the processor."""
    module = torch.nn.Linear(2, 2)
    optimiser = make_adam(module, 1e-3, torch.device("cpu"))
    rate = torch.tensor(1e-3)
    optimiser.param_groups[0]["lr"] = rate
    state = copy.deepcopy(optimiser.state_dict())
    state["param_groups"][0] |= {"lr": torch.tensor(5e-4), "capturable": True}
    load_adam(optimiser, state)
    (group,) = optimiser.param_groups
    assert group["lr"] is rate
    assert rate.item() == pytest.approx(5e-4)
    assert group["capturable"] is False
    plain = make_adam(module, 1e-3, torch.device("cpu"))
    load_adam(plain, state)
    assert plain.param_groups[0]["lr"] == pytest.approx(5e-4)
    assert isinstance(plain.param_groups[0]["lr"], float)
