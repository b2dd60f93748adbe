"""The bench's peers are measured at the same work as ours."""

import math
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edge_runtime.util import UserError
from trainer.benches import learner
from trainer.benches.environment import highway_drive, our_drive
from trainer.benches.experience import gather
from trainer.benches.highway_picture import HighwayPicture, check_varies
from trainer.benches.peer_process import PeerProcess
from trainer.drivers import make_environment
from trainer.scenarios import SCENARIOS

PEERS_PYTHON = Path(__file__).parents[2] / ".venv-peers" / "bin" / "python"
"""`make bench` makes it."""

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


@pytest.mark.skipif(not PEERS_PYTHON.exists(), reason="no .venv-peers; `make bench` makes one")
def test_stable_baselines3_learns_from_our_experience_with_the_papers_networks():
    with learner._sb3(PEERS_PYTHON, 4, gather(20)) as sb3:
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
            # It draws on whole pixels, a small car up to one aside.
            assert differs[int(x) - 1 : int(x) + 2, int(y) - 1 : int(y) + 2].sum() >= 3
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
