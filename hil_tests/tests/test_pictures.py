"""``python -m hil_tests pictures``: what is drawn of a drive, and that every picture is listed."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from bridge.scene import Scene
from bridge.tests.commands import make_command
from edge_runtime.cli import run_cli
from edge_runtime.errors import UserError
from edge_runtime.tests.harness import make_state
from hil_tests.__main__ import main
from hil_tests.pictures import command, headless
from hil_tests.pictures.curves import success_against_latency
from hil_tests.pictures.loop import Trips
from hil_tests.pictures.scenes import FILM_POLICY, FILM_SEED, policy_sees
from trainer.drivers import EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import HumanGuide
from trainer.picture import drive_moments

DOCS = Path(__file__).parents[2] / "docs"
MS = 10**6


def test_the_table_of_pictures_is_that_of_the_command():
    text = (DOCS / "README.md").read_text()
    listed = re.findall(r"^\| \[(\S+)\]", text, re.M)
    assert set(command.PICTURES) <= set(listed)
    assert [name for name in listed if not (DOCS / name).is_file()] == []


def test_every_picture_is_small():
    heavy = [path.name for path in DOCS.glob("*.*") if path.stat().st_size > 2_000_000]
    assert heavy == []


def test_the_guide_in_the_film_brakes_for_the_crash_and_hands_the_wheel_back():
    env = make_environment("left_turn")
    driver, expert = (load_driver(name, env)[0] for name in (FILM_POLICY, "expert"))
    guide = HumanGuide(expert, TRIGGERS["left_turn"](EXPERTS["left_turn"](env)))
    moments = list(drive_moments(env, driver, guide, int(FILM_SEED), 15.0))
    taken = [number for number, each in enumerate(moments) if each.intervention]
    first = moments[taken[0]]
    assert first.intervention is not None
    assert (first.intervention.reason, first.action) == ("collision", -1.0)
    assert all(moments[number].action < 0.0 < moments[number].policy_action for number in taken)
    assert taken == list(range(taken[0], taken[-1] + 1))
    assert taken[-1] < len(moments) - 10
    assert env.distance_m > 20.0
    with Image.open(DOCS / "take_over.gif") as film:
        assert len(list(ImageSequence.Iterator(film))) == len(moments)


def test_a_round_trip_is_drawn_in_its_parts_and_a_lost_state_as_lost():
    trips = Trips()
    for step in (0, 1, 3):
        sent_ns = step * 100 * MS
        trips.take(make_state(step, sent_ns=sent_ns))
        trips.take(make_command(step, received_ns=sent_ns + 40 * MS, sent_ns=sent_ns + 43 * MS))
    trips.take(Scene(episode=0, step=3, sim_time_s=0.3, round_trip_ms=90.0, answered_step=1))
    for trip, downlink_ms in zip(trips.trips.values(), (0.0, 47.0, 0.0), strict=True):
        assert trip.parts_ms == pytest.approx((40.0, 3.0, downlink_ms))
    assert trips.lost_s() == pytest.approx([0.2])


def test_a_new_episode_begins_behind_the_last_one():
    trips = Trips()
    for episode, step in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 1)):
        trips.take(make_state(step, episode=episode))
    *times_s, last_s = (trip.time_s for trip in trips.trips.values())
    assert trips.begins_s() == [times_s[3], last_s]


def test_only_the_first_answer_to_a_state_counts():
    trips = Trips()
    trips.take(make_state(0, sent_ns=0))
    for sent_ns in (50 * MS, 250 * MS):  # A safe stop is repeated.
        command_ = make_command(0, mode="safe_stop", received_ns=45 * MS, sent_ns=sent_ns)
        trips.take(command_)
    (trip,) = trips.trips.values()
    assert trip.parts_ms == pytest.approx((45.0, 5.0, 0.0))
    assert trip.mode == "safe_stop"


def test_pictures_of_what_is_kept_are_pictures(tmp_path):
    for make in (policy_sees, success_against_latency):
        out = tmp_path / f"{make.__name__}.png"
        make(out, tmp_path)
        with Image.open(out) as picture:
            assert min(picture.size) > 400
            assert len(np.unique(np.asarray(picture.convert("L")))) > 8


def test_one_that_cannot_be_made_does_not_keep_the_others_from_it(monkeypatch, tmp_path, capsys):
    def fail(_out, _work):
        raise UserError("no viewer here")

    def write(out, _work):
        out.write_bytes(b"picture")

    monkeypatch.setattr(command, "PICTURES", {"a.png": fail, "b.png": write})
    assert main(["pictures", "--out", str(tmp_path)]) == command.SOME_MISSING
    assert (tmp_path / "b.png").read_bytes() == b"picture"
    assert capsys.readouterr().err == "a.png: not made: no viewer here\n"
    assert main(["pictures", "b.png", "--out", str(tmp_path)]) == 0


@pytest.mark.parametrize(
    ("words", "part"),
    [(["x.png"], "no picture 'x.png'"), (["--out", "/dev/null"], "Not a directory")],
)
def test_bad_input_is_one_line(words, part, capsys):
    assert run_cli(main, ["pictures", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line


def test_a_viewer_that_ends_as_it_draws_is_said(monkeypatch):
    monkeypatch.setattr(headless, "_connect", lambda viewer, _url: viewer)
    with pytest.raises(UserError, match="mesa-vulkan-drivers"), headless.headless_viewer():
        raise ConnectionError("transport error")
