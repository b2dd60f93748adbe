"""Adam where a CUDA graph can capture it: learning rate and moments stay at their addresses."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor


def make_adam(
    module: torch.nn.Module, learning_rate: float, device: torch.device
) -> torch.optim.Adam:
    """Adam for a module's parameters."""
    # A captured graph reads its learning rate from the device.
    on_cuda = device.type == "cuda"
    rate = torch.tensor(learning_rate, device=device) if on_cuda else learning_rate
    return torch.optim.Adam(module.parameters(), rate, fused=True, capturable=on_cuda)


def load_adam(optimiser: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Take up moments and learning rate; where the rate is kept stays as it was made."""
    (made,) = optimiser.param_groups
    # Optimisers keep the very tensors they are given.
    optimiser.load_state_dict(copy.deepcopy(state))
    (group,) = optimiser.param_groups
    rate = float(group["lr"])
    group["lr"] = made["lr"].fill_(rate) if isinstance(made["lr"], Tensor) else rate
    group["capturable"] = made["capturable"]


def adam_moments(optimiser: torch.optim.Optimizer) -> list[Tensor]:
    """Moments and step counts; they are made here if the optimiser has not stepped yet."""
    if not optimiser.state:
        # Made by a first step in a recording, they would be cleared at each replay.
        for group in optimiser.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.zeros_like(parameter)
        with uncaptured_steps():
            optimiser.step()  # by gradients of zero: no weight moves
        for state in optimiser.state.values():
            state["step"].zero_()
    return [tensor for state in optimiser.state.values() for tensor in state.values()]


@contextmanager
def uncaptured_steps() -> Iterator[None]:
    """Take steps outside of a recording without torch's warning that this is slow."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "This instance was constructed with capturable=True")
        yield
