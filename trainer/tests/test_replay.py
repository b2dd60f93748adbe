import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.learner.replay import ReplayBuffer, SumTree


def frame(value: int) -> np.ndarray:
    """A picture that carries a number, so that frames can be told apart."""
    picture = np.zeros((45, 80), np.uint8)
    picture[0, 0], picture[0, 1] = value % 256, value // 256
    return picture


def number(picture: np.ndarray) -> int:
    return int(picture[0, 0]) + 256 * int(picture[0, 1])


class Source:
    """Feeds episodes of numbered frames; remembers what each transition was."""

    def __init__(self, buffer: ReplayBuffer) -> None:
        self.buffer, self.next = buffer, 0
        self.stored: list[tuple[int, int, int, int, bool]] = []

    def episode(self, steps: int, human: bool = False) -> None:
        last = frame(self.next)
        self.next += 1
        older = last
        self.buffer.start_episode(np.stack([last, last]))
        for step in range(steps):
            new = frame(self.next)
            self.next += 1
            self.buffer.add(
                np.array([step / 100], np.float32),
                float(step),
                np.stack([last, new]),
                terminal=step == steps - 1,
                human=human,
            )
            self.stored.append((number(older), number(last), number(new), step, step == steps - 1))
            older, last = last, new


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 30), min_size=1, max_size=12), st.integers(8, 60))
def test_a_batch_holds_only_what_was_stored_and_not_yet_forgotten(episodes, capacity):
    buffer = ReplayBuffer(capacity)
    source = Source(buffer)
    for steps in episodes:
        source.episode(steps)
    assert len(buffer) <= capacity
    if len(buffer) == 0:
        return
    batch = buffer.sample(64, np.random.default_rng(0))
    alive = source.stored[-len(buffer) :]
    for row in range(64):
        older, last = (number(f) for f in batch.frames[row])
        last_again, new = (number(f) for f in batch.next_frames[row])
        assert last == last_again
        step = round(float(batch.actions[row, 0]) * 100)
        assert (older, last, new, step, bool(batch.terminals[row])) in alive
        assert batch.rewards[row] == step


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(1, 12), st.sampled_from(["goal", "timeout"])), min_size=1, max_size=8
    ),
    st.integers(8, 60),
    st.integers(1, 10),
)
def test_n_step_returns_are_those_of_the_episode_written_out(episodes, capacity, steps):
    """Real terminals end a sum; a timeout, or the newest step, is bootstrapped from."""
    gamma = 0.5
    buffer = ReplayBuffer(capacity, steps=steps, gamma=gamma)
    written: dict[int, tuple[list[float], bool, int]] = {}
    running = 0
    for length, outcome in episodes:
        pictures = [frame(running + n) for n in range(length + 1)]
        running += length + 1
        buffer.start_episode(np.stack([pictures[0], pictures[0]]))
        for step in range(length):
            terminal = outcome == "goal" and step == length - 1
            buffer.add(
                np.zeros(1, np.float32),
                float(step + 1),
                np.stack(pictures[step : step + 2]),
                terminal,
                human=step % 3 == 0,
            )
            rest = [float(n + 1) for n in range(step, min(step + steps, length))]
            ends = outcome == "goal" and step + steps >= length
            written[number(pictures[step])] = (rest, ends, number(pictures[step + len(rest)]))
    if len(buffer) == 0:
        return
    batch = buffer.sample(64, np.random.default_rng(0))
    assert isinstance(batch.spans, np.ndarray)
    for row in range(64):
        first = number(batch.frames[row, 1])
        rewards, terminal, last = written[first]
        assert batch.spans[row] == len(rewards)
        assert batch.rewards[row] == sum(gamma**k * reward for k, reward in enumerate(rewards))
        assert bool(batch.terminals[row]) == terminal
        assert number(batch.next_frames[row, 1]) == last
        # Delta is the first step's.
        assert bool(batch.human[row]) == ((round(rewards[0]) - 1) % 3 == 0)


@pytest.mark.parametrize("overruled_value", [None, -10.0])
def test_a_return_ends_at_an_overruled_action_with_what_that_is_worth(overruled_value):
    """Steps 0 to 5 with rewards 1 to 6; the policy is overruled in step 3, and the human stays."""
    buffer = ReplayBuffer(20, steps=4, gamma=0.5, overruled_value=overruled_value)
    buffer.start_episode(np.stack([frame(0), frame(0)]))
    for step in range(6):
        pictures = np.stack([frame(step), frame(step + 1)])
        taken_over = step == 3
        buffer.add(
            np.zeros(1, np.float32), step + 1.0, pictures, step == 5, step >= 3, None, taken_over
        )
    batch = buffer.sample(200, np.random.default_rng(0))
    assert isinstance(batch.spans, np.ndarray)
    rows = {number(batch.frames[row, 1]): row for row in range(200)}
    assert sorted(rows) == list(range(6))
    before, own = rows[1], rows[3]
    if overruled_value is None:
        assert batch.rewards[before] == 2 + 3 / 2 + 4 / 4 + 5 / 8
        assert (batch.spans[before], batch.terminals[before]) == (4, 0.0)
    else:
        assert batch.rewards[before] == 2 + 3 / 2 - 10 / 4
        assert (batch.spans[before], batch.terminals[before]) == (2, 1.0)
        assert number(batch.next_frames[before, 1]) == 3
    # The human's own return knows nothing of it.
    assert batch.rewards[own] == 4 + 5 / 2 + 6 / 4
    assert (batch.spans[own], batch.terminals[own]) == (3, 1.0)


def test_the_overruled_action_is_kept_beside_the_humans():
    buffer = ReplayBuffer(10)
    buffer.start_episode(np.stack([frame(0), frame(0)]))
    action, overruled = np.array([0.25], np.float32), np.array([-1.0], np.float32)
    buffer.add(action, 0.0, np.stack([frame(0), frame(1)]), False, False)
    buffer.add(action, 0.0, np.stack([frame(1), frame(2)]), False, True, overruled, penalised=True)
    copy = ReplayBuffer(10)
    copy.load_state_dict(buffer.state_dict())
    for one in (buffer, copy):
        batch = one.sample(16, np.random.default_rng(0))
        assert batch.overruled is not None
        assert batch.penalised is not None
        np.testing.assert_array_equal(batch.overruled[:, 0], np.where(batch.human, -1.0, 0.25))
        np.testing.assert_array_equal(batch.penalised, batch.human)


def test_a_full_ring_keeps_the_newest():
    buffer = ReplayBuffer(50)
    source = Source(buffer)
    for _ in range(5):
        source.episode(25)
    assert len(buffer) == 50
    batch = buffer.sample(500, np.random.default_rng(0))
    assert {number(f) for f in batch.next_frames[:, 1]} == {
        new for *_, new, _, _ in source.stored[-50:]
    }


def test_many_short_episodes_forget_early_instead_of_mixing_pictures():
    buffer = ReplayBuffer(40)
    source = Source(buffer)
    for _ in range(60):
        source.episode(1)
    assert 15 <= len(buffer) <= 25
    batch = buffer.sample(64, np.random.default_rng(0))
    assert {number(f[1]) for f in batch.next_frames} <= {s[2] for s in source.stored[-25:]}


def test_new_transitions_get_the_highest_priority():
    buffer = ReplayBuffer(10)
    source = Source(buffer)
    source.episode(3)
    buffer.update_priorities(np.array([0, 1, 2]), np.array([0.1, 7.0, 0.2]))
    source.episode(1)
    probability = buffer.sample(1, np.random.default_rng(0)).probabilities
    weights = np.array([0.1, 7.0, 0.2, 7.0]) ** 0.6
    assert np.isclose(probability[0], weights / weights.sum()).any()
    assert buffer._priorities[3] == 7.0


def test_probabilities_follow_equation_20():
    buffer = ReplayBuffer(10, alpha=0.5)
    Source(buffer).episode(2)
    buffer.update_priorities(np.array([0, 1]), np.array([1.0, 16.0]))
    batch = buffer.sample(1000, np.random.default_rng(0))
    # 1^0.5 : 16^0.5 = 1 : 4.
    assert np.mean(batch.indices == 1) == pytest.approx(0.8, abs=0.01)
    assert set(np.round(batch.probabilities, 12)) == {0.2, 0.8}


def test_with_alpha_zero_all_are_drawn_alike_and_the_forgotten_never():
    buffer = ReplayBuffer(40, alpha=0.0)
    source = Source(buffer)
    for _ in range(60):
        source.episode(1)
    buffer.update_priorities(buffer._ring.alive[:3], np.array([0.5, 2.0, 9.0]))
    batch = buffer.sample(1000, np.random.default_rng(0))
    assert set(batch.indices) == set(buffer._ring.alive)
    np.testing.assert_allclose(batch.probabilities, 1 / len(buffer))


def test_a_priority_that_is_no_number_is_refused_before_it_spoils_the_tree():
    buffer = ReplayBuffer(10)
    Source(buffer).episode(2)
    for bad in (np.nan, np.inf, -1.0):
        with pytest.raises(ValueError, match="finite"):
            buffer.update_priorities(np.array([0]), np.array([bad]))
    assert np.isfinite(buffer.sample(8, np.random.default_rng(0)).probabilities).all()


def test_the_human_is_counted_and_its_priorities_kept_apart():
    buffer = ReplayBuffer(100)
    source = Source(buffer)
    source.episode(4)
    source.episode(6, human=True)
    assert buffer.human_count == 6
    buffer.update_priorities(np.arange(4), np.full(4, 2.0))
    buffer.update_priorities(np.arange(4, 10), np.full(6, 3.0))
    assert buffer.mean_priorities() == (2.0, 3.0)


def test_a_restored_buffer_draws_the_same():
    buffer = ReplayBuffer(30)
    source = Source(buffer)
    for _ in range(4):
        source.episode(11)
    buffer.update_priorities(np.arange(20), np.linspace(0.1, 5, 20))
    copy = ReplayBuffer(30)
    copy.load_state_dict(buffer.state_dict())
    a, b = (which.sample(32, np.random.default_rng(3)) for which in (buffer, copy))
    np.testing.assert_array_equal(a.indices, b.indices)
    np.testing.assert_array_equal(a.frames, b.frames)
    np.testing.assert_allclose(a.probabilities, b.probabilities)


def test_a_hundred_thousand_transitions_fit_into_400_mb():
    buffer = ReplayBuffer(100_000)
    parts = [*vars(buffer).values(), *vars(buffer._ring).values()]
    size = sum(part.nbytes for part in parts if isinstance(part, np.ndarray))
    assert size + buffer._trees[0]._nodes.nbytes < 400e6


def test_separate_buffers_are_drawn_from_by_their_size_and_within_by_priority():
    """RD2: however high the human's priorities, their number decides how often they are drawn."""
    buffer = ReplayBuffer(100, alpha=1.0, separate=True)
    source = Source(buffer)
    source.episode(30)
    source.episode(10, human=True)
    buffer.update_priorities(np.arange(30), np.linspace(1.0, 2.0, 30))
    buffer.update_priorities(np.arange(30, 40), np.array([70.0] + [10.0] * 9))
    batch = buffer.sample(4000, np.random.default_rng(0))
    assert batch.human.mean() == pytest.approx(0.25, abs=1e-3)
    assert np.mean(batch.indices == 30) == pytest.approx(0.25 * 70 / 160, abs=0.01)
    # Each probability is the frequency with which it is drawn.
    drawn, counts = np.unique(batch.indices, return_counts=True)
    where = {index: row for row, index in enumerate(batch.indices)}
    wanted = [batch.probabilities[where[index]] for index in drawn]
    np.testing.assert_allclose(counts / 4000, wanted, atol=0.004)


@pytest.mark.parametrize("human", [False, True])
def test_separate_buffers_of_which_one_is_empty(human):
    buffer = ReplayBuffer(20, separate=True)
    Source(buffer).episode(25, human=human)
    batch = buffer.sample(64, np.random.default_rng(0))
    assert (batch.human == human).all()
    copy = ReplayBuffer(20, separate=True)
    copy.load_state_dict(buffer.state_dict())
    again = copy.sample(64, np.random.default_rng(0))
    np.testing.assert_array_equal(batch.indices, again.indices)
    assert np.isfinite(batch.probabilities).all()


def test_a_slot_that_changes_hands_leaves_the_other_buffer():
    buffer = ReplayBuffer(10, separate=True)
    source = Source(buffer)
    source.episode(10, human=True)
    source.episode(10)
    assert buffer.human_count == 0
    assert not buffer.sample(64, np.random.default_rng(0)).human.any()


weights_lists = st.lists(st.floats(0, 100), min_size=1, max_size=70)


@given(weights_lists, st.lists(st.tuples(st.integers(0, 69), st.floats(0, 100)), max_size=40))
def test_sums_agree_with_a_plain_array(weights, changes):
    tree, plain = SumTree(len(weights)), np.array(weights)
    tree[np.arange(len(weights))] = plain
    for index, weight in changes:
        index %= len(weights)
        tree[np.array([index])] = np.array([weight])
        plain[index] = weight
    assert tree.total == pytest.approx(plain.sum())
    np.testing.assert_allclose(tree[np.arange(len(plain))], plain)


@given(weights_lists, st.floats(0, 1, exclude_max=True))
def test_find_inverts_the_cumulative_sum(weights, share):
    plain = np.array(weights)
    if plain.sum() < 1e-6:
        return
    tree = SumTree(len(plain))
    tree[np.arange(len(plain))] = plain
    (found,) = tree.find(np.array([share * tree.total]))
    assert plain[found] > 0
    cumulative = np.cumsum(plain)
    below = cumulative[found - 1] if found else 0.0
    tolerance = 1e-9 * tree.total
    assert below - tolerance <= share * tree.total <= cumulative[found] + tolerance


def test_of_an_index_named_twice_the_last_weight_counts():
    tree = SumTree(4)
    tree[np.array([2, 2])] = np.array([5.0, 1.0])
    assert tree.total == 1.0


def test_samples_are_in_proportion_to_the_weights():
    tree = SumTree(5)
    tree[np.arange(5)] = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    drawn = tree.sample(10_000, np.random.default_rng(0))
    shares = np.bincount(drawn, minlength=5) / 10_000
    np.testing.assert_allclose(shares, [0.0, 0.1, 0.2, 0.3, 0.4], atol=0.01)
