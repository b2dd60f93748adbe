import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.learner.replay import SumTree

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
