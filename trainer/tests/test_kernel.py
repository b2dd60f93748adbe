import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import onnx
import pytest
import torch
from torch import Tensor

from trainer.learner import kernel
from trainer.learner import kernel as trunk
from trainer.learner.kernel import trunk_features
from trainer.learner.networks import multiplies_bfloat16

needs_kernel = pytest.mark.skipif(
    kernel.load("trunk") is None, reason="there is no compiler here, or PHIL_KERNEL=0"
)


def _pictures(batch: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (batch, 3, 45, 80), dtype=torch.uint8, generator=generator)


def _parameters(frames: int, seed: int = 0) -> list[Tensor]:
    """As torch initialises them, channels last like the networks' own."""
    torch.manual_seed(seed)
    return [
        parameter.detach().requires_grad_()
        for layer in (torch.nn.Conv2d(frames, 6, 6), torch.nn.Conv2d(6, 16, 6))
        for parameter in (layer.weight.to(memory_format=torch.channels_last), layer.bias)
        if parameter is not None
    ]


def _gradients(
    frames: Tensor, parameters: list[Tensor], slopes: Tensor
) -> tuple[Tensor, tuple[Tensor, ...]]:
    features = trunk_features(frames, *parameters)
    return features.detach(), torch.autograd.grad(features, parameters, slopes.to(features.dtype))


def _slopes(batch: int) -> Tensor:
    return torch.randn(batch, 1792, generator=torch.Generator().manual_seed(1))


def _check(frames: Tensor, parameters: list[Tensor]) -> None:
    """Features and gradients against the torch path in double precision."""
    slopes = _slopes(len(frames))
    features, gradients = _gradients(frames, parameters, slopes)
    exact = [parameter.detach().double().requires_grad_() for parameter in parameters]
    right_features, right_gradients = _gradients(frames, exact, slopes)
    assert features.dtype == torch.float32
    torch.testing.assert_close(features.double(), right_features, rtol=1e-5, atol=2e-6)
    for gradient, right in zip(gradients, right_gradients, strict=True):
        scale = right.abs().max().item()
        torch.testing.assert_close(gradient.double(), right, rtol=0, atol=3e-6 * scale)


@needs_kernel
@pytest.mark.parametrize("batch", [1, 2, 7, 8, 9, 33])
@pytest.mark.parametrize("frames", [slice(0, 2), slice(1, 3), slice(2, 3)])
def test_features_and_gradients_are_those_of_torch(batch: int, frames: slice) -> None:
    pictures = _pictures(batch)[:, frames]
    _check(pictures, _parameters(pictures.shape[1]))


@needs_kernel
def test_any_memory_layout_will_do() -> None:
    pictures = _pictures(8)[::2, [2, 0]].transpose(2, 3).contiguous().transpose(2, 3)
    parameters = [parameter.detach().contiguous() for parameter in _parameters(2)]
    _check(pictures, [parameter.requires_grad_() for parameter in parameters])


@needs_kernel
def test_without_gradients_the_features_are_the_same() -> None:
    frames, parameters = _pictures(5)[:, :2], _parameters(2)
    with torch.no_grad():
        features = trunk_features(frames, *parameters)
    assert not features.requires_grad
    assert torch.equal(features, trunk_features(frames, *parameters))


@needs_kernel
@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_ties_go_to_the_first_position_as_in_torch(level: int) -> None:
    # Everywhere the four candidates of a pooling are equal.
    _check(torch.full((3, 2, 45, 80), level, dtype=torch.uint8), _parameters(2))


@needs_kernel
def test_nothing_passes_where_relu_is_off() -> None:
    weight1, bias1, weight2, _ = _parameters(1)
    off = torch.full((16,), -1e6, requires_grad=True)
    features, gradients = _gradients(
        _pictures(2)[:, :1], [weight1, bias1, weight2, off], _slopes(2)
    )
    assert not features.any()
    assert not any(gradient.any() for gradient in gradients)


@needs_kernel
def test_the_number_of_threads_does_not_matter() -> None:
    frames, parameters, slopes = _pictures(45)[:, 1:], _parameters(2), _slopes(45)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(_gradients(frames, parameters, slopes))
    finally:
        torch.set_num_threads(before)
    first_features, first_gradients = results[0]
    for features, gradients in results[1:]:
        assert torch.equal(features, first_features)
        for gradient, first in zip(gradients, first_gradients, strict=True):
            assert torch.equal(gradient, first)


@needs_kernel
def test_not_a_number_is_not_hidden() -> None:
    parameters = _parameters(2)
    parameters[1] = torch.full((6,), float("nan"))
    assert trunk_features(_pictures(1)[:, :2], *parameters).isnan().all()


@needs_kernel
@pytest.mark.parametrize("frames", [slice(0, 2), slice(2, 3)])
def test_reduced_precision_is_near_and_does_not_depend_on_threads(frames: slice) -> None:
    pictures = _pictures(9)[:, frames]
    parameters, slopes = _parameters(pictures.shape[1]), _slopes(9)
    right_features, right_gradients = _gradients(pictures, parameters, slopes)
    before = torch.get_num_threads()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        with torch.autocast("cpu", torch.bfloat16):
            features = trunk_features(pictures, *parameters)
        gradients = torch.autograd.grad(features, parameters, slopes)
        torch.set_num_threads(before)
        if threads == 1:
            first_features, first_gradients = features, gradients
        assert torch.equal(features, first_features)
        assert all(map(torch.equal, gradients, first_gradients))
    # bfloat16 keeps 8 bits of each factor, and its errors average out in the sums.
    assert (features - right_features).norm() < 0.01 * right_features.norm()
    for gradient, right in zip(gradients, right_gradients, strict=True):
        # A rounded value may win its pooling where it did not before.
        assert (gradient - right).norm() < 0.2 * right.norm()


@needs_kernel
@pytest.mark.parametrize("frames", [slice(0, 2), slice(2, 3)])
def test_reduced_precision_is_bfloat16_where_the_processor_has_it(frames: slice) -> None:
    if not multiplies_bfloat16("cpu"):
        pytest.skip("the processor has no bfloat16 instructions")
    library = kernel.load("trunk")
    assert library is not None
    if not library.trunk_has_bfloat16():
        pytest.skip("the kernel was compiled without bfloat16")
    pictures = _pictures(2)[:, frames]
    parameters = _parameters(pictures.shape[1])
    single = trunk_features(pictures, *parameters)
    with torch.autocast("cpu", torch.bfloat16):
        reduced = trunk_features(pictures, *parameters)
    assert reduced.dtype == torch.float32
    assert not torch.equal(reduced, single)


@needs_kernel
@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_in_reduced_precision_ties_stay_ties(level: int) -> None:
    """The first of equal candidates wins, so a flat picture sends each gradient the same way."""
    pictures, parameters = torch.full((1, 2, 45, 80), level, dtype=torch.uint8), _parameters(2)
    _, (right, *_) = _gradients(pictures, parameters, _slopes(1))
    with torch.autocast("cpu", torch.bfloat16):
        features = trunk_features(pictures, *parameters)
    (gradient,) = torch.autograd.grad(features, parameters[:1], _slopes(1))
    assert (gradient - right).norm() <= 0.02 * right.norm()


def test_an_empty_batch() -> None:
    assert trunk_features(_pictures(0)[:, :2], *_parameters(2)).shape == (0, 1792)


class _Network(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.items = torch.nn.ParameterList(_parameters(2))

    def forward(self, frames: Tensor) -> Tensor:
        return trunk_features(frames, *self.items)


@needs_kernel
def test_exports_hold_torch_operations() -> None:
    frames, network = _pictures(2)[:, :2], _Network()
    exported = torch.export.export(network, (frames,))
    assert "conv2d" in str(exported.graph)
    torch.testing.assert_close(exported.module()(frames), network(frames))


@needs_kernel
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_onnx_holds_torch_operations(tmp_path: Path) -> None:
    file = tmp_path / "network.onnx"
    torch.onnx.export(_Network(), (_pictures(2)[:, :2],), str(file), dynamo=False)
    assert [node.op_type for node in onnx.load(file).graph.node].count("Conv") == 2


def test_other_pictures_take_the_torch_path() -> None:
    weight1, bias1, *second = _parameters(3)
    features = trunk_features(_pictures(2), weight1, bias1, *second)
    right = trunk._torch_features(_pictures(2), weight1, bias1, *second)
    assert torch.equal(features, right)


_PROGRAM = """
import torch
from trainer.learner import kernel
from trainer.learner.kernel import trunk_features
frames = torch.zeros(2, 1, 45, 80, dtype=torch.uint8)
features = trunk_features(
    frames, torch.ones(6, 1, 6, 6), torch.ones(6), torch.ones(16, 6, 6, 6), torch.zeros(16)
)
assert (features == 216).all(), features
trunk_features(
    frames, torch.ones(6, 1, 6, 6), torch.ones(6), torch.ones(16, 6, 6, 6), torch.zeros(16)
)
print("kernel" if kernel.load("trunk") else "torch")
"""


def _start(cache: Path, program: str = _PROGRAM, **environment: str) -> subprocess.Popen[str]:
    settings = {**os.environ, "XDG_CACHE_HOME": str(cache), "PHIL_KERNEL": "1", **environment}
    return subprocess.Popen(
        [sys.executable, "-c", program],
        env=settings,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _finish(process: subprocess.Popen[str]) -> tuple[str, str]:
    output, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    return output.strip(), errors


@pytest.mark.parametrize("compiler", ["/bin/false", "/no/such/compiler"])
def test_without_a_compiler_torch_does_the_work(tmp_path: Path, compiler: str) -> None:
    output, errors = _finish(_start(tmp_path, CXX=compiler))
    assert output == "torch"
    assert len(errors.splitlines()) == 1
    assert "several times slower" in errors
    assert list(tmp_path.rglob("*.so")) == []


def test_the_kernel_can_be_turned_off(tmp_path: Path) -> None:
    assert _finish(_start(tmp_path, PHIL_KERNEL="0")) == ("torch", "")


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way of a directory")
    output, errors = _finish(_start(blocked))
    assert output == "torch"
    assert len(errors.splitlines()) == 1


_ON_ANOTHER_PROCESSOR = """
import torch
from trainer.learner import kernel
from trainer.learner.kernel import _torch_features, trunk_features
frames = torch.randint(0, 256, (5, 2, 45, 80), dtype=torch.uint8)
layers = torch.nn.Conv2d(2, 6, 6), torch.nn.Conv2d(6, 16, 6)
parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
right = _torch_features(frames, *parameters)
wanted = torch.autograd.grad(right.square().sum(), parameters)
for reduced in (False, True):
    with torch.autocast("cpu", torch.bfloat16, enabled=reduced):
        features = trunk_features(frames, *parameters)
    torch.testing.assert_close(features, right, rtol=1e-4, atol=1e-5)
    for gradient, true in zip(torch.autograd.grad(features.square().sum(), parameters), wanted):
        assert (gradient - true).norm() < 1e-4 * true.norm()
print("kernel" if kernel.load("trunk") else "torch")
"""


@needs_kernel
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the flags are those of x86-64")
@pytest.mark.parametrize("flags", ["-mno-avx512f", "-mno-avx512f -mno-avx"])
def test_processors_with_shorter_vectors_compute_the_same(tmp_path: Path, flags: str) -> None:
    """Also: without bfloat16 instructions, reduced precision is single precision."""
    process = _start(tmp_path, _ON_ANOTHER_PROCESSOR, CXX=f"c++ {flags}")
    assert _finish(process) == ("kernel", "")


@pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="there is no compiler here"
)
def test_two_processes_may_build_at_once(tmp_path: Path) -> None:
    # Asks for a compiler only: a kernel that no longer compiles fails here, and is not skipped.
    processes = [_start(tmp_path) for _ in range(2)]
    assert [_finish(process) for process in processes] == [("kernel", "")] * 2
    assert [path.suffix for path in (tmp_path / "phil-hil").iterdir()] == [".so"]


@needs_kernel
def test_a_changed_source_is_built_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    source = tmp_path / "answer.cpp"

    def answer(number: int) -> int:
        source.write_text(f'extern "C" int answer() {{ return {number}; }}\n')
        return int(kernel._built(source).answer())

    assert [answer(6), answer(7)] == [6, 7]
    # What was built before is found again.
    monkeypatch.setattr(kernel, "_build", lambda *arguments: pytest.fail("built again"))
    assert answer(6) == 6
