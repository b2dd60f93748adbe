"""Actor, critic and human model: the convolutional networks of tables A2, A3 and A4.

Two 6x6 convolutions (6 and 16 filters), each followed by ReLU and 2x2 max pooling, then fully
connected layers of 256, 128 and 64. Frames come as uint8 and are normalised to [0, 1] (eq. 28)
inside the network, so that an exported policy needs no preprocessing. Other observations
than the paper's two frames get other features before the same connected layers: pictures of any
size those of `Convolutions`, numbers their scaled values, several entries the features of each.

Nearly all multiplications are in `Picture`: the convolutions, and the first connected layer's
product with the features. It follows the ``torch.autocast`` around it and is computed once per
picture; the rest is small, and always in single precision.
"""

import re
from functools import cache
from itertools import chain, pairwise, repeat
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import NDArray
from torch import Tensor, nn

from trainer.learner.kernel import FEATURES, FILTERS, FRAME, SIDE, trunk_features
from trainer.learner.kernel import load as load_kernel
from trainer.util import cpu_info

_INSTRUCTIONS = re.compile(r"\b(avx512_bf16|bf16)\b")
"""As Linux names them on x86-64 and on aarch64."""


@cache
def bfloat16_is_faster(device_type: str) -> bool:
    """Whether ``device_type`` (``cpu``, ``cuda``) multiplies bfloat16 faster than float32.

    An Intel processor needs its matrix unit (AMX) for that: with the vectors' bfloat16 an update
    took 84 ms, in float32 73 (``results/bench/xeon_threads_1.json`` of revision 25e9c254).
    """
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    lines = cpu_info()
    if any("GenuineIntel" in line for line in lines):
        library = load_kernel()
        return library is not None and bool(library.trunk_has_tiles())
    return any(map(_INSTRUCTIONS.search, lines))


HIDDEN = (256, 128, 64)
FRAMES_SPACE = Box(0, 255, (2, *FRAME), np.uint8)
"""The paper's observation: frames [t-1, t]."""
UNBOUNDED = 1e6  # Bounds beyond this do not set a number's scale
LEAST_SPREAD = 0.02  # Smallest spread, as a share of half of a number's range
MOST_SPREADS = 10.0  # Scaled numbers are clipped to this
SMALL_SIDE = 8  # A picture is halved until no side is longer than this


def is_picture(dtype: Any, shape: tuple[int, ...]) -> bool:
    """Whether an entry of an observation is a picture: uint8, with rows and columns."""
    return dtype == np.uint8 and len(shape) in (2, 3)


def sees_picture(space: Space[Any]) -> bool:
    """Whether an entry of an observation is a picture."""
    entries = space.values() if isinstance(space, Dict) else [space]
    return any(is_picture(entry.dtype, entry.shape or ()) for entry in entries)


def channels_last(shape: tuple[int, ...]) -> bool:
    """Whether a picture is [rows, columns, channels] instead of [channels, rows, columns]."""
    return len(shape) == 3 and shape[2] < shape[0]


def tensors(observations: NDArray[Any], device: Any = "cpu") -> list[Tensor]:
    """Return the entries of observations [n, ...] as networks take them, in their order."""
    names = observations.dtype.names
    parts = [observations[name] for name in names] if names else [observations]
    return [torch.from_numpy(np.ascontiguousarray(part)).to(device) for part in parts]


class Trunk(nn.Module):
    """The two convolutions: the newest ``frames`` of uint8 [batch, n, 45, 80] -> [batch, 1792]."""

    features = FEATURES

    def __init__(self, frames: int = 2) -> None:
        super().__init__()
        self.frames = frames
        self.conv1 = nn.Conv2d(frames, FILTERS[0], SIDE)
        self.conv2 = nn.Conv2d(FILTERS[0], FILTERS[1], SIDE)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, frames: Tensor) -> Tensor:
        first, second = self.conv1, self.conv2
        assert first.bias is not None
        assert second.bias is not None
        frames = frames[:, -self.frames :]
        return trunk_features(frames, first.weight, first.bias, second.weight, second.bias)


class Numbers(nn.Module):
    """Numbers [batch, ...] of any type to [batch, features], each scaled to about [-1, 1].

    The scale is that of the space's bounds until `fit` takes it from observations. Each of the
    ``channels`` of a grid has one scale; without channels each number has its own.
    """

    middle: Tensor
    reach: Tensor

    def __init__(self, space: Box, channels: int | None = None) -> None:
        super().__init__()
        rows = (space.low, space.high)
        low, high = (ends.astype(np.float64).reshape(channels or ends.size, -1) for ends in rows)
        self.channels, self.features = len(low), low.size
        low, high = low.min(1), high.max(1)
        bounded = (low > -UNBOUNDED) & (high < UNBOUNDED) & (low < high)
        low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
        self.least = torch.from_numpy(LEAST_SPREAD * (high - low) / 2).float()
        """Smallest spread of each number to divide by; a smaller one would amplify noise."""
        self.register_buffer("middle", torch.from_numpy((low + high) / 2).float())
        self.register_buffer("reach", torch.from_numpy((high - low) / 2).float())

    def fit(self, numbers: Tensor) -> None:
        """Scale by the mean and standard deviation of numbers [n, ...]; constants stay."""
        spread, mean = torch.std_mean(self._by_channel(numbers).double(), (0, 2))
        spread, varies = torch.maximum(spread.float(), self.least), spread > 0.0
        self.middle.copy_(torch.where(varies, mean.float(), self.middle.cpu()))
        self.reach.copy_(torch.where(varies, spread, self.reach.cpu()))

    def forward(self, numbers: Tensor) -> Tensor:
        by_channel = self._by_channel(numbers).float()
        scaled = (by_channel - self.middle[:, None]) / self.reach[:, None]
        return scaled.clamp(-MOST_SPREADS, MOST_SPREADS).flatten(1)

    def _by_channel(self, numbers: Tensor) -> Tensor:
        return numbers.reshape(-1, self.channels, self.features // self.channels)


class Convolutions(nn.Module):
    """3x3 convolutions that halve a picture of any size, or a grid of numbers, until it is small.

    Maps [batch, rows, columns], or with channels first or last, to [batch, features].
    """

    def __init__(self, space: Box) -> None:
        super().__init__()
        self.last = channels_last(space.shape)
        shape = np.roll(space.shape, 1) if self.last else (1, *space.shape)[-3:]
        self.shape = tuple(int(side) for side in shape)
        channels, *sides = self.shape
        self.numbers: Numbers | None = None
        if not is_picture(space.dtype, space.shape):
            ends = torch.from_numpy(np.stack([space.low, space.high]))
            low, high = self._channels_first(ends).numpy()
            self.numbers = Numbers(Box(low, high, dtype=space.dtype.type), channels)
        layers: list[nn.Module] = []
        for filters in chain((16,), repeat(32)):
            layers += [nn.Conv2d(channels, filters, 3, 2, 1), nn.ReLU()]
            channels, sides = filters, [(side + 1) // 2 for side in sides]
            if max(sides) <= SMALL_SIDE:
                break
        self.layers = nn.Sequential(*layers, nn.Flatten())
        self.features = channels * sides[0] * sides[1]

    def fit(self, grids: Tensor) -> None:
        if self.numbers is not None:
            self.numbers.fit(self._channels_first(grids))

    def forward(self, grids: Tensor) -> Tensor:
        grids = self._channels_first(grids)
        scaled = grids.float() / 255.0 if self.numbers is None else self.numbers(grids)
        return self.layers(scaled.reshape(-1, *self.shape))

    def _channels_first(self, grid: Tensor) -> Tensor:
        # Copied: otherwise gradients get the observation's strides, which a fused Adam mistakes for
        # the weights'.
        return grid.permute(0, 3, 1, 2).contiguous() if self.last else grid.reshape(-1, *self.shape)


class Entries(nn.Module):
    """Concatenates the features of several entries, a tensor each: [batch, features]."""

    def __init__(self, parts: list[Any]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.features = sum(part.features for part in parts)

    def forward(self, *entries: Tensor) -> Tensor:
        pairs = zip(self.parts, entries, strict=True)
        return torch.cat([part(entry).float() for part, entry in pairs], 1)


def make_trunk(space: Space[Any], frames: int) -> Any:
    """Make the layers that turn an observation, a Box or a flat Dict of such, into features."""
    if isinstance(space, Dict):
        return Entries([make_trunk(part, frames) for part in space.values()])
    assert isinstance(space, Box)
    if is_picture(space.dtype, space.shape) and space.shape == FRAMES_SPACE.shape:
        return Trunk(frames)
    if is_picture(space.dtype, space.shape) or len(space.shape) == 3:
        return Convolutions(space)
    return Numbers(space)


def fit_numbers(network: nn.Module, observations: NDArray[Any]) -> None:
    """Fit the scales of a network's input numbers to observations [n, ...]."""
    entries = tensors(observations)
    for picture in (part for part in network.modules() if isinstance(part, Picture)):
        trunk = picture.trunk
        parts = trunk.parts if isinstance(trunk, Entries) else [trunk]
        for part, entry in zip(parts, entries, strict=True):
            if not isinstance(part, Trunk):
                part.fit(entry)


class Picture(nn.Module):
    """The observation's features, and their product with the first connected layer's weights.

    Maps a tensor [batch, ...] for each entry to float32 [batch, 256], before the activation.
    ``frames`` is how many of the newest frames the network sees. The input is always the whole
    observation, so that every network is run and exported alike. ``more_inputs``, the layer's
    inputs beside the features, only scale its initial weights.
    """

    def __init__(
        self, frames: int = 2, more_inputs: int = 0, space: Space[Any] = FRAMES_SPACE
    ) -> None:
        super().__init__()
        self.frames = frames
        self.trunk = make_trunk(space, frames)
        self.layer = nn.Linear(self.trunk.features, HIDDEN[0])
        self.bound = (self.trunk.features + more_inputs) ** -0.5
        nn.init.uniform_(self.layer.weight, -self.bound, self.bound)
        nn.init.uniform_(self.layer.bias, -self.bound, self.bound)

    def forward(self, *entries: Tensor) -> Tensor:
        return self.layer(self.trunk(*entries)).float()


class Head(nn.Module):
    """The connected layers from the first one's activation on: [batch, 256] -> [batch, outputs].

    ``normalised``: layer normalisation before each hidden layer's activation. The last layer has no
    activation.
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
        return self.output(self.hidden(embedded))


class Actor(nn.Module):
    """The policy pi(s) (table A3); with ``frames=1`` the human model (table A4).

    Maps frames uint8 [batch, 2, 45, 80], or a tensor for each entry, to actions [batch, n] in
    [-1, 1].
    """

    def __init__(
        self, action_size: int = 1, frames: int = 2, space: Space[Any] = FRAMES_SPACE
    ) -> None:
        super().__init__()
        self.picture = Picture(frames, space=space)
        self.head = Head(action_size)

    def forward(self, *entries: Tensor) -> Tensor:
        return torch.tanh(self.head(self.picture(*entries)))

    @torch.no_grad()
    def act(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """Return actions float32 [batch, n] in [-1, 1] for observations [batch, ...]."""
        entries = tensors(observations, self.head.output.weight.device)
        return self(*entries).cpu().numpy()


class Critic(nn.Module):
    """The value Q(s, a) (table A2): the action joins the picture's features.

    ``frames`` is how many of the newest frames it sees, ``action_bound`` the bound of the action's
    initial weights (0: as one more feature among 1,792). ``normalised``: layer normalisation of
    `Picture`'s output and of each hidden layer.
    """

    def __init__(
        self,
        action_size: int = 1,
        frames: int = 2,
        action_bound: float = 0.0,
        normalised: bool = False,
        space: Space[Any] = FRAMES_SPACE,
    ) -> None:
        super().__init__()
        self.picture = Picture(frames, action_size, space)
        self.action = nn.Linear(action_size, HIDDEN[0], bias=False)
        bound = action_bound or self.picture.bound
        nn.init.uniform_(self.action.weight, -bound, bound)
        self.norm = nn.LayerNorm(HIDDEN[0]) if normalised else nn.Identity()
        self.head = Head(1, normalised)

    def value(self, embedded: Tensor, action: Tensor) -> Tensor:
        """Return Q [batch] from the output of ``picture`` [batch, 256] and actions [batch, n]."""
        return self.head(self.norm(embedded) + self.action(action)).squeeze(1)


class CriticPair(nn.Module):
    """The two critics of TD3; targets use the smaller value. Takes the arguments of ``Critic``."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__()
        self.first = Critic(*arguments, **named)
        self.second = Critic(*arguments, **named)

    @property
    def pair(self) -> tuple[Critic, Critic]:
        return self.first, self.second
