import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.learner.device_replay import DeviceReplay
from trainer.learner.drawing import last_for_all, pick
from trainer.learner.replay import ReplayBuffer
from trainer.learner.staging import ROWS, Staging
from trainer.learner.sum_tree import SumTree

Replay = ReplayBuffer | DeviceReplay


def drawing(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def observations(episode: int, length: int) -> np.ndarray:
    """Random pictures; where the episode's number is even, the first one comes twice."""
    random = np.random.default_rng(episode)
    pictures = random.integers(0, 255, (length + 2, 45, 80)).astype(np.uint8)
    if episode % 2 == 0:
        pictures[1] = pictures[0]
    return np.stack([pictures[:-1], pictures[1:]], axis=1)


def drive(replay: Replay, episode: int, length: int, human: bool = False) -> None:
    seen = observations(episode, length)
    replay.start_episode(seen[0])
    for step in range(length):
        action = np.array([step / 100], np.float32)
        terminal = step == length - 1
        replay.add(action, step - 0.1, seen[step + 1], terminal, human)


def set_priorities(replay: Replay, slots: np.ndarray, values: np.ndarray) -> None:
    if isinstance(replay, ReplayBuffer):
        replay.update_priorities(slots, values)
    else:
        replay.set_priorities(torch.from_numpy(slots), torch.from_numpy(values))


def assert_equal_states(a: Replay, b: Replay) -> None:
    ours, theirs = a.state_dict(), b.state_dict()
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)
        if isinstance(value, np.ndarray):
            assert value.dtype == theirs[name].dtype


EPISODES = st.lists(st.tuples(st.integers(0, 12), st.booleans()), min_size=1, max_size=12)


@settings(max_examples=40, deadline=None)
@given(EPISODES, st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_it_holds_what_the_replay_buffer_holds_after_the_same(episodes, capacity, seed):
    random = np.random.default_rng(seed)
    ours, theirs = DeviceReplay(capacity), ReplayBuffer(capacity)
    for number, (length, human) in enumerate(episodes):
        for replay in (ours, theirs):
            drive(replay, number, length, human)
        assert (len(ours), ours.added) == (len(theirs), theirs.added)
        alive = theirs._ledger.alive
        if len(alive):
            # With some named twice.
            slots, values = random.choice(alive, 6), random.uniform(0.001, 9.0, 6)
            for replay in (ours, theirs):
                set_priorities(replay, slots, values)
    assert_equal_states(ours, theirs)
    np.testing.assert_allclose(ours.mean_priorities(), theirs.mean_priorities())


@settings(max_examples=30, deadline=None)
@given(EPISODES, st.integers(1, 40), st.sampled_from([0.0, 0.6]), st.booleans())
def test_a_batch_is_the_drawn_slots_of_the_replay_buffer(episodes, capacity, alpha, separate):
    ours = DeviceReplay(capacity, alpha=alpha, separate=separate)
    theirs = ReplayBuffer(capacity, alpha=alpha, separate=separate)
    for number, (length, human) in enumerate(episodes):
        for replay in (ours, theirs):
            drive(replay, number, length, human)
    if not len(ours):
        return
    indices, batch = ours.draw(32, drawing())
    assert set(indices.tolist()) <= set(theirs._ledger.alive.tolist())
    wanted = theirs._gather(indices.numpy())
    for name, column in batch._asdict().items():
        np.testing.assert_allclose(column.numpy(), getattr(wanted, name), rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("first", [DeviceReplay, ReplayBuffer])
@pytest.mark.parametrize("second", [DeviceReplay, ReplayBuffer])
def test_either_takes_up_what_the_other_gave(first, second):
    a, b = first(25), second(25)
    for number in range(4):
        drive(a, number, 9, human=number == 2)
    set_priorities(a, a._ledger.alive[:5], np.arange(1.0, 6.0))
    b.load_state_dict(a.state_dict())
    for replay in (a, b):
        drive(replay, 9, 8)
    assert_equal_states(a, b)


def test_a_restored_one_draws_the_same():
    a, b = DeviceReplay(30), DeviceReplay(30)
    for number in range(4):
        drive(a, number, 11)
    set_priorities(a, np.arange(20), np.linspace(0.1, 5, 20))
    b.load_state_dict(a.state_dict())
    (ours, batch), (theirs, same) = (replay.draw(32, drawing(3)) for replay in (a, b))
    assert torch.equal(ours, theirs)
    assert all(torch.equal(x, y) for x, y in zip(batch, same, strict=True))


@pytest.mark.parametrize("kind", [DeviceReplay, ReplayBuffer])
@pytest.mark.parametrize("separate", [False, True])
def test_what_a_used_one_held_before_is_not_drawn_any_more(kind, separate):
    used, other = kind(30, separate=separate), kind(30, separate=separate)
    for human in (False, True):
        drive(used, human, 12, human)
        drive(other, human, 2, human)
    used.load_state_dict(other.state_dict())
    if isinstance(used, DeviceReplay):
        drawn = used.draw(200, drawing())[0].numpy()
    else:
        drawn = used.sample(200, np.random.default_rng(0)).indices
    assert set(drawn) == {0, 1, 2, 3}
    assert_equal_states(used, other)


def test_draws_follow_equation_20_and_are_stratified():
    replay = DeviceReplay(10, alpha=0.5)
    drive(replay, 0, 3)
    set_priorities(replay, np.arange(3), np.array([1.0, 16.0, 9.0]))
    indices, batch = replay.draw(8000, drawing())
    # 1^0.5 : 16^0.5 : 9^0.5 = 1 : 4 : 3, and strata leave each off by at most one draw.
    np.testing.assert_allclose(np.bincount(indices), [1000, 4000, 3000], atol=1.01)
    np.testing.assert_allclose(batch.probabilities, np.array([1, 4, 3])[indices] / 8)


def test_separate_buffers_are_drawn_from_by_their_size():
    replay = DeviceReplay(100, alpha=1.0, separate=True)
    drive(replay, 0, 30)
    drive(replay, 1, 10, human=True)
    set_priorities(replay, np.arange(30, 40), np.array([70.0] + [10.0] * 9))
    indices, batch = replay.draw(4000, drawing())
    assert batch.human.double().mean() == pytest.approx(0.25, abs=1e-3)
    assert (indices == 30).double().mean() == pytest.approx(0.25 * 70 / 160, abs=1e-3)


@pytest.mark.parametrize("bad", [0, 4])
def test_of_a_slot_named_twice_the_last_one_counts(bad):
    replay = DeviceReplay(10)
    drive(replay, 0, 5)
    slots = torch.tensor([bad, 1, bad, 3, bad])
    replay.set_priorities(slots, torch.tensor([5.0, 2.0, 9.0, 4.0, 0.5]))
    assert replay.state_dict()["priorities"][[bad, 1, 3]].tolist() == [0.5, 2.0, 4.0]


def test_rows_of_the_same_index_agree_on_the_last_value():
    values = last_for_all(torch.tensor([7, 0, 7, 3, 7, 0]), torch.arange(6.0))
    assert values.tolist() == [4, 5, 4, 3, 4, 5]


def test_storing_a_record_again_changes_nothing():
    """What recording it as a graph does to it."""
    replay = DeviceReplay(6)
    drive(replay, 0, 9)
    replay.set_priorities(torch.arange(6), torch.tensor([3.0, 1.0, 2.0, 5.0, 0.5, 4.0]))
    seen = observations(5, 1)
    for store in (lambda: replay.start_episode(seen[0]), lambda: drive(replay, 5, 1)):
        store()
        before = {name: np.copy(value) for name, value in replay.state_dict().items()}
        replay.store_record()
        for name, value in replay.state_dict().items():
            np.testing.assert_array_equal(value, before[name])


def test_a_transition_without_an_episode_is_refused():
    with pytest.raises(RuntimeError, match="start_episode"):
        DeviceReplay(5).add(np.zeros(1, np.float32), 0.0, observations(0, 1)[0], False, False)


WEIGHTS = st.lists(
    st.one_of(st.just(0.0), st.floats(1e-300, 1e-9), st.floats(0.1, 1e6), st.just(1e17)),
    min_size=1,
    max_size=30,
).filter(any)


@settings(max_examples=300, deadline=None)
@given(WEIGHTS, st.data())
def test_no_mass_picks_a_part_without_weight(weights, data):
    """Masses at, just below and just above every end, and beyond the last one."""
    table = torch.tensor([weights], dtype=torch.float64)
    ends = table.cumsum(1)[0].numpy()
    masses = np.concatenate([[0.0], ends, np.nextafter(ends, 0), np.nextafter(ends, np.inf)])
    parts, left_over = pick(table.expand(len(masses), -1), torch.from_numpy(masses))
    assert (table[0][parts] > 0).all()
    assert (left_over >= 0).all()


def test_rounding_that_goes_back_and_forth_picks_no_part_without_weight(monkeypatch):
    """A parallel sum may come out larger behind an empty part than before it."""
    weights = torch.tensor([[1.0, 0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    sums = torch.tensor([[1.0, 1.0 + 1e-9, 1.0 - 1e-9, 2.0, 2.0 + 1e-9]], dtype=torch.float64)
    monkeypatch.setattr(torch.Tensor, "cumsum", lambda self, dim: sums.expand(len(self), -1))
    masses = torch.tensor([0.0, 1.0, 1.0 + 5e-10, 1.5, 2.0, 2.0 + 5e-10], dtype=torch.float64)
    parts, _ = pick(weights.expand(6, -1), masses)
    assert parts.tolist() == [0, 3, 3, 3, 3, 3]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 9), min_size=1, max_size=40).filter(any), st.integers(0, 2**32 - 1))
def test_a_pick_is_that_of_the_sum_tree(weights, seed):
    """Whole weights, so that no sum is rounded."""
    tree = SumTree(len(weights))
    tree[np.arange(len(weights))] = np.array(weights, float)
    masses = np.random.default_rng(seed).random(20) * tree.total
    table = torch.tensor(weights, dtype=torch.float64).expand(20, -1)
    parts, _ = pick(table, torch.from_numpy(masses))
    np.testing.assert_array_equal(parts, tree.find(masses))


def test_a_staged_record_is_the_last_one_sent_however_many_were():
    layout = np.dtype([("number", np.int64, (1,)), ("pixels", np.uint8, (2, 3))])
    staging = Staging(layout, torch.device("cpu"))
    for number in range(2 * ROWS + 1):
        row = staging.row()
        row["number"], row["pixels"] = number, number + 1
        staging.send()
        assert staging.fields["number"].tolist() == [number]
        assert staging.fields["pixels"].tolist() == [[number + 1] * 3] * 2
