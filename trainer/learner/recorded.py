"""Record a learning step on a GPU once, and replay it without Python between its kernels."""

import gc
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

WARM_UPS = 3  # Calls before the recording, in which libraries and optimisers allocate memory


class RecordedStep:
    """Calls ``step(batch)``; from the fourth call on it replays the recorded kernels.

    ``step`` must not branch on a tensor's values. A batch's tensors, nested in named tuples and
    lists, must always have the same shapes. ``noise`` is the generator that the step draws from.
    """

    def __init__(self, step: Callable[[Any], Tensor], noise: torch.Generator) -> None:
        self._step, self._noise, self._calls = step, noise, 0
        self._stream = torch.cuda.Stream(noise.device)
        self._graph = torch.cuda.CUDAGraph()

    def __call__(self, batch: Any) -> Tensor:
        """Start the step on a batch, which may be in CPU memory; return its result."""
        callers = torch.cuda.current_stream()
        self._stream.wait_stream(callers)
        with torch.cuda.stream(self._stream):
            if not self._calls:
                allocate = partial(torch.empty_like, device=self._noise.device)
                self._batch = tree_map_only(Tensor, allocate, batch)
            for target, source in zip(*map(tree_leaves, (self._batch, batch)), strict=True):
                if target is not None:
                    target.copy_(source)
            if self._calls < WARM_UPS:
                result = self._step(self._batch)
            else:
                if self._calls == WARM_UPS:
                    self._record()
                self._graph.replay()
                result = self._result.clone()
        self._calls += 1
        callers.wait_stream(self._stream)
        return result

    def replay(self) -> None:
        """Replay the recorded step once more, on the same batch."""
        self._graph.replay()

    def _record(self) -> None:
        self._graph.register_generator_state(self._noise)
        gc.collect()  # To free another graph during the recording would spoil it.
        # Other threads may use the GPU meanwhile.
        with torch.cuda.graph(self._graph, stream=self._stream, capture_error_mode="thread_local"):
            self._result = self._step(self._batch)
