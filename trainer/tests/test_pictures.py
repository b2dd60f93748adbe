import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from trainer.__main__ import main
from trainer.drivers import EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import HumanGuide
from trainer.pictures import HUMAN, POLICY, draw_moment, drive_moments
from trainer.tests.test_commands import refusal
from trainer.training.metrics import EpisodeMetrics, MetricsWriter


def test_a_take_over_shows_who_drives_and_both_actions():
    env = make_environment("left_turn")
    expert = EXPERTS["left_turn"](env)
    guide = HumanGuide(expert, TRIGGERS["left_turn"](expert))
    never_brakes, _ = load_driver("constant:1", env)
    moments = list(drive_moments(env, never_brakes, guide, seed=8, seconds=20.0))
    taken = [moment for moment in moments if moment.intervention]
    left = [moment for moment in moments[:-1] if not moment.intervention]
    assert all(moment.policy_action == 1.0 for moment in [*taken, *left])
    assert all(m.action == m.intervention.action[0] for m in moments if m.intervention)
    for moment, colour in ((taken[0], HUMAN), (left[0], POLICY)):
        assert tuple(np.asarray(draw_moment(moment, "pedal"))[29, 30]) == colour


def test_the_commands_film_is_small_and_plays_in_real_time(tmp_path):
    out = tmp_path / "drive.gif"
    words = ["picture", "expert", "--seed", "6", "--time", "2", "--out", str(out)]
    assert main(words) == 0
    with Image.open(out) as film:
        # Equal pictures are merged, and stay for longer.
        times_ms = [each.info["duration"] for each in ImageSequence.Iterator(film)]
        assert film.info["loop"] == 0
    assert sum(times_ms) == 19 * 100 + 1500
    assert out.stat().st_size < 500_000


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
