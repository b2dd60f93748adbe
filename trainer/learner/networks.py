"""Actor, critic and human model: the convolutional networks of tables A2, A3 and A4.

Two 6x6 convolutions (6 and 16 filters), each followed by ReLU and 2x2 max pooling, then fully
connected layers of 256, 128 and 64. Frames come as uint8 and are normalised to [0, 1] (eq. 28)
inside the network, so that an exported policy needs no preprocessing.

Nearly all products are in the convolutions and in what the first connected layer makes of the
picture: ``embed``. It follows the ``torch.autocast`` around it, and is computed once a picture for
all that is asked of it; the rest is small, and always in single precision.
"""

from __future__ import annotations

import re
from functools import cache
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn

from trainer.learner.kernel import trunk_features

CPU_INFO = Path("/proc/cpuinfo")
_INSTRUCTIONS = re.compile(r"\b(avx512_bf16|amx_bf16|bf16)\b")
"""As Linux names them on x86-64 and on aarch64."""


@cache
def multiplies_bfloat16(device_type: str) -> bool:
    """Whether ``device_type`` (``cpu``, ``cuda``) has instructions for it."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    try:
        return _INSTRUCTIONS.search(CPU_INFO.read_text(errors="replace")) is not None
    except OSError:
        return False


FRAME_ROWS, FRAME_COLUMNS = 45, 80
FILTERS = (6, 16)
KERNEL = 6
HIDDEN = (256, 128, 64)


def _side_after_pools(side: int) -> int:
    for _ in FILTERS:
        side = (side - KERNEL + 1) // 2
    return side


FEATURES = FILTERS[-1] * _side_after_pools(FRAME_ROWS) * _side_after_pools(FRAME_COLUMNS)
"""Length of a picture's feature vector (1,792)."""


class Trunk(nn.Module):
    """The two convolutions. Maps frames uint8 [batch, n, 45, 80] to features [batch, 1792]."""

    def __init__(self, frames: int = 2) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(frames, FILTERS[0], KERNEL)
        self.conv2 = nn.Conv2d(FILTERS[0], FILTERS[1], KERNEL)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, frames: Tensor) -> Tensor:
        """The features of pictures: by the compiled kernel where there is one."""
        first, second = self.conv1, self.conv2
        assert first.bias is not None
        assert second.bias is not None
        return trunk_features(frames, first.weight, first.bias, second.weight, second.bias)


class Picture(nn.Module):
    """Convolutions, and the picture's share of the first connected layer.

    Args:
        frames: how many of the newest frames the network sees. The input is always the
            observation [batch, 2, 45, 80], so that every network is run and exported alike.
        more_inputs: of that layer beside the features; they count in its initial weights.
    """

    def __init__(self, frames: int = 2, more_inputs: int = 0) -> None:
        super().__init__()
        self.frames = frames
        self.trunk = Trunk(frames)
        self.layer = nn.Linear(FEATURES, HIDDEN[0])
        bound = (FEATURES + more_inputs) ** -0.5
        nn.init.uniform_(self.layer.weight, -bound, bound)
        nn.init.uniform_(self.layer.bias, -bound, bound)

    def forward(self, frames: Tensor) -> Tensor:
        """float32 [batch, 256], before the activation, from frames uint8 [batch, 2, 45, 80]."""
        return self.layer(self.trunk(frames[:, -self.frames :])).float()


class Head(nn.Module):
    """The connected layers after the first one, which ends before its activation.

    Args:
        outputs: of the last layer.
        normalised: whether each hidden layer is normalised before its activation.
    """

    def __init__(self, outputs: int, normalised: bool = False) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.ReLU()]
        for inputs, width in pairwise(HIDDEN):
            norm = [nn.LayerNorm(width)] if normalised else []
            layers += [nn.Linear(inputs, width), *norm, nn.ReLU()]
        self.hidden = nn.Sequential(*layers)
        self.output = nn.Linear(HIDDEN[-1], outputs)

    def forward(self, embedded: Tensor) -> Tensor:
        """The last layer's values [batch, outputs] from [batch, 256], without an activation."""
        return self.output(self.hidden(embedded))


class Actor(nn.Module):
    """The policy pi(s) (table A3); with ``frames=1`` the human model (table A4)."""

    def __init__(self, action_size: int = 1, frames: int = 2) -> None:
        super().__init__()
        self.picture = Picture(frames)
        self.head = Head(action_size)

    def embed(self, frames: Tensor) -> Tensor:
        """float32 [batch, 256] from frames uint8 [batch, 2, 45, 80]."""
        return self.picture(frames)

    def score(self, embedded: Tensor) -> Tensor:
        """The action before tanh squashes it, [batch, n]."""
        return self.head(embedded)

    def forward(self, frames: Tensor) -> Tensor:
        """The action [batch, n] in [-1, 1] from frames uint8 [batch, 2, 45, 80]."""
        return torch.tanh(self.score(self.embed(frames)))


class Critic(nn.Module):
    """The value Q(s, a) (table A2): the action joins the picture's features.

    Args:
        action_size: length of an action.
        frames: how many of the newest frames it sees.
        action_bound: of the action's initial weights; 0: as one more feature among 1,792.
        normalised: whether the picture's share of the first connected layer, and each hidden layer,
            is normalised to mean 0 and variance 1 (layer normalisation).
    """

    def __init__(
        self,
        action_size: int = 1,
        frames: int = 2,
        action_bound: float = 0.0,
        normalised: bool = False,
    ) -> None:
        super().__init__()
        self.picture = Picture(frames, more_inputs=action_size)
        self.action = nn.Linear(action_size, HIDDEN[0], bias=False)
        bound = action_bound or (FEATURES + action_size) ** -0.5
        nn.init.uniform_(self.action.weight, -bound, bound)
        self.norm = nn.LayerNorm(HIDDEN[0]) if normalised else nn.Identity()
        self.head = Head(1, normalised)

    def embed(self, frames: Tensor) -> Tensor:
        """float32 [batch, 256] from frames uint8 [batch, 2, 45, 80], whatever the action."""
        return self.picture(frames)

    def value(self, embedded: Tensor, action: Tensor) -> Tensor:
        """Q, shape [batch], from an embedded picture [batch, 256] and actions [batch, n]."""
        return self.head(self.norm(embedded) + self.action(action)).squeeze(1)

    def forward(self, frames: Tensor, action: Tensor) -> Tensor:
        """Q, shape [batch], from frames uint8 [batch, 2, 45, 80] and actions [batch, n]."""
        return self.value(self.embed(frames), action)


class CriticPair(nn.Module):
    """The two critics of TD3, whose smaller value is believed. Arguments as ``Critic``'s."""

    def __init__(
        self,
        action_size: int = 1,
        frames: int = 2,
        action_bound: float = 0.0,
        normalised: bool = False,
    ) -> None:
        super().__init__()
        self.first = Critic(action_size, frames, action_bound, normalised)
        self.second = Critic(action_size, frames, action_bound, normalised)

    @property
    def pair(self) -> tuple[Critic, Critic]:
        """Both, in order."""
        return self.first, self.second
