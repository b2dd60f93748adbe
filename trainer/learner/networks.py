"""Actor, critic and human model: the convolutional networks of tables A2, A3 and A4.

Two 6x6 convolutions (6 and 16 filters), each followed by ReLU and 2x2 max pooling, then fully
connected layers of 256, 128 and 64. Frames come as uint8 and are normalised to [0, 1] (eq. 28)
inside the network, so that an exported policy needs no preprocessing.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trainer.learner.kernel.trunk import trunk_features

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


class Head(nn.Module):
    """The fully connected layers: features [batch, inputs] to [batch, outputs]."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in HIDDEN:
            layers += [nn.Linear(inputs, width), nn.ReLU()]
            inputs = width
        self.hidden = nn.Sequential(*layers)
        self.output = nn.Linear(inputs, outputs)

    def forward(self, features: Tensor) -> Tensor:
        """The last layer's values, without an activation."""
        return self.output(self.hidden(features))


class Actor(nn.Module):
    """The policy pi(s) (table A3); with ``frames=1`` the human model (table A4).

    The policy's input is always the observation [batch, 2, 45, 80]; a network of one frame takes
    the newest one, so that every policy is run and exported in the same way.
    """

    def __init__(self, action_size: int = 1, frames: int = 2) -> None:
        super().__init__()
        self.frames = frames
        self.trunk = Trunk(frames)
        self.head = Head(FEATURES, action_size)

    def forward(self, frames: Tensor) -> Tensor:
        """The action [batch, n] in [-1, 1] from frames uint8 [batch, 2, 45, 80]."""
        return torch.tanh(self.head(self.trunk(frames[:, -self.frames :])))


class Critic(nn.Module):
    """The value Q(s, a) (table A2): the action joins the picture's features."""

    def __init__(self, action_size: int = 1, frames: int = 2) -> None:
        super().__init__()
        self.frames = frames
        self.trunk = Trunk(frames)
        self.head = Head(FEATURES + action_size, 1)

    def features(self, frames: Tensor) -> Tensor:
        """The picture's features: independent of the action, so computed once a picture."""
        return self.trunk(frames[:, -self.frames :])

    def value(self, features: Tensor, action: Tensor) -> Tensor:
        """Q, shape [batch], from features [batch, 1792] and actions [batch, n]."""
        return self.head(torch.cat([features, action], dim=1)).squeeze(1)

    def forward(self, frames: Tensor, action: Tensor) -> Tensor:
        """Q, shape [batch], from frames uint8 [batch, 2, 45, 80] and actions [batch, n]."""
        return self.value(self.features(frames), action)


class CriticPair(nn.Module):
    """The two critics of TD3, whose smaller value is believed."""

    def __init__(self, action_size: int = 1, frames: int = 2) -> None:
        super().__init__()
        self.first = Critic(action_size, frames)
        self.second = Critic(action_size, frames)

    @property
    def pair(self) -> tuple[Critic, Critic]:
        """Both, in order."""
        return self.first, self.second
