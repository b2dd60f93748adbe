from collections import Counter

import pytest
import torch

from trainer.learner import networks
from trainer.learner.config import PHIL, LearnerConfig
from trainer.learner.networks import Picture
from trainer.learner.td3 import TD3Learner
from trainer.tests.test_td3 import make_batch, weights_of


@pytest.fixture
def processor(tmp_path, monkeypatch):
    """Pretend to have a processor of these flags; None: there is no list of them."""

    def pretend(text):
        info = tmp_path / "cpuinfo"
        if text is not None:
            info.write_text(text)
        monkeypatch.setattr(networks, "CPU_INFO", info)
        networks.multiplies_bfloat16.cache_clear()

    yield pretend
    networks.multiplies_bfloat16.cache_clear()


@pytest.mark.parametrize(
    ("flags", "multiplies"),
    [
        ("flags : fma avx2 avx512f avx512_bf16 avx512_vnni", True),
        ("Features : fp asimd i8mm bf16", True),
        ("flags : fma avx2 avx512f", False),
        ("Features : fp asimd ebf16x", False),
        ("", False),
        (None, False),
    ],
)
def test_the_processors_flags_decide(processor, flags, multiplies):
    processor(flags)
    assert networks.multiplies_bfloat16("cpu") == multiplies


def updated():
    """The weights after one update, in float32 and in bfloat16."""
    for name in ("float32", "bfloat16"):
        learner = TD3Learner(LearnerConfig(batch_size=12, precision=name), PHIL, seed=0)
        learner.update(make_batch())
        yield weights_of(learner)


def test_a_processor_without_bfloat16_learns_in_float32(processor):
    processor("flags : fma avx2")
    single, reduced = updated()
    assert all((single[name] == reduced[name]).all() for name in single)


@pytest.mark.skipif(
    not networks.multiplies_bfloat16("cpu"), reason="this processor has no bfloat16"
)
def test_a_processor_with_bfloat16_learns_in_it():
    single, reduced = updated()
    for name in ("actor", "critics"):
        assert not torch.equal(single[name], reduced[name])


@pytest.mark.parametrize("name", ["float32", "bfloat16"])
def test_every_picture_of_an_update_is_embedded_in_its_precision(processor, monkeypatch, name):
    """Online and target networks alike, the Q advantage's too; acting is always float32."""
    processor("flags : avx512_bf16")
    embed, reduced = Picture.forward, []

    def spy(self, frames):
        reduced.append((self, torch.is_autocast_enabled("cpu")))
        with torch.autocast("cpu", enabled=False):  # whatever this processor can do
            return embed(self, frames)

    monkeypatch.setattr(Picture, "forward", spy)
    batch = make_batch()
    learner = TD3Learner(LearnerConfig(batch_size=12, precision=name), PHIL, seed=0)
    learner.update(batch)
    targets = learner.target_critics
    used = [learner.actor, *learner.critics.pair, learner.target_actor, *targets.pair]
    wanted = Counter((network.picture, name == "bfloat16") for network in [*used, targets.first])
    assert Counter(reduced) == wanted
    reduced.clear()
    learner.act(batch.frames[0])
    assert reduced == [(learner.actor.picture, False)]
