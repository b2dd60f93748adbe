"""The networks' two convolutions as one function: compiled where possible, else by torch."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.autograd.function import once_differentiable

from trainer.learner import kernel

_FRAME = (45, 80)
_FILTERS1, _FILTERS2, _SIDE = 6, 16, 6
_FEATURES = 1792


def trunk_features(
    frames: Tensor,
    conv1_weight: Tensor,
    conv1_bias: Tensor,
    conv2_weight: Tensor,
    conv2_bias: Tensor,
) -> Tensor:
    """The features of pictures: normalisation, and twice convolution, 2x2 max pooling and ReLU.

    Differentiable once with respect to the parameters. The compiled kernel serves the networks of
    this project on the CPU; anything else, and every export, takes the torch operations.
    Under ``torch.autocast`` the kernel's forward pass multiplies in bfloat16, where the processor
    can; its sums, features and gradients stay in single precision. The torch operations follow
    autocast's own rules, which round features too.

    Args:
        frames: uint8 [batch, n, 45, 80] with n = 1 or 2. A slice of a longer stack of frames,
            such as ``pictures[:, 1:]``, is read where it lies.
        conv1_weight: [6, n, 6, 6].
        conv1_bias: [6].
        conv2_weight: [16, 6, 6, 6].
        conv2_bias: [16].

    Returns:
        [batch, 1792], in the order of ``torch.flatten`` over [batch, 16, 7, 16]: float32 from the
        kernel; from torch the parameters' type, or autocast's.
    """
    parameters = (conv1_weight, conv1_bias, conv2_weight, conv2_bias)
    if not _served(frames, parameters):
        return _torch_features(frames, *parameters)
    if torch.is_grad_enabled() and any(parameter.requires_grad for parameter in parameters):
        return _Trunk.apply(frames, *parameters)
    return _forward(_in_place(frames), parameters, saved=(None, None, None))


def _torch_features(
    frames: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor
) -> Tensor:
    images = (frames.to(weight1.dtype) / 255.0).contiguous(memory_format=torch.channels_last)
    # Pooling before ReLU gives the same numbers and a quarter of the ReLU's work.
    hidden = functional.relu(functional.max_pool2d(functional.conv2d(images, weight1, bias1), 2))
    hidden = functional.relu(functional.max_pool2d(functional.conv2d(hidden, weight2, bias2), 2))
    return torch.flatten(hidden, 1)


def _served(frames: Tensor, parameters: tuple[Tensor, ...]) -> bool:
    """Whether the kernel can do it."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing() or torch.onnx.is_in_onnx_export():
        return False
    shapes: tuple[tuple[int, ...], ...] = (
        (_FILTERS1, frames.shape[1], _SIDE, _SIDE),
        (_FILTERS1,),
        (_FILTERS2, _FILTERS1, _SIDE, _SIDE),
        (_FILTERS2,),
    )
    return (
        frames.dtype == torch.uint8
        and frames.device.type == "cpu"
        and frames.shape[1:] in ((1, *_FRAME), (2, *_FRAME))
        and all(
            parameter.dtype == torch.float32
            and parameter.device.type == "cpu"
            and parameter.shape == shape
            for parameter, shape in zip(parameters, shapes, strict=True)
        )
        and _library() is not None
    )


@functools.cache
def _library() -> ctypes.CDLL | None:
    library = kernel.load("trunk")
    if library is not None:
        pointer, threads = ctypes.c_void_p, ctypes.c_int
        pictures = (pointer, ctypes.c_int64, ctypes.c_int64, ctypes.c_int)
        library.trunk_forward.argtypes = (*pictures, *(pointer,) * 8, ctypes.c_int, threads)
        library.trunk_backward.argtypes = (*pictures, *(pointer,) * 9, threads)
        library.trunk_forward.restype = library.trunk_backward.restype = None
    return library


def _in_place(frames: Tensor) -> Tensor:
    """The frames, copied only if a picture's own frames do not lie one after the other."""
    rows, columns = _FRAME
    return frames if frames.stride()[1:] == (rows * columns, columns, 1) else frames.contiguous()


def _channels_innermost(weight: Tensor) -> Tensor:
    """[filter, row, column, channel]: a copy only if the weight is not channels-last already."""
    return weight.detach().permute(0, 2, 3, 1).contiguous()


def _pictures(frames: Tensor) -> tuple[int, int, int, int]:
    return frames.data_ptr(), frames.stride(0), frames.shape[0], frames.shape[1]


def _forward(
    frames: Tensor, parameters: tuple[Tensor, ...], saved: tuple[Tensor | None, ...]
) -> Tensor:
    """The features; ``saved`` (hidden, winners1, winners2) is filled unless it is of None."""
    library = _library()
    assert library is not None
    weight1, bias1, weight2, bias2 = parameters
    # Named, so that copies live until the kernel is done.
    given = (
        _channels_innermost(weight1),
        bias1.contiguous(),
        _channels_innermost(weight2),
        bias2.contiguous(),
    )
    features = torch.empty(frames.shape[0], _FEATURES)
    library.trunk_forward(
        *_pictures(frames),
        *(tensor.data_ptr() for tensor in given),
        features.data_ptr(),
        *(None if tensor is None else tensor.data_ptr() for tensor in saved),
        torch.is_autocast_enabled("cpu"),
        torch.get_num_threads(),
    )
    return features


class _Trunk(torch.autograd.Function):
    """The kernel with its gradient."""

    @staticmethod
    def forward(ctx: Any, frames: Tensor, *parameters: Tensor) -> Tensor:
        library = _library()
        assert library is not None
        frames = _in_place(frames)
        images = frames.shape[0]
        hidden = torch.empty(images, library.trunk_hidden())
        winners1 = torch.empty(images, library.trunk_hidden(), dtype=torch.uint8)
        winners2 = torch.empty(images, library.trunk_outputs(), dtype=torch.uint8)
        ctx.save_for_backward(frames, parameters[2], hidden, winners1, winners2)
        return _forward(frames, parameters, (hidden, winners1, winners2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        library = _library()
        assert library is not None
        frames, weight2, *saved = ctx.saved_tensors
        given = (_channels_innermost(weight2), *saved, gradients[0].contiguous())
        results = (
            torch.empty(_FILTERS1, _SIDE, _SIDE, frames.shape[1]),
            torch.empty(_FILTERS1),
            torch.empty(_FILTERS2, _SIDE, _SIDE, _FILTERS1),
            torch.empty(_FILTERS2),
        )
        library.trunk_backward(
            *_pictures(frames),
            *(tensor.data_ptr() for tensor in (*given, *results)),
            torch.get_num_threads(),
        )
        weight1, bias1, weight2, bias2 = results
        return None, weight1.permute(0, 3, 1, 2), bias1, weight2.permute(0, 3, 1, 2), bias2
