"""The learner: its networks, learning rates, shifted pictures and precision."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from trainer.learner import networks
from trainer.learner.config import PHIL
from trainer.learner.networks import FEATURES, Actor, Critic
from trainer.learner.td3 import TD3Learner
from trainer.tests.learners import SMALL, make_batch, same_weights


def test_the_networks_are_those_of_tables_a2_to_a4():
    assert FEATURES == 16 * 7 * 16
    actor, critic = (sum(p.numel() for p in made.parameters()) for made in (Actor(), Critic()))
    assert actor == (2 * 36 + 1) * 6 + (6 * 36 + 1) * 16 + 1793 * 256 + 257 * 128 + 129 * 64 + 65
    assert critic - actor == 256
    assert Actor(frames=1).picture.trunk.conv1.weight.shape == (6, 1, 6, 6)


def test_both_learning_rates_fall_by_the_episode_and_over_the_run():
    settings = replace(SMALL, learning_rate_decay=0.9, learning_rate_final=0.2)
    learner = TD3Learner(settings, PHIL, seed=0)
    for progress, factor in ((0.5, 1.0), (1.0, 0.9 * 0.6), (1.2, 0.81 * 0.2), (0.0, 0.729 * 0.2)):
        (actor,), (critics,) = (
            [group["lr"] for group in optimiser.param_groups]
            for optimiser in (learner.actor_optimiser, learner.critic_optimiser)
        )
        assert actor == pytest.approx(SMALL.actor_learning_rate * factor)
        assert critics == pytest.approx(SMALL.critic_learning_rate * factor)
        learner.decay(progress)


def test_the_weight_on_cloning_falls_to_nothing_and_a_checkpoint_keeps_it():
    settings = replace(SMALL, cloning_share=0.5)
    learner, resumed = (TD3Learner(settings, PHIL, seed) for seed in (0, 1))
    never = TD3Learner(replace(settings, cloning_weight=0.0), PHIL, seed=0)
    for each in (learner, never):
        each.decay(0.5)
    resumed.load_state_dict(learner.state_dict())
    for each in (learner, never, resumed):
        each.update(make_batch())
    assert same_weights(learner, never)
    assert same_weights(resumed, never)


def test_pictures_are_shifted_by_some_pixels_and_by_no_more():
    most = 2
    learner = TD3Learner(replace(SMALL, picture_shift=most), PHIL, seed=0)
    frames = make_batch(size=60).frames
    around = np.pad(frames, ((0, 0), (0, 0), (most, most), (most, most)), "edge")
    seen = set()
    for shifted, padded in zip(learner._shift(frames), around, strict=True):
        places = [
            (top, left)
            for top, left in itertools.product(range(2 * most + 1), repeat=2)
            if np.array_equal(shifted, padded[:, top : top + 45, left : left + 80])
        ]
        assert len(places) == 1
        seen.update(places)
    assert len(seen) > (2 * most + 1) ** 2 / 2


@pytest.fixture
def processor(monkeypatch):
    """Pretend to have a processor of these flags."""

    def pretend(*lines, tiles=0):
        monkeypatch.setattr(networks, "cpu_info", lambda: lines)
        kernel = SimpleNamespace(trunk_has_tiles=lambda: tiles)
        monkeypatch.setattr(networks, "load_kernel", lambda: None if tiles is None else kernel)
        networks.bfloat16_is_faster.cache_clear()

    yield pretend
    networks.bfloat16_is_faster.cache_clear()


@pytest.mark.parametrize(
    ("lines", "tiles", "faster"),
    [(["vendor_id : GenuineIntel", "flags : avx512_bf16 amx_bf16"], 1, True),
     (["vendor_id : GenuineIntel", "flags : avx512_bf16 amx_bf16"], 0, False),
     (["vendor_id : AuthenticAMD", "flags : avx512_bf16"], 0, True),
     (["Features : fp asimd i8mm bf16"], 0, True), (["flags : fma avx2 avx512f"], 0, False),
     (["Features : fp asimd ebf16x"], 0, False), ([], 0, False)],
)  # fmt: skip
def test_the_flags_of_a_processor_decide_and_an_intels_matrix_unit(processor, lines, tiles, faster):
    processor(*lines, tiles=tiles)
    assert networks.bfloat16_is_faster("cpu") == faster
