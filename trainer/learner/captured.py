"""Functions on tensors recorded once as a CUDA graph, and then replayed without the processor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from trainer.learner.optimiser import adam_moments, uncaptured_steps
from trainer.learner.td3 import TD3Learner

WARM_UPS = 3
"""Runs before a recording, in which libraries choose their algorithms and take their memory."""


def captured(
    function: Callable[[], None],
    device: torch.device,
    changed: Sequence[Tensor] = (),
    generators: Sequence[torch.Generator] = (),
) -> Callable[[], None]:
    """The function as a CUDA graph; elsewhere than on CUDA, the function itself.

    Args:
        function: works on tensors that stay where they are, and changes nothing else.
        device: of those tensors.
        changed: those that it changes, except where doing so again is harmless: they are put
            back after the runs before the recording.
        generators: those that it draws from; put back, too.
    """
    if device.type != "cuda":
        return function
    with preserved(changed, generators):
        _warm_up(function)
    graph = torch.cuda.CUDAGraph()
    for generator in generators:
        graph.register_generator_state(generator)
    with torch.cuda.graph(graph):
        function()
    return graph.replay


@contextmanager
def preserved(tensors: Sequence[Tensor], generators: Sequence[torch.Generator]) -> Iterator[None]:
    """Put tensors and generators back afterwards, the tensors in place: graphs know addresses."""
    values = [tensor.detach().clone() for tensor in tensors]
    states = [generator.get_state() for generator in generators]
    try:
        yield
    finally:
        with torch.no_grad():
            for tensor, value in zip(tensors, values, strict=True):
                tensor.copy_(value)
        for generator, state in zip(generators, states, strict=True):
            generator.set_state(state)


def changed_by_learning(learner: TD3Learner) -> list[Tensor]:
    """Every tensor that ``learner.change`` changes; moments are made if there are none yet."""
    networks = (learner.actor, learner.critics, learner.target_actor, learner.target_critics)
    parameters = [parameter for network in networks for parameter in network.parameters()]
    moments = [
        tensor
        for optimiser in (learner.actor_optimiser, learner.critic_optimiser)
        for tensor in adam_moments(optimiser)
    ]
    return parameters + moments


def _warm_up(function: Callable[[], None]) -> None:
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream), uncaptured_steps():
        for _ in range(WARM_UPS):
            function()
    torch.cuda.current_stream().wait_stream(stream)
