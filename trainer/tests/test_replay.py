import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from trainer.learner.replay import ReplayBuffer, Transition, _find


def frame(value):
    """A picture that carries a number, so that frames can be told apart."""
    picture = np.zeros((45, 80), np.uint8)
    picture[0, :2] = value % 256, value // 256
    return picture


def number(picture):
    return int(picture[0, 0]) + 256 * int(picture[0, 1])


def pair(*values):
    return np.stack([frame(value) for value in values])


def sample(buffer, size=64, seed=0):
    return buffer.sample(size, np.random.default_rng(seed))


class Source:
    """Feeds episodes of numbered frames; step n is rewarded with n + 1, its action is n / 100.

    ``stored``: newer picture of a transition's first observation -> the older one, the rewards from
    it to the episode's end, and whether that end was terminal."""

    def __init__(self, buffer):
        self.buffer, self.next = buffer, 0
        self.stored: dict[int, tuple[int, list[float], bool]] = {}

    def episode(self, steps, human=False, goal=True):
        """``human``: whether it acts, or in every how many steps."""
        first, self.next = self.next, self.next + steps + 1
        for step in range(steps):
            now, last = first + step, step == steps - 1
            action, acts = np.array([step / 100], np.float32), bool(human) and step % human == 0
            ends = goal and last
            self.buffer.add(
                Transition(pair(max(now - 1, first), now), action, step + 1.0, pair(now, now + 1),
                           ends, human=acts)
            )  # fmt: skip
            rewards = [n + 1.0 for n in range(step, steps)]
            self.stored[now] = max(now - 1, first), rewards, goal
        self.buffer.end_episode()


def filled(*episodes, capacity=100, **options):
    """A buffer with episodes of so many steps, all the human's where the number is negative."""
    buffer = ReplayBuffer(capacity, **options)
    source = Source(buffer)
    for steps in episodes:
        source.episode(abs(steps), human=steps < 0)
    return buffer, source


@settings(max_examples=80)
@given(
    st.lists(st.tuples(st.integers(1, 30), st.booleans()), min_size=1, max_size=12),
    st.integers(8, 60),
    st.integers(1, 10),
)
def test_a_batch_holds_what_was_stored_and_not_yet_forgotten(episodes, capacity, steps):
    """Real terminals end an n-step sum; a timeout, or the newest step, is bootstrapped from."""
    buffer = ReplayBuffer(capacity, steps=steps, gamma=0.5)
    source = Source(buffer)
    for length, goal in episodes:
        source.episode(length, human=3, goal=goal)
    assert len(buffer) <= capacity
    if len(buffer) == 0:
        return
    batch = sample(buffer)
    for row, (before, now) in enumerate(batch.frames):
        older, rest, goal = source.stored[number(now)]
        assert number(now) in list(source.stored)[-len(buffer) :]
        rewards = rest[:steps]
        assert (number(before), batch.spans[row]) == (older, len(rewards))
        assert batch.rewards[row] == sum(0.5**k * reward for k, reward in enumerate(rewards))
        assert bool(batch.terminals[row]) == (goal and len(rest) <= steps)
        assert number(batch.next_frames[row, 1]) == number(now) + len(rewards)
        # Action and delta are the first step's.
        step = round(rewards[0]) - 1
        assert batch.actions[row] == np.float32(step / 100)
        assert bool(batch.human[row]) == (step % 3 == 0)


@pytest.mark.parametrize(
    ("overruled_value", "before"),
    [(None, (2 + 3 / 2 + 4 / 4 + 5 / 8, 4, 0.0)), (-10.0, (2 + 3 / 2 - 10 / 4, 2, 1.0))],
)
def test_a_return_ends_at_an_overruled_action_with_what_that_is_worth(overruled_value, before):
    """Steps 0 to 5 with rewards 1 to 6; the policy is overruled in step 3, and the human stays."""
    buffer = ReplayBuffer(20, steps=4, gamma=0.5, overruled_value=overruled_value)
    for step in range(6):
        buffer.add(
            Transition(pair(max(step - 1, 0), step), np.zeros(1, np.float32), step + 1.0,
                       pair(step, step + 1), step == 5, human=step >= 3, penalised=step == 3)
        )  # fmt: skip
    batch = sample(buffer, 200)
    assert batch.spans is not None
    found = zip(batch.rewards, batch.spans, batch.terminals, strict=True)
    rows = dict(zip(map(number, batch.frames[:, 1]), found, strict=True))
    assert sorted(rows) == list(range(6))
    assert rows[1] == before
    # The human's own return knows nothing of it.
    assert rows[3] == (4 + 5 / 2 + 6 / 4, 3, 1.0)


def test_probabilities_follow_equation_20():
    buffer, _ = filled(2, alpha=0.5)
    # Of an index that is named twice, the last priority counts.
    buffer.update_priorities(np.array([0, 1, 1]), np.array([1.0, 3.0, 16.0]))
    batch = sample(buffer, 1000)
    # 1^0.5 : 16^0.5 = 1 : 4.
    assert np.mean(batch.indices == 1) == pytest.approx(0.8, abs=0.01)
    assert set(np.round(batch.probabilities, 12)) == {0.2, 0.8}
    for bad in (np.nan, np.inf, -1.0):
        with pytest.raises(ValueError, match="finite"):
            buffer.update_priorities(np.array([0]), np.array([bad]))
    np.testing.assert_array_equal(sample(buffer, 1000).probabilities, batch.probabilities)


@pytest.mark.parametrize("separate", [False, True])
@pytest.mark.parametrize("steps", [11, -11])
def test_a_restored_buffer_draws_the_same(steps, separate):
    """Also of separate buffers of which one is empty."""
    buffer, _ = filled(*[steps] * 4, capacity=30, separate=separate)
    copy = ReplayBuffer(30, separate=separate)
    buffer.update_priorities(np.arange(20), np.linspace(0.1, 5, 20))
    copy.load_state_dict(buffer.state_dict())
    a, b = sample(buffer, seed=3), sample(copy, seed=3)
    assert (a.human == (steps < 0)).all()
    assert np.isfinite(a.probabilities).all()
    for name in ("indices", "frames", "probabilities"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name))


def test_a_hundred_thousand_transitions_fit_into_400_mb():
    buffer = ReplayBuffer(100_000)
    size = sum(part.nbytes for part in vars(buffer).values() if isinstance(part, np.ndarray))
    assert size < 400e6


def test_separate_buffers_are_drawn_from_by_their_size_and_within_by_priority():
    """RD2: however high the human's priorities, their number decides how often they are drawn."""
    buffer, _ = filled(30, -10, alpha=1.0, separate=True)
    priorities = np.concatenate([np.linspace(1.0, 2.0, 30), [70.0], np.full(9, 10.0)])
    buffer.update_priorities(np.arange(40), priorities)
    batch = sample(buffer, 4000)
    assert batch.human.mean() == pytest.approx(0.25, abs=1e-3)
    assert np.mean(batch.indices == 30) == pytest.approx(0.25 * 70 / 160, abs=0.01)
    # Each probability is the frequency with which it is drawn.
    _, where, counts = np.unique(batch.indices, return_index=True, return_counts=True)
    np.testing.assert_allclose(counts / 4000, batch.probabilities[where], atol=0.004)


@pytest.mark.parametrize(("steps", "share"), [((30, -10), 0.5), ((40,), 0.0), ((-40,), 1.0)])
def test_half_of_what_is_drawn_is_the_humans_where_there_are_both(steps, share):
    buffer, _ = filled(*steps, alpha=0.0, human_share=0.5)
    batch = sample(buffer, 4000)
    assert batch.human.mean() == share
    _, where, counts = np.unique(batch.indices, return_index=True, return_counts=True)
    np.testing.assert_allclose(counts / 4000, batch.probabilities[where], atol=0.002)


@pytest.mark.parametrize("steps", [(30, -10), (-10, 30), (30,)])
def test_what_is_shown_is_the_humans_whatever_its_priority(steps):
    buffer, _ = filled(*steps, shown=400)
    buffer.update_priorities(buffer.alive, np.arange(1.0, len(buffer) + 1))
    shown = sample(buffer).shown
    if steps == (30,):
        assert shown is None
        return
    assert shown.human.all()
    drawn = np.unique(shown.indices, return_counts=True)[1]
    assert len(drawn) == 10
    assert drawn.max() < 2 * drawn.min()


@given(st.lists(st.floats(0, 100), min_size=1, max_size=70), st.floats(0, 1, exclude_max=True))
def test_find_inverts_the_cumulative_sum(weights, share):
    plain = np.array(weights)
    assume(plain.sum() > 1e-6)
    (found,) = _find(plain, np.array([share]))
    assert plain[found] > 0
    total, above = plain.sum(), np.cumsum(plain)[found]
    assert above - plain[found] - 1e-9 * total <= share * total <= above + 1e-9 * total
