"""The learner: its networks, learning rates, shifted pictures and precision."""

import contextlib
import copy
import itertools
import weakref
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from trainer.learner import networks
from trainer.learner.config import ALGORITHMS, PHIL
from trainer.learner.networks import FEATURES, Actor, Critic
from trainer.learner.recorded import WARM_UPS, RecordedStep
from trainer.learner.td3 import NETWORKS, OPTIMISERS, Choices, Losses, TD3Learner
from trainer.tests.learners import SMALL, make_batch, on_a_gpu, same_weights, weights_of


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
    for shifted, padded in zip(learner._shift(torch.from_numpy(frames)), around, strict=True):
        places = [
            (top, left)
            for top, left in itertools.product(range(2 * most + 1), repeat=2)
            if np.array_equal(shifted, padded[:, top : top + 45, left : left + 80])
        ]
        assert len(places) == 1
        seen.update(places)
    assert len(seen) > (2 * most + 1) ** 2 / 2


def test_a_picture_is_learned_from_alike_where_its_channels_come_first_and_last():
    weights = []
    frames = np.random.default_rng(0).integers(0, 255, (12, 3, 20, 24)).astype(np.uint8)
    for last in (False, True):
        seen = np.ascontiguousarray(np.moveaxis(frames, 1, -1)) if last else frames
        learner = TD3Learner(
            replace(SMALL, picture_shift=2), PHIL, 0, space=Box(0, 255, seen.shape[1:], np.uint8)
        )
        learner.update(replace(make_batch(), frames=seen, next_frames=seen))
        weights.append(weights_of(learner))
    for name, flat in weights[0].items():
        assert (flat - weights[1][name]).abs().max() < 1e-6, name


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


ROWS = pytest.mark.parametrize("name", ["phil_td3", "phil_weighted", "pvp4real_td3", "ppl_td3"])


def batch_of(name, seed, humans):
    """A batch of a row's kind: with an own one to imitate, or to prefer actions in."""
    shown = make_batch(9, humans=7, size=7) if name == "phil_weighted" else None
    return replace(make_batch(seed, humans), shown=shown)


@pytest.mark.parametrize("delayed", [False, True])
@ROWS
def test_a_step_that_a_gpu_records_is_the_processors(name, delayed, monkeypatch):
    settings = replace(SMALL, picture_shift=3, policy_delay=1 + delayed)
    learner, recorded = (TD3Learner(settings, ALGORITHMS[name], seed=0) for _ in range(2))
    for seed, humans in enumerate((4, 0)):
        batch = batch_of(name, seed, humans)
        wanted = learner.update(batch, beta=0.5)
        recorded.updates += 1
        with monkeypatch.context() as patch:
            patch.setattr(TD3Learner, "_on_gpu", True)
            prepared = recorded._prepare(batch, beta=0.5)
            figures = recorded._step(prepared, recorded.updates % settings.policy_delay == 0)
        found = Losses.of(figures)
        np.testing.assert_allclose(found[:4], wanted[:4], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(found.priorities, wanted.priorities, rtol=1e-4)
    for key, flat in weights_of(learner).items():
        assert (flat - weights_of(recorded)[key]).abs().max() < 2e-5


class NothingOfTheProcessor(TorchDispatchMode):
    """Fail where an operation takes a tensor from, or to, the processor's memory."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **kwargs or {})
        for part in tree_leaves((args, kwargs, made)):
            assert not isinstance(part, torch.Tensor) or part.is_meta, func
        return made


@ROWS
def test_a_step_that_a_gpu_records_knows_no_tensors_content_and_no_other_memory(name, monkeypatch):
    """The device ``meta`` stands in for a GPU: what it holds has shapes alone."""
    learner: Any = TD3Learner(replace(SMALL, picture_shift=3), ALGORITHMS[name], seed=0)
    for network in NETWORKS:
        getattr(learner, network).to("meta")
    for optimiser in OPTIMISERS:
        monkeypatch.setattr(getattr(learner, optimiser), "step", lambda: None)
    monkeypatch.setattr(TD3Learner, "_on_gpu", True)
    monkeypatch.setattr(learner, "_precision", contextlib.nullcontext)
    learner.device, learner.noise = torch.device("meta"), None
    prepared = learner._prepare(batch_of(name, 0, humans=4), beta=0.5)
    given = tree_map_only(torch.Tensor, lambda tensor: tensor.to("meta"), prepared)
    with NothingOfTheProcessor():
        assert learner._step(given, with_policy=True).shape == (4 + 12,)


def test_a_recorded_step_is_replayed_on_the_batch_of_each_call(monkeypatch):
    """What stands in for the GPU runs the step where a GPU records it, and at each replay.

    Garbage with cycles, such as another learner, must be gone: it may hold another recording.
    """
    calls: list[Choices] = []
    answer, device = torch.empty(3), torch.device("cpu")
    graph = SimpleNamespace(register_generator_state=lambda _: None)

    def step(batch):
        calls.append(batch)
        return answer.copy_(batch.entries[0] + batch.actions)

    cycle: Any = torch.nn.Identity()
    cycle.itself, garbage = cycle, weakref.ref(cycle)
    del cycle

    def begin_recording(*_, **__):
        assert garbage() is None
        graph.replay = lambda: step(calls[-1])
        return contextlib.nullcontext()

    stream = SimpleNamespace(wait_stream=lambda _: None)
    for name, made in {"Stream": stream, "current_stream": stream, "CUDAGraph": graph}.items():
        monkeypatch.setattr(torch.cuda, name, lambda *_, made=made: made)
    monkeypatch.setattr(torch.cuda, "stream", contextlib.nullcontext)
    monkeypatch.setattr(torch.cuda, "graph", begin_recording)
    recorded = RecordedStep(step, cast(torch.Generator, SimpleNamespace(device=device)))
    for number in range(2 * WARM_UPS):
        batch = Choices([torch.full((3,), float(number))], torch.ones(3), cast(torch.Tensor, None))
        assert recorded(batch).tolist() == [number + 1.0] * 3
    assert len({id(batch.actions) for batch in calls[WARM_UPS:]}) == 1


@on_a_gpu
@ROWS
def test_on_a_gpu_a_resumed_learner_has_the_bits_of_one_that_never_stopped(name):
    settings = replace(SMALL, precision="bfloat16", picture_shift=3, policy_delay=2)
    learner, resumed = (TD3Learner(settings, ALGORITHMS[name], s, device="cuda") for s in (0, 1))
    for seed in range(6 * WARM_UPS):
        if seed == 3 * WARM_UPS:  # Both kinds of step are recorded.
            resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
        for each in (learner, resumed):
            each.update(batch_of(name, seed, humans=seed % 5))
            each.decay(seed / (6 * WARM_UPS))
    assert same_weights(learner, resumed)


@on_a_gpu
@ROWS
def test_a_recorded_step_learns_what_the_processors_does(name):
    settings = replace(SMALL, target_noise=0.0)
    learner, on_gpu = (TD3Learner(settings, ALGORITHMS[name], 0, device=d) for d in ("cpu", "cuda"))
    for seed in range(8):
        batch = batch_of(name, seed, humans=seed % 5)
        wanted, found = learner.update(batch), on_gpu.update(batch)
        np.testing.assert_allclose(found[:4], wanted[:4], rtol=0.01, atol=1e-3)
        for each in (learner, on_gpu):
            each.decay(seed / 8)
