"""The learner on an accelerator: on the processor, on torch's meta device, and on CUDA.

The meta device has shapes and no values: whatever reads a value back raises there.
"""

import copy
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from trainer.files import load_torch
from trainer.learner import td3
from trainer.learner.algorithms import ALGORITHMS, PHIL
from trainer.learner.captured import captured, changed_by_learning, preserved
from trainer.learner.config import LearnerConfig
from trainer.learner.optimiser import load_adam, make_adam
from trainer.learner.td3 import TD3Learner
from trainer.training import run as run_module
from trainer.training.accelerator import AcceleratorLearning
from trainer.training.config import RunConfig
from trainer.training.learning import ProcessorLearning
from trainer.training.metrics import read_metrics
from trainer.training.run import TrainingRun, make_learning

SMALL = LearnerConfig(batch_size=8, replay_capacity=60, warmup_steps=1)
needs_cuda = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="no CUDA device: graphs cannot be captured"
)


@pytest.fixture(autouse=True)
def one_thread():
    """Several would only wait for each other over networks and batches this small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def observation(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (2, 45, 80)).astype(np.uint8)


def fill(learning, steps: int = 20) -> None:
    """An episode in which the human has every third step."""
    learning.start_episode(observation(0))
    for step in range(steps):
        action = np.array([step / steps], np.float32)
        learning.add(action, float(step % 5), observation(step + 1), False, step % 3 == 0)


def weights(learner: TD3Learner) -> torch.Tensor:
    networks = (learner.actor, learner.critics, learner.target_actor, learner.target_critics)
    return torch.cat([p.detach().flatten() for n in networks for p in n.parameters()]).cpu()


def small(device: str = "cpu", algorithm: str = "phil_td3", **changes) -> AcceleratorLearning:
    learning = AcceleratorLearning(
        replace(SMALL, **changes), ALGORITHMS[algorithm], seed=1, action_size=1, device=device
    )
    fill(learning)
    return learning


def test_an_update_is_that_of_the_learner_on_the_same_batch():
    learning, plain = small(), TD3Learner(SMALL, PHIL, seed=1)
    same = torch.Generator()
    same.set_state(learning._drawing.get_state())
    indices, batch = learning.replay.draw(SMALL.batch_size, same)
    outcome = plain.step(batch, torch.tensor(0.0))
    learning.begin(0.0)
    learning.finish()
    assert torch.equal(weights(learning.learner), weights(plain))
    learning.replay.set_priorities(indices, torch.full((8,), -1.0))
    changed = learning.replay.state_dict()["priorities"] < 0
    learning.replay.set_priorities(indices, outcome.priorities)
    assert 1 < changed.sum() <= 8
    episode = learning.end_episode()
    found = (episode.critic_loss, episode.policy_loss, episode.cloning_loss, episode.value)
    assert found == pytest.approx(outcome.losses.tolist())


def test_new_priorities_are_those_of_the_update():
    learning, plain = small(), TD3Learner(SMALL, PHIL, seed=1)
    wanted = copy.deepcopy(learning.replay.state_dict()["priorities"])
    same = torch.Generator()
    same.set_state(learning._drawing.get_state())
    indices, batch = learning.replay.draw(SMALL.batch_size, same)
    wanted[indices.numpy()] = plain.step(batch, torch.tensor(0.0)).priorities.double().numpy()
    assert not (wanted == 1.0).all()
    learning.begin(0.0)
    np.testing.assert_array_equal(learning.replay.state_dict()["priorities"], wanted)


def test_an_action_is_the_actors():
    learning = small()
    np.testing.assert_array_equal(
        learning.act(observation(3)), learning.learner.act(observation(3))
    )
    # What was given away stays as it was.
    first = learning.act(observation(3))
    kept = first.copy()
    learning.act(observation(4))
    np.testing.assert_array_equal(first, kept)


def test_an_episode_reports_mean_losses_and_decays_the_rates():
    learning = small(learning_rate_decay=0.5)
    per_update = []
    for _ in range(3):
        before = learning._loss_sums.clone()
        learning.begin(0.0)
        per_update.append((learning._loss_sums - before).tolist())
    episode = learning.end_episode()
    assert episode.critic_loss == pytest.approx(np.mean(per_update, axis=0)[0])
    assert episode.value == pytest.approx(np.mean(per_update, axis=0)[3])
    assert episode.learning_s > 0
    assert episode.policy_priority != episode.human_priority
    assert learning.learner.actor_optimiser.param_groups[0]["lr"] == pytest.approx(2.5e-4)
    after = learning.end_episode()
    assert np.isnan(after.critic_loss)
    assert after.learning_s == after.waiting_s == 0.0


def test_losses_that_are_no_numbers_end_the_run():
    learning = small()
    with torch.no_grad():
        next(learning.learner.critics.parameters()).fill_(torch.nan)
    learning.begin(0.0)
    with pytest.raises(ValueError, match="not finite"):
        learning.end_episode()


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_the_policy_learns_every_so_many_updates(delay):
    learning = small(policy_delay=delay)
    moved = []
    for _ in range(6):
        before = weights(learning.learner)[:1000].clone()
        learning.begin(0.0)
        moved.append(not torch.equal(before, weights(learning.learner)[:1000]))
    assert moved == [update % delay == 0 for update in range(1, 7)]


def test_beta_reaches_the_loss():
    learnings = [small(importance_sampling=True) for _ in range(2)]
    for learning in learnings:
        learning.begin(0.0)  # so that priorities differ
    for learning, beta in zip(learnings, (0.0, 1.0), strict=True):
        learning.begin(beta)
    a, b = (learning.end_episode().critic_loss for learning in learnings)
    assert a != b


def test_a_restored_one_goes_on_like_one_unbroken():
    whole, broken = small(), small()
    for learning in (whole, broken):
        for _ in range(4):
            learning.begin(0.0)
        learning.end_episode()
    resumed = AcceleratorLearning(SMALL, PHIL, seed=99, action_size=1, device="cpu")
    resumed.load_state_dict(copy.deepcopy(broken.state_dict()))
    for learning in (whole, resumed):
        fill(learning, 5)
        for _ in range(4):
            learning.begin(0.0)
        learning.end_episode()
    assert torch.equal(weights(whole.learner), weights(resumed.learner))
    ours, theirs = whole.replay.state_dict(), resumed.replay.state_dict()
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name])


TINY = RunConfig(
    seed=3,
    episodes=2,
    evaluate_every=2,
    evaluation_runs=1,
    checkpoint_every=1,
    learner=LearnerConfig(batch_size=2, replay_capacity=2000, warmup_steps=60),
)


def train(config: RunConfig, directory, monkeypatch, resume: bool = False) -> Any:
    def on_the_processor(config, algorithm, action_size):
        return AcceleratorLearning(config.learner, algorithm, config.seed, action_size, "cpu")

    monkeypatch.setattr(run_module, "make_learning", on_the_processor)
    directory.mkdir(exist_ok=True)
    run = TrainingRun(config, directory, resume)
    run.train()
    return run


def test_a_run_trains_and_in_two_parts_ends_the_same(tmp_path, monkeypatch):
    whole = train(TINY, tmp_path / "whole", monkeypatch)
    rows = read_metrics(whole.run_dir)
    assert float(rows[-1]["critic_loss"]) > 0
    assert sum(int(row["human_steps"]) for row in rows) > 0
    assert rows[-1]["validation_success"] != "nan"
    parts = tmp_path / "parts"
    train(replace(TINY, episodes=1), parts, monkeypatch)
    resumed = train(TINY, parts, monkeypatch, resume=True)
    assert resumed.learning.learner.updates > 0
    assert torch.equal(weights(whole.learning.learner), weights(resumed.learning.learner))
    a, b = (load_torch(run.run_dir / "checkpoint.pt")["learning"] for run in (whole, resumed))
    for name, value in a["replay"].items():
        assert torch.equal(torch.as_tensor(value), torch.as_tensor(b["replay"][name])), name
    assert torch.equal(a["drawing"], b["drawing"])


def test_learning_is_where_the_config_says(monkeypatch):
    asked = []
    monkeypatch.setattr(run_module, "AcceleratorLearning", lambda *given: asked.append(given))
    config = RunConfig(device="cuda", learner=SMALL, seed=7)
    make_learning(config, PHIL, 1)
    assert asked == [(SMALL, PHIL, 7, 1, "cuda")]
    on_processor = make_learning(replace(config, device="cpu"), PHIL, 1)
    assert isinstance(on_processor, ProcessorLearning)
    on_processor.close()


class NoGenerator:
    """The meta device has none; torch takes None for one."""

    def __init__(self, device: torch.device) -> None: ...

    def manual_seed(self, seed: int) -> None:
        return None


@pytest.fixture
def blind(monkeypatch):
    """``AcceleratorLearning`` on the meta device, with what that lacks: generators, autocast and
    a fused Adam, none of which reads a value back on CUDA.
    """
    monkeypatch.setattr(torch, "Generator", NoGenerator)
    monkeypatch.setattr(TD3Learner, "_precision", lambda self: nullcontext())
    monkeypatch.setattr(
        td3, "make_adam", lambda module, rate, device: torch.optim.Adam(module.parameters(), rate)
    )
    return lambda **changes: small("meta", **changes)


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
@pytest.mark.parametrize("split", [False, True])
def test_storing_and_learning_read_no_value_back(blind, algorithm, split):
    learning = blind(algorithm=algorithm, split_loss=split, policy_delay=2, saturation_weight=0.1)
    for _ in range(3):
        learning.begin(0.3)
        learning.finish()
        fill(learning, 2)
    learning.learner.decay_learning_rates()


def test_only_the_action_and_the_episodes_end_read_values_back(blind):
    learning = blind()
    learning.begin(0.0)
    learning._seen.row()["frames"] = observation(0)
    learning._seen.send()
    learning._choose_action()
    # Pins down that the device without values refuses, and where.
    for reading in (learning.replay.mean_priorities, learning.end_episode):
        with pytest.raises(NotImplementedError, match="no data"):
            reading()


def test_warming_up_changes_nothing():
    """Weights, moments, priorities, losses and generators, at the very same addresses."""
    learning, untouched = small(), small()
    changed = changed_by_learning(learning.learner)
    changed += [learning.replay.priorities, learning._loss_sums]
    generators = [learning.learner.noise, learning._drawing]
    places = [tensor.data_ptr() for tensor in changed]
    assert torch.equal(weights(learning.learner), weights(untouched.learner))
    with preserved(changed, generators):
        for _ in range(3):
            learning._update(with_policy=True)
        assert not torch.equal(weights(learning.learner), weights(untouched.learner))
    assert [tensor.data_ptr() for tensor in changed] == places
    for each in (learning, untouched):
        for _ in range(3):
            each.begin(0.0)
    assert torch.equal(weights(learning.learner), weights(untouched.learner))
    assert torch.equal(learning.replay.priorities, untouched.replay.priorities)
    assert torch.equal(learning._loss_sums, untouched._loss_sums)


def test_moments_are_among_what_is_put_back_before_the_first_step():
    learner = TD3Learner(SMALL, PHIL, seed=1)
    parameters = sum(1 for n in (learner.actor, learner.critics) for _ in n.parameters())
    # Online and target, and of each online parameter two moments and a step count.
    assert len(changed_by_learning(learner)) == 2 * parameters + 3 * parameters
    assert all(state["step"] == 0 for state in learner.actor_optimiser.state.values())


def test_a_recording_comes_after_runs_that_leave_nothing_behind(monkeypatch):
    """With a stand-in for torch's own part: what is done, in which order."""
    done: list[Any] = []
    number, drawing = torch.zeros(1), torch.Generator().manual_seed(0)
    before = drawing.get_state()

    def function():
        done.append((float(number), torch.rand(1, generator=drawing).item()))
        number.add_(1.0)

    class Graph:
        def register_generator_state(self, generator):
            assert generator is drawing
            assert torch.equal(generator.get_state(), before)
            done.append("registered")

        def replay(self):
            done.append("replayed")

    @contextmanager
    def recording(graph):
        assert isinstance(graph, Graph)
        done.append("recording")
        yield
        done.append("recorded")

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", recording)
    monkeypatch.setattr(torch.cuda, "Stream", MagicMock())
    monkeypatch.setattr(torch.cuda, "current_stream", MagicMock())
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    replay = captured(function, torch.device("cuda"), [number], [drawing])
    replay()
    assert [run if isinstance(run, str) else run[0] for run in done] == [
        0.0, 1.0, 2.0, "registered", "recording", 0.0, "recorded", "replayed",
    ]  # fmt: skip
    assert done[5] == done[0]


def test_elsewhere_than_on_cuda_a_function_is_its_own_graph():
    assert captured(print, torch.device("cpu")) is print


def test_a_loaded_optimiser_keeps_its_rate_where_it_was():
    """On CUDA it is a tensor there, which a graph reads; a checkpoint is read to the processor."""
    module = torch.nn.Linear(2, 2)
    optimiser = make_adam(module, 1e-3, torch.device("cpu"))
    rate = torch.tensor(1e-3)
    optimiser.param_groups[0]["lr"] = rate
    state = copy.deepcopy(optimiser.state_dict())
    state["param_groups"][0] |= {"lr": torch.tensor(5e-4), "capturable": True}
    load_adam(optimiser, state)
    (group,) = optimiser.param_groups
    assert group["lr"] is rate
    assert rate.item() == pytest.approx(5e-4)
    assert group["capturable"] is False
    plain = make_adam(module, 1e-3, torch.device("cpu"))
    load_adam(plain, state)
    assert plain.param_groups[0]["lr"] == pytest.approx(5e-4)
    assert isinstance(plain.param_groups[0]["lr"], float)


def uncaptured(learning: Any) -> Any:
    """The same without graphs."""
    learning._graph = lambda name, function, learning=False: function
    return learning


@needs_cuda
@pytest.mark.parametrize("delay", [1, 2])
def test_graphs_do_what_the_functions_do(delay):
    graphs = AcceleratorLearning(replace(SMALL, policy_delay=delay), PHIL, 1, 1)
    plain = uncaptured(AcceleratorLearning(replace(SMALL, policy_delay=delay), PHIL, 1, 1))
    for learning in (graphs, plain):
        fill(learning)
        for number in range(5):
            learning.begin(0.0)
            fill(learning, 3)
            learning.act(observation(number))
            learning.learner.decay_learning_rates()
    torch.testing.assert_close(weights(graphs.learner), weights(plain.learner))
    torch.testing.assert_close(graphs.replay.priorities, plain.replay.priorities)
    ours, theirs = (learning.act(observation(9)) for learning in (graphs, plain))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    assert torch.equal(graphs._drawing.get_state(), plain._drawing.get_state())
    assert graphs.end_episode().learning_s > 0


@needs_cuda
def test_cuda_learns_what_the_processor_learns():
    """From the same batch: the first update's weights and priorities."""
    on_cuda, batch = small("cuda"), small().replay.draw(8, torch.Generator().manual_seed(0))[1]
    there = td3.Minibatch(*(column.cuda() for column in batch))
    config = replace(SMALL, target_noise=0.0)
    learners = [TD3Learner(config, PHIL, 1, device=device) for device in ("cpu", "cuda")]
    found = [
        learner.step(where, torch.zeros((), device=learner.device))
        for learner, where in zip(learners, (batch, there), strict=True)
    ]
    torch.testing.assert_close(found[0].losses, found[1].losses.cpu(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found[0].priorities, found[1].priorities.cpu(), rtol=1e-3, atol=1e-4)
    assert len(on_cuda.replay) == 20


@needs_cuda
def test_a_graph_runs_without_any_synchronisation():
    learning = small("cuda")
    for _ in range(2):
        learning.act(observation(0))
        learning.begin(0.0)
        fill(learning, 1)
    torch.cuda.set_sync_debug_mode("error")
    try:
        learning.begin(0.5)
        fill(learning, 1)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@needs_cuda
def test_a_restored_one_on_cuda_goes_on_like_one_unbroken():
    whole = small("cuda")
    for _ in range(4):
        whole.begin(0.0)
    whole.end_episode()
    resumed = AcceleratorLearning(SMALL, PHIL, seed=99, action_size=1)
    state = copy.deepcopy(whole.state_dict())
    resumed.load_state_dict(state)
    for learning in (whole, resumed):
        fill(learning, 5)
        for _ in range(4):
            learning.begin(0.0)
        learning.end_episode()
    assert torch.equal(weights(whole.learner), weights(resumed.learner))
