"""The kernel is built where it can be, once for each source, and torch stands in elsewhere."""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from trainer.learner import kernel
from trainer.tests.test_kernel import needs_kernel

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
