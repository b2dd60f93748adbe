"""Episodes driven side by side are those driven one after the other."""

import numpy as np
import pytest

from trainer.drivers import make_environment
from trainer.evaluation import drive_episodes, drive_together


class Brightness:
    """A driver without memory whose action follows its pictures."""

    def reset(self):
        """It has no memory."""

    def act(self, observation):
        return self.together(observation[None])[0]

    def together(self, observations):
        means = observations.mean(axis=(2, 3), dtype=np.float64) / 255.0
        return np.tanh(3.0 * (means[:, 1:] - 0.25)).astype(np.float32)


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
@pytest.mark.parametrize("condition", ["nominal", "noise"])
@pytest.mark.parametrize("lanes", [1, 3, 8])
def test_side_by_side_is_one_after_the_other(scenario, condition, lanes):
    driver, seeds = Brightness(), range(5)
    wanted = drive_episodes(make_environment(scenario), driver, seeds, condition)
    envs = [make_environment(scenario) for _ in range(lanes)]
    assert drive_together(envs, driver.together, seeds, condition) == wanted


def test_nobody_drives_where_there_is_no_seed():
    assert drive_together([make_environment("left_turn")], Brightness().together, []) == []
