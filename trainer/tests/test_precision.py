import pytest

from trainer.learner import precision
from trainer.learner.algorithms import PHIL
from trainer.learner.config import LearnerConfig
from trainer.learner.td3 import TD3Learner
from trainer.tests.test_td3 import make_batch, weights_of


@pytest.fixture
def processor(tmp_path, monkeypatch):
    """Pretend to have a processor of these flags."""

    def pretend(text: str) -> None:
        info = tmp_path / "cpuinfo"
        info.write_text(text)
        monkeypatch.setattr(precision, "CPU_INFO", info)
        precision.multiplies_bfloat16.cache_clear()

    yield pretend
    precision.multiplies_bfloat16.cache_clear()


@pytest.mark.parametrize(
    ("flags", "multiplies"),
    [
        ("flags : fma avx2 avx512f avx512_bf16 avx512_vnni", True),
        ("Features : fp asimd i8mm bf16", True),
        ("flags : fma avx2 avx512f", False),
        ("Features : fp asimd ebf16x", False),
        ("", False),
    ],
)
def test_the_processors_flags_decide(processor, flags, multiplies):
    processor(flags)
    assert precision.multiplies_bfloat16("cpu") == multiplies


def test_without_a_list_of_flags_there_is_none(processor, monkeypatch, tmp_path):
    processor("")
    monkeypatch.setattr(precision, "CPU_INFO", tmp_path / "none")
    assert not precision.multiplies_bfloat16("cpu")


def test_a_processor_without_bfloat16_learns_in_float32(processor):
    processor("flags : fma avx2")
    learners = [
        TD3Learner(LearnerConfig(batch_size=12, precision=name), PHIL, seed=0)
        for name in ("float32", "bfloat16")
    ]
    for learner in learners:
        learner.update(make_batch())
    single, reduced = map(weights_of, learners)
    assert all((single[name] == reduced[name]).all() for name in single)
