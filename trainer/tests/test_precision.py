from collections import Counter

import pytest
import torch

from trainer.learner import networks
from trainer.learner.config import PHIL, LearnerConfig
from trainer.learner.networks import Picture
from trainer.learner.td3 import TD3Learner
from trainer.tests.test_td3 import make_batch


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


@pytest.mark.parametrize(
    ("name", "flags", "autocast"),
    [("float32", "avx512_bf16", False), ("bfloat16", "avx512_bf16", True),
     ("bfloat16", "fma avx2", False)],
)  # fmt: skip
def test_every_picture_of_an_update_is_embedded_in_its_precision(
    processor, monkeypatch, name, flags, autocast
):
    """Online and target networks alike, the Q advantage's too; acting is always float32."""
    processor(f"flags : {flags}")
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
    wanted = Counter((network.picture, autocast) for network in [*used, targets.first])
    assert Counter(reduced) == wanted
    reduced.clear()
    learner.act(batch.frames[0])
    assert reduced == [(learner.actor.picture, False)]
