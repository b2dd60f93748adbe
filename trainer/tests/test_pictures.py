import math
from pathlib import Path

import numpy as np
from PIL import Image

from trainer.__main__ import main
from trainer.environments import make_environment
from trainer.tests.test_commands import refusal
from trainer.training.metrics import EpisodeMetrics, MetricsWriter


def test_the_command_draws_the_moment_after_so_many_seconds(tmp_path):
    out = tmp_path / "scene.png"
    assert main(["picture", "constant:0", "--seed", "6", "--time", "0.3", "--out", str(out)]) == 0
    env = make_environment("left_turn")
    env.reset(seed=6)
    for _ in range(3):
        env.step(np.zeros(1, np.float32))
    with Image.open(out) as picture:
        assert np.array_equal(np.asarray(picture), env.render())


def test_curves_of_several_runs_end_with_the_shortest(tmp_path, capsys):
    dirs = [str(tmp_path / name) for name in ("one", "two")]
    for directory, episodes in zip(dirs, (30, 12), strict=True):
        writer = MetricsWriter(Path(directory))
        for episode in range(episodes):
            validated = 0.5 if episode % 5 == 4 else math.nan
            writer.add(EpisodeMetrics(episode, steps=9, validation_success=validated))
        writer.close()
    assert "--out F.png" in refusal(capsys, "plot", *dirs)
    out = tmp_path / "curves.png"
    assert main(["plot", *dirs, "--out", str(out)]) == 0
    with Image.open(out) as picture:
        assert picture.size == (1100, 660)
