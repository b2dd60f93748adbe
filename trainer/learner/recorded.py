"""A step of learning that a GPU records once and replays, without Python between its kernels."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

WARM_UPS = 3  # Calls that run as they are, so that libraries and optimisers have what they need


class RecordedStep:
    """Calls ``step(batch)``, from the fourth call on by a replay of its kernels.

    ``step`` branches on nothing that a tensor holds, and a batch's tensors, nested in named tuples
    and lists, always have the same shapes. ``noise`` is the generator that it draws from.
    """

    def __init__(self, step: Callable[[Any], Tensor], noise: torch.Generator) -> None:
        self._step, self._noise, self._calls = step, noise, 0
        self._stream = torch.cuda.Stream(noise.device)
        self._graph = torch.cuda.CUDAGraph()

    def __call__(self, batch: Any) -> Tensor:
        """Begin the step on a batch that may lie in the processor's memory; return its result."""
        here = torch.cuda.current_stream()
        self._stream.wait_stream(here)
        with torch.cuda.stream(self._stream):
            if not self._calls:
                there = partial(torch.empty_like, device=self._noise.device)
                self._batch = tree_map_only(Tensor, there, batch)
            for own, given in zip(*map(tree_leaves, (self._batch, batch)), strict=True):
                if own is not None:
                    own.copy_(given)
            if self._calls < WARM_UPS:
                result = self._step(self._batch)
            else:
                if self._calls == WARM_UPS:
                    self._record()
                self._graph.replay()
                result = self._result.clone()
        self._calls += 1
        here.wait_stream(self._stream)
        return result

    def replay(self) -> None:
        """Do the recorded step once more, on the same batch."""
        self._graph.replay()

    def _record(self) -> None:
        self._graph.register_generator_state(self._noise)
        # Other threads may use the GPU meanwhile.
        with torch.cuda.graph(self._graph, stream=self._stream, capture_error_mode="thread_local"):
            self._result = self._step(self._batch)
