import pytest

from edge_runtime.util import UserError
from trainer.learner.config import LearnerConfig


@pytest.mark.parametrize("offset", [0.0, -1e-3, 1e-45, float("inf"), float("nan")])
def test_the_constant_that_keeps_transitions_drawable_is_above_zero(offset):
    with pytest.raises(UserError, match=r"priority_offset = .* out of range: it must be above 0"):
        LearnerConfig(priority_offset=offset)


@pytest.mark.parametrize(
    ("name", "value", "range_"),
    [
        ("gamma", 1.5, "0 to 1"),
        ("batch_size", 0, "at least 1"),
        ("intervention_penalty", float("nan"), "it must be a finite number"),
    ],
)
def test_what_is_out_of_range_is_told_the_range(name, value, range_):
    with pytest.raises(UserError, match=f"{name} = {value} is out of range: {range_}"):
        LearnerConfig(**{name: value})
    LearnerConfig(priority_offset=1e-30, gamma=1.0, batch_size=1)
