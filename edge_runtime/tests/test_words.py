import pytest

from edge_runtime.words import counted


@pytest.mark.parametrize(
    ("count", "words"), [(0, "0 safe stops"), (1, "1 safe stop"), (2, "2 safe stops")]
)
def test_one_is_not_many(count, words):
    assert counted(count, "safe stop") == words
