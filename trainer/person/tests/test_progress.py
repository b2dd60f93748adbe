"""What a person is told of the learner."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest

from trainer.person.run import PersonRun
from trainer.training.config import RunConfig


@pytest.mark.parametrize(
    ("added", "loss", "said"),
    [
        (0, math.nan, "not learning yet (0 of 256 steps)"),
        (255, math.nan, "not learning yet (255 of 256 steps)"),
        (256, math.nan, "critic loss –"),
        (900, 0.1239, "critic loss 0.124"),
    ],
)
def test_before_it_learns_it_says_so_instead_of_nan(added, loss, said):
    config = RunConfig()
    assert config.learner.warmup_steps == 256
    run: Any = SimpleNamespace(config=config, learning=SimpleNamespace(added=added))
    assert PersonRun._learned(cast(PersonRun, run), loss) == said
