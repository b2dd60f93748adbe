"""The bench measures what it says, and its arithmetic is right. No test asks how fast."""

import json
import math
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edge_runtime.errors import UserError
from trainer.benches import learner, training
from trainer.benches.effort import QUICK
from trainer.benches.environment import HIGHWAY, OURS, highway_drive, our_drive
from trainer.benches.environment import summary as environment_summary
from trainer.benches.experience import fill, gather
from trainer.benches.highway_picture import HighwayPicture, check_varies
from trainer.benches.memory import resident_bytes
from trainer.benches.peer_process import PeerProcess
from trainer.benches.table import Row, rows
from trainer.benches.training import Episode
from trainer.benches.turns import compare, median, take_turns
from trainer.benches.updates import Updates
from trainer.commands import bench
from trainer.drivers import make_environment
from trainer.learner.replay import ReplayBuffer
from trainer.learner.td3 import Losses
from trainer.scenarios import SCENARIOS
from trainer.tests.test_commands import call

TINY = replace(
    QUICK,
    batch_size=4,
    learner_rounds=1,
    updates_per_round=1,
    environment_rounds=2,
    steps_per_round=10,
    training_episodes=1,
    own_updates=1,
    replay_transitions=300,
    replay_draws=3,
    memory_episodes=1,
)

PEER = """
import sys
print('{"peer": "fake", "argument": "%s"}' % sys.argv[1], flush=True)
for line in sys.stdin:
    print([float(i + 1) for i in range(int(line))], flush=True)
"""


def peer(tmp_path, code: str = PEER) -> PeerProcess:
    script = tmp_path / "peer.py"
    script.write_text(code)
    return PeerProcess("the fake peer", [sys.executable, "-I", str(script), "x"])


# Turns and ratios


def test_contenders_take_turns_and_none_is_always_first():
    calls: list[str] = []

    def work(name: str) -> list[float]:
        calls.append(name)
        return [1.0]

    contenders = {name: partial(work, name) for name in "abc"}
    ticks: list[str] = []
    times = take_turns(contenders, 4, ticks.append)
    assert "".join(calls) == "abc" + "abc" + "bca" + "cab" + "abc"
    assert times == {name: [[1.0]] * 4 for name in "abc"}
    assert len(ticks) == 4


def test_ratios_are_of_medians_and_of_rounds():
    ours, peers = [[1.0, 2.0, 3.0], [10.0, 10.0, 10.0]], [[4.0, 4.0, 4.0], [30.0, 30.0, 30.0]]
    assert median(ours) == 6.5
    assert compare(ours, peers) == (17.0 / 6.5, 2.5)


def test_a_slow_round_cancels_out_of_the_rounds_ratio():
    ours, peers = [[1.0], [9.0], [1.0]], [[3.0], [27.0], [3.0]]
    assert compare(ours, peers).median_of_rounds == 3.0


def test_learner_summary():
    times_ms = {learner.OURS: [[20.0], [30.0]], learner.SB3: [[100.0], [90.0]]}
    figures = learner.summary(times_ms, {learner.SB3: {"threads": 1}})
    assert figures["ms_per_update"] == 25.0
    assert figures["updates_per_s"] == 40.0
    assert figures["peers"] == {
        learner.SB3: {
            "ms_per_update": 95.0,
            "ratio": {"of_medians": 3.8, "median_of_rounds": 4.0},
            "about": {"threads": 1},
        }
    }


def test_environment_summary():
    figures = environment_summary({OURS: [[0.0005]], HIGHWAY: [[0.004]]})
    assert figures["steps_per_s"] == 2000.0
    assert figures["peers"][HIGHWAY]["steps_per_s"] == 250.0
    assert figures["peers"][HIGHWAY]["ratio"]["of_medians"] == 8.0


def test_training_summary_scales_and_weighs_by_steps():
    parts = {"environment": 0.1, "acting": 0.2, "learning": 3.0, "waiting": 0.0}
    episodes = [Episode(100, 4.0, parts, 30.0), Episode(300, 12.0, parts, 40.0)]
    figures = training.summary(episodes)
    assert figures["steps"] == 400
    assert figures["s_per_10k_steps"] == pytest.approx(
        {"total": 400.0, "environment": 5.0, "acting": 10.0, "learning": 150.0, "waiting": 0.0}
    )
    # Alone: 100 updates of 30 ms and 300 of 40 ms.
    assert figures["learner_alone_s_per_10k_updates"] == pytest.approx(375.0)
    ratio = figures["ratio_to_learner_alone"]
    assert ratio["of_sums"] == pytest.approx(16.0 / 15.0)
    assert ratio["median_of_episodes"] == pytest.approx((4.0 / 3.0 + 1.0) / 2)


# The peer in a process of its own


def test_a_peer_greets_and_answers_with_its_times(tmp_path):
    with peer(tmp_path) as fake:
        assert fake.about == {"peer": "fake", "argument": "x"}
        assert fake.run(3) == [1.0, 2.0, 3.0]
        assert fake.run(1) == [1.0]
        process = fake._process
    assert process.poll() is not None


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import no_such_library", "No module named 'no_such_library'"),
        ("print('hello')", "not JSON"),
        ("print([1])", "not a dict"),
        ("print({}, flush=True)\ninput()\nprint([1.0])", "asked for 2 times"),
        ("print({}, flush=True)\ninput()\nprint([1.0, float('nan')])", "not JSON|asked for 2"),
        ("print({}, flush=True)\ninput()\nraise SystemExit('no more')", "status 1: no more"),
    ],
)
def test_a_peer_that_fails_is_said_in_one_line(code, said, tmp_path):
    with pytest.raises(UserError, match=said), peer(tmp_path, code) as fake:
        fake.run(2)


def test_a_peer_does_not_see_our_libraries(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    seen = "import os\nprint('{\"seen\": %d}' % ('PYTHONPATH' in os.environ))"
    with peer(tmp_path, seen) as fake:
        assert fake.about == {"seen": 0}


def test_stable_baselines3_learns_from_our_experience_with_the_papers_networks():
    pytest.importorskip("stable_baselines3")
    with learner._sb3(Path(sys.executable), 4, gather(20)) as sb3:
        assert sb3 is not None
        # Tables A2 and A3: 1,792 features through 256, 128 and 64; the critics also see the action.
        trunk = 6 * 2 * 36 + 6 + 16 * 6 * 36 + 16
        head = 1792 * 256 + 256 + 256 * 128 + 128 + 128 * 64 + 64 + 64 + 1
        assert sb3.about["actor_parameters"] == trunk + head
        assert sb3.about["critic_parameters"] == trunk + 2 * (head + 256)
        assert all(math.isfinite(time_ms) for time_ms in sb3.run(2))


# highway-env's picture


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("driver", [None, "dummy"])
def test_highway_envs_picture_shows_the_cars_where_they_are(scenario, driver, monkeypatch):
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    env = make_environment(scenario)
    picture = HighwayPicture(env)
    picture.reset(seed=3)
    for _ in range(5):
        shown, _ = picture.step(np.zeros(env.action_space.shape, np.float32))
    with_cars, cars = shown[-1].copy(), [*env.traffic, env.ego]
    empty = SimpleNamespace(**{**vars(picture.scene.road), "vehicles": []})
    monkeypatch.setattr(type(picture.scene), "road", property(lambda scene: empty))
    without = picture.scene.observation().observe()[-1].copy()
    differs = with_cars != without
    view, seen, elsewhere = env.rasteriser, 0, differs.copy()
    for car in cars:
        x, y = (car.position - env.view_corner_m) / view.metres_per_pixel
        if 2 < x < differs.shape[0] - 2 and 2 < y < differs.shape[1] - 2:
            seen += 1
            assert differs[int(x) - 1 : int(x) + 2, int(y) - 1 : int(y) + 2].all()
            reach = int(car.LENGTH / view.metres_per_pixel)
            elsewhere[
                max(int(x) - reach, 0) : int(x) + reach, max(int(y) - reach, 0) : int(y) + reach
            ] = False
    assert seen >= 2
    # Nothing else has changed, but for cars that only touch the picture's edge.
    assert not elsewhere[6:-6, 6:-6].any()
    assert os.environ.get("SDL_VIDEODRIVER") == driver


def test_a_viewer_that_draws_nothing_is_found_out():
    picture = HighwayPicture(make_environment("left_turn"))
    picture.scene._observation.viewer.enabled = False
    with pytest.raises(RuntimeError, match="same picture"):
        check_varies(picture)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_both_drives_meet_the_same_traffic(scenario):
    ours, highways = our_drive(scenario), highway_drive(scenario)
    for drive in (ours, highways):
        (time_s,) = drive.run(150)
        assert time_s > 0
    assert ours.episodes == highways.episodes > 0


# Our own side


def test_an_update_draws_learns_and_sets_the_new_priorities():
    class Recorder:
        seen: list = []  # noqa: RUF012

        def update(self, batch, beta):
            self.seen.append(batch)
            return Losses(0.0, 0.0, 0.0, 0.0, np.full(len(batch.indices), 7.0))

    replay, experience = ReplayBuffer(50), gather(50)
    fill(replay, experience)
    times_ms = Updates(Recorder(), replay, batch_size=8).run(3)
    assert len(times_ms) == 3
    assert [len(batch.indices) for batch in Recorder.seen] == [8, 8, 8]
    drawn = np.concatenate([batch.indices for batch in Recorder.seen])
    assert (replay._priorities[drawn] == 7.0).all()
    assert 0 < experience.human.sum() < 50


def test_the_whole_report():
    ticks: list[str] = []
    ballast = np.ones(100_000_000)
    report = bench.measure(list(bench.ROUNDS), TINY, None, ticks.append)
    json.dumps(report, allow_nan=False)
    assert len(ticks) == sum(rounds(TINY) for rounds in bench.ROUNDS.values())
    assert {"machine", "threads", "torch", "source_revision"} <= set(report)
    assert report["learner_ms_per_update"] == report["learner"]["ms_per_update"] > 0
    assert set(report["environment_steps_per_s"]) == set(SCENARIOS)
    assert set(report["train_s_per_10k_steps"]) == {
        "total", "environment", "acting", "learning", "waiting",
    }  # fmt: skip
    assert report["replay"]["transitions"] == 300
    # 3,600 bytes a picture, at least one for each transition.
    assert report["replay"]["allocated_mb"] > 300 * 3600e-6
    assert report["memory"]["training_peak_mb"] > 50
    if sys.platform == "linux":
        # The training's own memory, and none of ours.
        assert report["memory"]["training_peak_mb"] < 1e-6 * resident_bytes("VmHWM") - 200
    assert ballast.nbytes == 800_000_000
    lines = rows(report)
    assert any("left out" in line.peer for line in lines)
    assert {line.bar.split("  ")[0] for line in lines} == {"", "≥ 10", "≤ 1.15", "< 400"}


def test_the_table_says_which_bars_are_missed():
    figures = environment_summary({OURS: [[0.001]], HIGHWAY: [[0.009]]})
    assert rows({"environment": {"left_turn": figures}}) == [
        Row(
            "left_turn with observation, steps/s",
            "1000",
            "111  highway-env grayscale",
            "9.00",
            "≥ 10  MISSED",
        )
    ]


def test_only_some_parts_are_measured_and_written(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "FULL", TINY)
    out = tmp_path / "b.json"
    status, table, _ = call(capsys, "bench", "--only", "environment", "--out", str(out))
    assert status == 0
    assert "highway-env grayscale" in table
    report = json.loads(out.read_text())
    assert set(report["environment_steps_per_s"]) == set(SCENARIOS)
    assert "learner_ms_per_update" not in report
    assert "train_s_per_10k_steps" not in report


@pytest.mark.parametrize(
    "arguments", [("--only", "learner,speed"), ("--only", ""), ("--peers", "{tmp}/python")]
)
def test_bad_options_get_one_line_and_status_2(arguments, capsys, tmp_path):
    arguments = tuple(a.format(tmp=tmp_path) for a in arguments)
    status, out, err = call(capsys, "bench", *arguments)
    assert (status, out, len(err.strip().splitlines())) == (2, "", 1)
