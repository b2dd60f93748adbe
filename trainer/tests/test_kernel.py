"""The compiled kernel against torch in double precision, and how it is built."""

import platform
import shutil
from typing import Any

import pytest
import torch

from trainer.learner import kernel
from trainer.learner.kernel import trunk_features

needs_x86 = pytest.mark.skipif(
    platform.machine() != "x86_64", reason="the flags are those of x86-64"
)
# Asks for a compiler only: a kernel that no longer compiles fails, and is not skipped.
needs_kernel = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="there is no compiler here"
)


def _pictures(batch):
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (batch, 3, 45, 80), dtype=torch.uint8, generator=generator)


def _parameters(frames):
    """As torch initialises them, channels last like the networks' own."""
    torch.manual_seed(0)
    last: Any = {"memory_format": torch.channels_last}
    layers = torch.nn.Conv2d(frames, 6, 6).to(**last), torch.nn.Conv2d(6, 16, 6).to(**last)
    return [each.detach().requires_grad_() for layer in layers for each in layer.parameters()]


def _gradients(frames, parameters, slopes, reduced=False):
    with torch.autocast("cpu", torch.bfloat16, enabled=reduced):
        features = trunk_features(frames, *parameters)
    return features.detach(), torch.autograd.grad(features, parameters, slopes.to(features.dtype))


def _slopes(batch):
    return torch.randn(batch, 1792, generator=torch.Generator().manual_seed(1))


def _check(frames, parameters):
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
@pytest.mark.parametrize("batch", [1, 7, 33])
@pytest.mark.parametrize("frames", [slice(0, 2), slice(1, 3), slice(2, 3)])
def test_features_and_gradients_are_those_of_torch(batch, frames):
    pictures = _pictures(batch)[:, frames]
    _check(pictures, _parameters(pictures.shape[1]))


@needs_kernel
@pytest.mark.parametrize("level", [0, 128])
def test_ties_go_to_the_first_position_as_in_torch_in_reduced_precision_too(level):
    """Everywhere the four candidates of a pooling are equal."""
    pictures, parameters = torch.full((3, 2, 45, 80), level, dtype=torch.uint8), _parameters(2)
    _check(pictures, parameters)
    _, (right, *_) = _gradients(pictures, parameters, _slopes(3))
    _, (gradient, *_) = _gradients(pictures, parameters, _slopes(3), reduced=True)
    assert (gradient - right).norm() <= 0.02 * right.norm()


@needs_kernel
@pytest.mark.parametrize("reduced", [False, True])
def test_nothing_passes_where_relu_is_off_and_what_is_no_number_is_not_hidden(reduced):
    parameters = _parameters(2)
    off, wild = (torch.full((n,), value) for n, value in ((16, -1e6), (6, torch.nan)))
    closed = [*parameters[:3], off.requires_grad_()]
    features, gradients = _gradients(_pictures(2)[:, :2], closed, _slopes(2), reduced)
    assert not any(each.any() for each in (features, *gradients))
    parameters[1] = wild
    with torch.autocast("cpu", torch.bfloat16, enabled=reduced):
        assert trunk_features(_pictures(1)[:, :2], *parameters).isnan().all()


@needs_kernel
@pytest.mark.parametrize("reduced", [False, True])
@pytest.mark.parametrize("frames", [slice(1, 3), slice(2, 3)])
def test_threads_change_nothing_and_reduced_precision_little(frames, reduced, one_thread):
    pictures, slopes = _pictures(45)[:, frames], _slopes(45)
    parameters = _parameters(pictures.shape[1])
    right, right_gradients = _gradients(pictures, parameters, slopes)
    first, first_gradients = _gradients(pictures, parameters, slopes, reduced)
    library = kernel.load()
    assert library is not None
    assert first.dtype == torch.float32
    assert torch.equal(first, right) != (reduced and library.trunk_has_bfloat16())
    for threads in (2, 3):
        torch.set_num_threads(threads)
        features, gradients = _gradients(pictures, parameters, slopes, reduced)
        assert torch.equal(features, first)
        assert all(map(torch.equal, gradients, first_gradients))
    # bfloat16 keeps 8 bits of each factor, and its errors average out in the sums.
    assert (first - right).norm() < 0.01 * right.norm()
    for gradient, exact in zip(first_gradients, right_gradients, strict=True):
        # A rounded value may win its pooling where it did not before.
        assert (gradient - exact).norm() < 0.2 * exact.norm()


@pytest.fixture
def anew(tmp_path, monkeypatch):
    """Has this process look for its kernel once more: in another environment, with a new cache."""

    def load(**environment):
        settings = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "PHIL_KERNEL": "1", **environment}
        for name, value in settings.items():
            monkeypatch.setenv(name, value)
        kernel.load.cache_clear()
        return kernel.load()

    yield load
    kernel.load.cache_clear()


@pytest.mark.parametrize("compiler", ["/bin/false", "/no/such/compiler", None])
def test_without_a_compiler_or_a_cache_torch_does_the_work(tmp_path, anew, compiler, caplog):
    if compiler is None:
        (tmp_path / "cache").write_text("in the way of a directory")
    environment = {"CXX": compiler} if compiler else {}
    assert anew(**environment) is None
    for _ in range(2):
        _check(_pictures(5)[:, :2], _parameters(2))
    (told,) = caplog.records
    assert told.levelname == "WARNING"
    assert list(tmp_path.rglob("*.so")) == []
    # It can also be turned off.
    assert anew(PHIL_KERNEL="0", **environment) is None
    assert len(caplog.records) == 1


@needs_kernel
@needs_x86
def test_processors_with_shorter_vectors_compute_the_same(anew, caplog):
    """Also: without bfloat16 instructions, reduced precision is single precision."""
    assert anew(CXX="c++ -mno-avx512f -mno-avx") is not None
    pictures, parameters = _pictures(5)[:, :2], _parameters(2)
    _check(pictures, parameters)
    single, reduced = (_gradients(pictures, parameters, _slopes(5), it) for it in (False, True))
    assert all(map(torch.equal, (single[0], *single[1]), (reduced[0], *reduced[1])))
    assert caplog.records == []
