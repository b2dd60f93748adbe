"""``trainer picture`` and ``plot``: moments, films of take-overs, and curves of several runs."""

import csv

import numpy as np
import pytest
from PIL import Image, ImageSequence

from edge_runtime.cli import run_cli
from trainer.__main__ import main
from trainer.drivers import EXPERTS, TRIGGERS, make_environment
from trainer.human.guide import HumanGuide
from trainer.pictures import HUMAN, POLICY, draw_moment, drive_moments
from trainer.training.metrics import NAMES


class AlwaysDriveOn:
    """A policy that never brakes."""

    def reset(self):
        pass

    def act(self, _observation):
        return np.array([1.0], np.float32)


@pytest.fixture
def moments():
    env = make_environment("left_turn")
    guide = HumanGuide(EXPERTS["left_turn"](env), TRIGGERS["left_turn"](EXPERTS["left_turn"](env)))
    return list(drive_moments(env, AlwaysDriveOn(), guide, seed=8, seconds=20.0))


def test_a_take_over_shows_who_drives_and_both_actions(moments):
    taken = [moment for moment in moments if moment.intervention is not None]
    left = [moment for moment in moments[:-1] if moment.intervention is None]
    assert taken
    assert left
    assert all(moment.policy_action == 1.0 for moment in [*taken, *left])
    assert all(moment.action == float(moment.intervention.action[0]) for moment in taken)
    for moment, colour in ((taken[0], HUMAN), (left[0], POLICY)):
        pixels = np.asarray(draw_moment(moment, "pedal"))
        assert pixels.shape[2] == 3
        assert tuple(pixels[29, 30]) == colour


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


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["picture", "expert", "--out", "a.jpg"], "a picture is a .png, a film a .gif"),
        (["picture", "expert", "--human", "expert", "--out", "a.png"], "takes over in a film"),
        (["picture", "none", "--out", "a.gif"], "none is no policy"),
        (["plot", "one", "two"], "does not exist"),
    ],
)
def test_bad_input_is_one_line(words, part, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_cli(main, words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line
    assert list(tmp_path.iterdir()) == []


def test_curves_of_several_runs_end_with_the_shortest(tmp_path, capsys):
    for name, episodes in (("one", 30), ("two", 12)):
        (tmp_path / name).mkdir()
        with (tmp_path / name / "metrics.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, NAMES)
            writer.writeheader()
            for episode in range(episodes):
                row = dict.fromkeys(NAMES, 1.0) | {"episode": episode, "outcome": "goal"}
                writer.writerow(row | {"validation_success": 0.5 if episode % 5 == 4 else "nan"})
    dirs = [str(tmp_path / name) for name in ("one", "two")]
    assert run_cli(main, ["plot", *dirs]) == 2
    assert "--out F.png" in capsys.readouterr().err
    out = tmp_path / "curves.png"
    assert main(["plot", *dirs, "--out", str(out)]) == 0
    with Image.open(out) as picture:
        assert picture.size == (1100, 660)
