import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from trainer.learner import equations
from trainer.learner.config import ALGORITHMS, PHIL, LearnerConfig
from trainer.learner.networks import FEATURES, Actor, Critic
from trainer.learner.replay import Batch
from trainer.learner.td3 import TD3Learner
from trainer.tests.reference import ReferenceLearner

SMALL = LearnerConfig(
    batch_size=12, precision="float32", saturation_weight=0.0, tau=1e-3, picture_shift=0
)


def make_batch(seed: int = 0, humans: int = 4, size: int = 12) -> Batch:
    random = np.random.default_rng(seed)
    pictures = random.integers(0, 255, (size, 3, 45, 80)).astype(np.uint8)
    return Batch(
        indices=np.arange(size),
        frames=pictures[:, :2],
        actions=random.uniform(-1, 1, (size, 1)).astype(np.float32),
        rewards=random.normal(size=size).astype(np.float32),
        next_frames=pictures[:, 1:],
        terminals=(random.random(size) < 0.2).astype(np.float32),
        human=np.arange(size) < humans,
        probabilities=random.uniform(0.5, 1.5, size) / size,
        spans=random.integers(1, 9, size),
        overruled=random.uniform(-1, 1, (size, 1)).astype(np.float32),
        penalised=(np.arange(size) < humans) & (np.arange(size) % 2 == 0),
    )


def weights_of(learner: TD3Learner | ReferenceLearner) -> dict[str, torch.Tensor]:
    modules = {
        "actor": learner.actor,
        "critics": learner.critics,
        "target_actor": learner.target_actor,
        "target_critics": learner.target_critics,
    }
    return {
        name: torch.cat([p.detach().flatten().clone() for p in module.parameters()])
        for name, module in modules.items()
    }


def test_the_networks_are_those_of_tables_a2_to_a4():
    assert FEATURES == 16 * 7 * 16
    assert sum(p.numel() for p in Actor().parameters()) == (
        (2 * 36 + 1) * 6 + (6 * 36 + 1) * 16 + 1793 * 256 + 257 * 128 + 129 * 64 + 65
    )
    difference = sum(p.numel() for p in Critic().parameters()) - sum(
        p.numel() for p in Actor().parameters()
    )
    assert difference == 256
    assert Actor(frames=1).picture.trunk.conv1.weight.shape == (6, 1, 6, 6)


def test_the_trunk_equals_convolution_relu_and_pooling_as_written_in_the_paper():
    torch.manual_seed(0)
    actor, frames = Actor(), torch.randint(0, 256, (3, 2, 45, 80), dtype=torch.uint8)
    trunk = actor.picture.trunk
    hidden = frames.float() / 255
    for layer in (trunk.conv1, trunk.conv2):
        hidden = torch.nn.functional.conv2d(hidden, layer.weight, layer.bias)
        hidden = torch.nn.functional.max_pool2d(torch.relu(hidden), 2)
    torch.testing.assert_close(trunk(frames), hidden.flatten(1))


def disturb_targets(learner: TD3Learner) -> None:
    """Make the targets differ from the online networks, as they do after some updates."""
    random = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for module in (learner.target_actor, learner.target_critics):
            for p in module.parameters():
                p.add_(0.02 * torch.randn(p.shape, generator=random))
        # Fresh critics hardly feel the action; these must, or whose action it was would not show.
        learner.target_actor.head.output.bias.add_(0.5)
        for critic in learner.target_critics.pair:
            critic.action.weight += 0.5


def smoothing_noise(learner: TD3Learner, shape: tuple[int, ...]) -> torch.Tensor:
    """The noise that the learner will draw next, without drawing it from the learner."""
    random = torch.Generator()
    random.set_state(learner.noise.get_state())
    return (0.5 * torch.randn(shape, generator=random)).clamp(-0.5, 0.5)


@pytest.mark.parametrize("split", [False, True])
def test_an_update_is_the_papers_losses_and_plain_adam(split):
    """One update against the same written out with autograd and a fresh optimiser."""
    # Noise wide enough to meet its bound.
    config = replace(SMALL, split_loss=split, target_noise=0.5)
    learner, batch = TD3Learner(config, PHIL, seed=1), make_batch()
    disturb_targets(learner)
    frames, next_frames = (torch.from_numpy(x.copy()) for x in (batch.frames, batch.next_frames))
    actions, human = torch.from_numpy(batch.actions), torch.from_numpy(batch.human)
    with torch.no_grad():
        noise = smoothing_noise(learner, actions.shape)
        next_actions = (learner.target_actor(next_frames) + noise).clamp(-1.0, 1.0)
        first, second = (q(next_frames, next_actions) for q in learner.target_critics.pair)
        target = torch.from_numpy(batch.rewards) + 0.95 ** torch.as_tensor(batch.spans) * (
            1 - torch.from_numpy(batch.terminals)
        ) * torch.minimum(first, second)
    values = [critic(frames, actions) for critic in learner.critics.pair]
    errors = [(target - value) ** 2 for value in values]
    assert batch.overruled is not None
    missed = [
        -10.0 - critic(frames, torch.from_numpy(batch.overruled)) for critic in learner.critics.pair
    ]
    critic_loss = sum(e[human].mean() + e[~human].mean() if split else e.mean() for e in errors)
    penalised = torch.from_numpy(batch.penalised)
    critic_loss += sum((m**2 * penalised).mean() for m in missed)
    gradients = torch.autograd.grad(critic_loss, list(learner.critics.parameters()))
    policy = learner.actor(frames)
    policy_values = learner.critics.first(frames, policy)
    policy_loss = -(policy_values[~human] if split else policy_values).mean()
    cloning_loss = ((policy - actions) ** 2)[human].mean()
    actor_gradients = torch.autograd.grad(
        policy_loss + config.cloning_weight * cloning_loss, list(learner.actor.parameters())
    )
    before = weights_of(learner)
    with torch.no_grad():
        critic = learner.target_critics.first
        advantage = torch.exp(critic(frames, actions) - critic(frames, policy))
    worst = torch.maximum((target - values[0]).abs(), missed[0].abs() * penalised)
    wanted_priorities = worst + 1e-3 + advantage * human

    losses = learner.update(batch)

    assert losses.critic == pytest.approx(critic_loss.item(), rel=1e-5)
    assert losses.policy == pytest.approx(policy_loss.item(), rel=1e-4)
    assert losses.cloning == pytest.approx(cloning_loss.item(), rel=1e-5)
    np.testing.assert_allclose(losses.priorities, wanted_priorities.detach(), rtol=1e-4)
    for parameter, wanted in zip(learner.actor.parameters(), actor_gradients, strict=True):
        torch.testing.assert_close(parameter.grad, wanted, rtol=1e-3, atol=1e-6)
    after = weights_of(learner)
    # Adam's first step is the learning rate against the gradient's sign, wherever it is not tiny.
    for name, flat, rate in (
        ("critics", torch.cat([g.flatten() for g in gradients]), SMALL.critic_learning_rate),
        ("actor", torch.cat([g.flatten() for g in actor_gradients]), SMALL.actor_learning_rate),
    ):
        clear = flat.abs() > 1e-5
        assert clear.float().mean() > 0.2
        moved = (after[name] - before[name])[clear]
        torch.testing.assert_close(moved, -rate * flat[clear].sign(), rtol=2e-2, atol=1e-6)


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
        learner.decay_learning_rates(progress)


@pytest.mark.parametrize("most", [1, 3])
def test_pictures_are_shifted_by_some_pixels_and_by_no_more(most):
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


def test_an_update_sees_shifted_pictures():
    plain, shifted = (
        TD3Learner(replace(SMALL, picture_shift=most), PHIL, seed=0).update(make_batch())
        for most in (0, 3)
    )
    assert plain.critic != shifted.critic
    assert plain.policy != shifted.policy


def test_targets_follow_by_tau():
    learner = TD3Learner(SMALL, PHIL, seed=0)
    before = weights_of(learner)
    learner.update(make_batch())
    after = weights_of(learner)
    for online, target in (("actor", "target_actor"), ("critics", "target_critics")):
        wanted = before[target] + 1e-3 * (after[online] - before[target])
        torch.testing.assert_close(after[target], wanted)


def test_a_delayed_policy_waits_for_its_turn():
    learner = TD3Learner(replace(SMALL, policy_delay=2), PHIL, seed=0)
    before = weights_of(learner)
    learner.update(make_batch())
    between = weights_of(learner)
    assert torch.equal(before["actor"], between["actor"])
    assert torch.equal(before["target_critics"], between["target_critics"])
    assert not torch.equal(before["critics"], between["critics"])
    learner.update(make_batch())
    assert not torch.equal(between["actor"], weights_of(learner)["actor"])


def test_critic_gradients_do_not_leak_from_the_actors_loss():
    """Cloning weight and policy loss must leave the critics' step alone."""
    steps = []
    for cloning_weight in (0.0, 100.0):
        learner = TD3Learner(replace(SMALL, cloning_weight=cloning_weight), PHIL, seed=0)
        learner.update(make_batch())
        steps.append(weights_of(learner)["critics"])
    assert torch.equal(*steps)


def test_same_seed_same_weights_and_a_restored_learner_goes_on_alike():
    first, second = (TD3Learner(SMALL, PHIL, seed=7) for _ in range(2))
    for seed in range(3):
        first.update(make_batch(seed))
        second.update(make_batch(seed))
    restored = TD3Learner(SMALL, PHIL, seed=99)
    restored.load_state_dict(first.state_dict())
    for learner in (first, second, restored):
        learner.update(make_batch(9))
        learner.decay_learning_rates(0.5)
        learner.update(make_batch(10))
    for name, flat in weights_of(first).items():
        assert torch.equal(flat, weights_of(second)[name])
        assert torch.equal(flat, weights_of(restored)[name])


def test_values_of_a_terminal_state_are_learned_without_a_future():
    """A critic that always sees the same crash learns its reward and no more."""
    batch = replace(
        make_batch(size=8, humans=0),
        rewards=np.full(8, -1.0, np.float32),
        terminals=np.ones(8, np.float32),
    )
    learner = TD3Learner(replace(SMALL, critic_learning_rate=2e-3), PHIL, seed=0)
    for _ in range(60):
        learner.update(batch)
    with torch.no_grad():
        value = learner.critics.first(
            torch.from_numpy(batch.frames.copy()), torch.from_numpy(batch.actions)
        )
    torch.testing.assert_close(value, torch.full((8,), -1.0), atol=0.15, rtol=0)


def test_importance_weights_reach_the_loss():
    batch = replace(make_batch(), probabilities=np.linspace(0.01, 0.3, 12))
    plain = TD3Learner(SMALL, PHIL, seed=0).update(batch, beta=0.0)
    weighted = TD3Learner(SMALL, PHIL, seed=0).update(batch, beta=1.0)
    assert weighted.critic < plain.critic
    assert equations.importance_weights(torch.tensor([0.5]), 0.0, True).item() == 1.0


def test_a_penalised_action_is_learned_to_be_worth_the_penalty_and_the_humans_is_not():
    batch = replace(
        make_batch(size=8, humans=8),
        rewards=np.full(8, 1.0, np.float32),
        terminals=np.ones(8, np.float32),
        actions=np.full((8, 1), -0.5, np.float32),
        overruled=np.full((8, 1), 0.5, np.float32),
        penalised=np.ones(8, np.bool_),
    )
    config = replace(SMALL, critic_learning_rate=2e-3, intervention_penalty=-2.0)
    learner = TD3Learner(config, PHIL, seed=0)
    for _ in range(150):
        learner.update(batch)
    frames = torch.from_numpy(batch.frames.copy())
    for action, worth in ((-0.5, 1.0), (0.5, -2.0)):
        with torch.no_grad():
            value = learner.critics.first(frames, torch.full((8, 1), action))
        torch.testing.assert_close(value, torch.full((8,), worth), atol=0.3, rtol=0)


@pytest.mark.parametrize("change", [{"penalty_on": "human"}, {"algorithm": "phil_without_shaping"}])
def test_overruled_actions_count_only_where_they_have_the_penalty(change):
    algorithm = ALGORITHMS[change.pop("algorithm", "phil_td3")]
    batch = make_batch()
    learners = [TD3Learner(replace(SMALL, **change), algorithm, seed=0) for _ in range(2)]
    ours = learners[0].update(batch)
    theirs = learners[1].update(replace(batch, overruled=None, penalised=None))
    assert ours.critic == theirs.critic
    np.testing.assert_array_equal(ours.priorities, theirs.priorities)
