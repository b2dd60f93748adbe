"""The networks' two convolutions as one function in C++, built at first use; else by torch.

The system's compiler builds it into the user's cache, so that no compiler is needed to install the
package. Without a compiler, or with ``PHIL_KERNEL=0`` in the environment, torch does the work.
"""

import ctypes
import functools
import hashlib
import logging
import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.autograd.function import once_differentiable

from edge_runtime.files import write_atomic
from edge_runtime.util import UserError
from trainer.util import cpu_info

_LOGGER = logging.getLogger(__name__)
_FLAGS = ("-std=c++17", "-O3", "-march=native", "-fPIC", "-shared")
_OPENMP = "-fopenmp"
_TIMEOUT_S = 120.0  # For a build; it takes a few


@functools.cache
def load() -> ctypes.CDLL | None:
    """Return the library built from ``trunk.cpp``; None, with one warning, if it cannot be built.

    On Linux a kernel of GCC shares the OpenMP threads of torch, which is imported before it: two
    pools of threads would fight for the same cores.
    """
    if os.environ.get("PHIL_KERNEL") == "0":
        return None
    try:
        library = _built(Path(__file__).with_name("trunk.cpp"))
    except (UserError, OSError, RuntimeError, ValueError) as error:
        # RuntimeError: no home directory, hence no cache. ValueError: an open quote in $CXX.
        _LOGGER.warning(
            "no compiled trunk kernel (%s): torch does its work, several times slower",
            " ".join(str(error).split()),
        )
        return None
    pointer, threads = ctypes.c_void_p, ctypes.c_int
    pictures = (pointer, ctypes.c_int64, ctypes.c_int64, ctypes.c_int)
    library.trunk_forward.argtypes = (*pictures, *(pointer,) * 8, ctypes.c_int, threads)
    library.trunk_backward.argtypes = (*pictures, *(pointer,) * 9, ctypes.c_int, threads)
    library.trunk_forward.restype = library.trunk_backward.restype = None
    return library


def _built(source: Path) -> ctypes.CDLL:
    """Load the library for this source, compiler and processor; build it if it is not cached."""
    compiler = _compiler()
    version = _run([*compiler, "--version"]).stdout  # Newer ones use more of the processor.
    settings = *compiler, version, *_FLAGS, _OPENMP, _processor(), ""
    key = "\0".join(settings).encode() + source.read_bytes()
    library = _cache() / f"{source.stem}-{hashlib.sha256(key).hexdigest()[:16]}.so"
    if not library.exists():
        _build(compiler, source, library)
    return ctypes.CDLL(str(library))


def _build(compiler: list[str], source: Path, library: Path) -> None:
    """Compile into a temporary directory: two processes may build at once."""
    library.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent, prefix="build-") as directory:
        target = Path(directory) / library.name
        for openmp in ([_OPENMP], []):
            done = _run([*compiler, *_FLAGS, *openmp, "-o", str(target), str(source)])
            if done.returncode == 0:
                write_atomic(library, target.read_bytes())
                return
            # Without OpenMP the kernel has one thread; no other fault is tried again.
            if not re.search(r"fopenmp|[lg]omp", done.stderr):
                break
    errors = (line for line in done.stderr.splitlines() if "error" in line)
    raise UserError(f"{compiler[0]} failed: {next(errors, f'status {done.returncode}')}")


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            command, capture_output=True, text=True, errors="replace",
            timeout=_TIMEOUT_S, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(f"{command[0]} cannot be run: {error}") from error


def _compiler() -> list[str]:
    """Return the command of the C++ compiler: ``$CXX``, or the first that is installed."""
    installed = [[name] for name in ("c++", "g++", "clang++") if shutil.which(name)]
    for command in (shlex.split(os.environ.get("CXX", "")), *installed):
        if command:
            return command
    raise UserError("there is no C++ compiler; a package such as g++ or clang brings one")


def _processor() -> str:
    """Describe the instruction set: several machines may share a home, and so the cache."""
    wanted = ("model name", "flags", "features", "cpu part")
    known = dict.fromkeys(line for line in cpu_info() if line.lower().startswith(wanted))
    return "\n".join([platform.machine(), platform.processor(), *known])


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "phil-hil"


FRAME = (45, 80)
FILTERS, SIDE = (6, 16), 6  # Of both convolutions; and the side of their kernels
FEATURES = 1792  # 16 filters of 7 x 16: what two convolutions and poolings leave of a picture


def trunk_features(
    frames: Tensor,
    conv1_weight: Tensor,
    conv1_bias: Tensor,
    conv2_weight: Tensor,
    conv2_bias: Tensor,
) -> Tensor:
    """Compute the features: normalisation, and twice convolution, 2x2 max pooling and ReLU.

    Differentiable once with respect to the parameters. The compiled kernel serves the networks of
    this project on the CPU; anything else, and every export, takes the torch operations. Under
    ``torch.autocast`` the kernel multiplies in bfloat16 where the processor can, backward only with
    a matrix unit; its sums, features and gradients stay in single precision. The torch operations
    follow autocast's own rules, which round features too.

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
    if not _is_supported(frames, parameters):
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


def _is_supported(frames: Tensor, parameters: tuple[Tensor, ...]) -> bool:
    """Whether the compiled kernel can compute these features."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing() or torch.onnx.is_in_onnx_export():
        return False
    shapes = (
        (FILTERS[0], frames.shape[1], SIDE, SIDE),
        (FILTERS[0],),
        (FILTERS[1], FILTERS[0], SIDE, SIDE),
        (FILTERS[1],),
    )
    kinds = [(each.dtype, each.device.type, tuple(each.shape)) for each in parameters]
    return (
        (frames.dtype, frames.device.type) == (torch.uint8, "cpu")
        and frames.shape[1:] in ((1, *FRAME), (2, *FRAME))
        and kinds == [(torch.float32, "cpu", shape) for shape in shapes]
        and load() is not None
    )


def _in_place(frames: Tensor) -> Tensor:
    """Return the frames, copied only if a picture's frames are not contiguous."""
    rows, columns = FRAME
    return frames if frames.stride()[1:] == (rows * columns, columns, 1) else frames.contiguous()


def _channels_innermost(weight: Tensor) -> Tensor:
    """Return the weight as [filter, row, column, channel]; a copy unless it is channels-last."""
    return weight.detach().permute(0, 2, 3, 1).contiguous()


def _pictures(frames: Tensor) -> tuple[int, int, int, int]:
    return frames.data_ptr(), frames.stride(0), frames.shape[0], frames.shape[1]


def _forward(
    frames: Tensor, parameters: tuple[Tensor, ...], saved: tuple[Tensor | None, ...]
) -> Tensor:
    """Compute the features, and fill ``saved`` (hidden, winners1, winners2) unless None."""
    library = load()
    assert library is not None
    weight1, bias1, weight2, bias2 = parameters
    # In variables, so that copies live until the kernel is done.
    kernels = _channels_innermost(weight1), _channels_innermost(weight2)
    inputs = kernels[0], bias1.contiguous(), kernels[1], bias2.contiguous()
    features = torch.empty(frames.shape[0], FEATURES)
    library.trunk_forward(
        *_pictures(frames),
        *(tensor.data_ptr() for tensor in inputs),
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
        library = load()
        assert library is not None
        frames = _in_place(frames)
        images = frames.shape[0]
        hidden = torch.empty(images, library.trunk_hidden())
        winners1 = torch.empty(images, library.trunk_hidden(), dtype=torch.uint8)
        winners2 = torch.empty(images, library.trunk_outputs(), dtype=torch.uint8)
        ctx.save_for_backward(frames, parameters[2], hidden, winners1, winners2)
        ctx.reduced = torch.is_autocast_enabled("cpu")
        return _forward(frames, parameters, (hidden, winners1, winners2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        library = load()
        assert library is not None
        frames, weight2, *saved = ctx.saved_tensors
        inputs = (_channels_innermost(weight2), *saved, gradients[0].contiguous())
        results = (
            torch.empty(FILTERS[0], SIDE, SIDE, frames.shape[1]),
            torch.empty(FILTERS[0]),
            torch.empty(FILTERS[1], SIDE, SIDE, FILTERS[0]),
            torch.empty(FILTERS[1]),
        )
        library.trunk_backward(
            *_pictures(frames),
            *(tensor.data_ptr() for tensor in (*inputs, *results)),
            ctx.reduced,
            torch.get_num_threads(),
        )
        weight1, bias1, weight2, bias2 = results
        return None, weight1.permute(0, 3, 1, 2), bias1, weight2.permute(0, 3, 1, 2), bias2
