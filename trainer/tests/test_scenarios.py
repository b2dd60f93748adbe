import copy
import hashlib
import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.environments import make_environment
from trainer.evaluation import drive_episodes
from trainer.human.guide import HumanGuide, steps_held
from trainer.scenarios import SCENARIOS
from trainer.scenarios import picture as pictures
from trainer.scenarios.left_turn import LeftTurnConfig, LeftTurnEnv, LeftTurnPath
from trainer.scenarios.picture import Rectangle

every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)


@every_scenario
def test_gymnasiums_and_stable_baselines3s_checkers_pass(scenario):
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    check_env(gymnasium.make(SCENARIOS[scenario]).unwrapped, skip_render_check=True)
    check_for_sb3(gymnasium.make(SCENARIOS[scenario]).unwrapped, warn=False)


@every_scenario
def test_standing_changes_the_ego_cars_speed_and_nothing_else(scenario):
    def start(**options):
        frames, info = env.reset(seed=4, options=options)
        cars = [(car.speed, *car.position) for car in env.traffic]
        return info["speed_mps"], [frames.tolist(), env.ego.position.tolist(), cars]

    env = make_environment(scenario)
    moving, standing = start(), start(standing=True)
    assert moving[0] > standing[0] == 0.0
    assert moving[1] == standing[1]
    assert start() == moving


@pytest.mark.parametrize(
    ("scenario", "condition", "drives", "arriving"),
    [
        ("left_turn", "nominal", 30, 30),
        ("left_turn", "variant", 12, 11),
        ("left_turn", "dense", 12, 12),
        ("congestion", "noise", 10, 10),  # of pictures, which the expert does not look at
        ("congestion", "variant", 12, 11),
        ("congestion", "dense", 12, 12),
    ],
)
def test_the_expert_arrives(scenario, condition, drives, arriving):
    env = make_environment(scenario, condition)
    results = drive_episodes(env, env.expert(), range(drives), condition)
    assert sum(result.outcome == "goal" for result in results) >= arriving


@every_scenario
@pytest.mark.parametrize("condition", ["nominal", "variant"])
def test_cars_move_to_the_bit_as_highway_envs_idm_vehicles(scenario, condition):
    """Also at speeds, gaps and headings of the ego car that no episode would bring; but whoever
    would brake beyond a stop stands."""
    env, random = make_environment(scenario, condition), np.random.default_rng(0)
    dt_s = env.config.control_period_s
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(40):
            car = env.traffic[random.integers(len(env.traffic))]
            car.speed = float(random.uniform(0.0, 12.0))
            car.position[0] += random.uniform(-1.0, 1.0)
            env.ego.heading = float(random.uniform(-0.3, 0.3))
            for car in env.traffic:
                twin, start = copy.copy(car), (car.position.copy(), car.speed)
                wanted = IDMVehicle.acceleration(twin, twin, twin.leader)
                wanted = float(min(max(wanted, -car.ACC_MAX), car.ACC_MAX))
                action = {"steering": 0.0, "acceleration": max(wanted, -car.speed / dt_s)}
                twin.position, twin.action = car.position.copy(), action
                Vehicle.step(twin, dt_s)
                car.act()
                assert car.action["acceleration"] == wanted
                car.step(dt_s)
                assert car.position.tolist() == twin.position.tolist()
                assert (car.heading, car.speed) == (twin.heading, twin.speed)
                car.position[:], car.speed = start
            env.step(np.zeros(1, np.float32))


# Whole episodes, pinned: whoever makes a scenario faster must not change it. A digest covers
# pictures to the bit and numbers to 1e-9: far more than another libm changes, far less than another
# model does. `python -m trainer.tests.test_scenarios` prints new digests.
QUEUE = LeftTurnConfig(traffic_cars=8, first_car_m=(-30.0, 12.0), short_gap_m=(7.0, 9.0))
"""A longer queue than usual, closely packed: the followers brake."""


def random_driver(env, seed):
    """A restless action that favours one side: in the left turn the throttle."""
    random = np.random.default_rng(seed)
    while True:
        yield random.uniform(-0.6, 1.0, 1).astype(np.float32), ""


def expert_driver(env, seed):
    expert = env.expert()
    while True:
        yield expert.act(env.frames), ""


def guided_driver(env, seed):
    """A policy that drives on, then one that stands still, under the guide's eyes."""
    expert = env.expert()
    guide = HumanGuide(expert, env.expert(), steps_held(0.1))
    for action, _ in random_driver(env, seed):
        wanted = -np.abs(action) if seed % 2 else action
        taken = guide.watch(env.frames, wanted)
        yield (taken.action, f"{taken.reason} {taken.first}") if taken else (wanted, "passes")


EPISODES: list[tuple[Any, ...]] = [
    ("99a651c9237ffb06", random_driver, 8, LeftTurnEnv),
    ("3f816926ad56a5b6", expert_driver, 6, LeftTurnEnv),
    ("0f2bcfc8346c08a9", guided_driver, 8, LeftTurnEnv),
    ("c252a806eb914614", guided_driver, 4, LeftTurnEnv, QUEUE),
    ("33f19cff22bc9157", expert_driver, 4, make_environment, "left_turn", "variant"),
    ("b446e260c41008d3", random_driver, 6, make_environment, "congestion"),
    ("4654583381419aa3", expert_driver, 2, make_environment, "congestion"),
    ("9ced478a7e3e511b", expert_driver, 2, make_environment, "congestion", "variant"),
    ("321961c59e49aa7b", expert_driver, 4, make_environment, "left_turn", "dense"),
    ("26ec6b10e5023e4e", expert_driver, 2, make_environment, "congestion", "dense"),
]
"""What the digest begins with; who drives, in how many episodes, in which environment."""


def numbers(*values: float) -> bytes:
    """Values to 1e-9; the sum takes the sign off a zero."""
    return " ".join(repr(round(float(value), 9) + 0.0) for value in values).encode()


def digest(drive, episodes, make, *arguments):
    env, digest = make(*arguments), hashlib.sha256()
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        digest.update(observation.tobytes())
        for action, remark in drive(env, seed):
            observation, reward, terminated, truncated, info = env.step(action)
            digest.update(observation.tobytes() + remark.encode())
            digest.update(str(info.pop("outcome", "")).encode())
            digest.update(numbers(*action, reward, *info.values()))
            for car in env.scene()["vehicles"]:
                digest.update(numbers(car["x"], car["y"], car["heading_rad"], car["speed_mps"]))
            if terminated or truncated:
                break
    return digest.hexdigest()


@pytest.mark.parametrize("row", EPISODES, ids=lambda row: row[0])
def test_episodes_are_what_they_were(row):
    golden, *episodes = row
    assert digest(*episodes).startswith(golden)


rectangles = st.builds(
    Rectangle, *(st.floats(*ends) for ends in ((-6, 6), (-6, 6), (-4, 4), (0.5, 6), (0.5, 3)))
)


@settings(max_examples=200)
@given(rectangles, rectangles)
def test_overlap_is_symmetric_and_agrees_with_sampled_points(a, b):
    assert pictures.overlap(a, b) == pictures.overlap(b, a)
    u, v = np.mgrid[-0.5:0.5:21j, -0.5:0.5:21j] * np.array([a.length, a.width])[:, None, None]
    cos, sin = math.cos(a.heading), math.sin(a.heading)
    dx, dy = a.x + u * cos - v * sin - b.x, a.y + u * sin + v * cos - b.y
    cos, sin = math.cos(b.heading), math.sin(b.heading)
    along, across = np.abs(dx * cos + dy * sin), np.abs(dy * cos - dx * sin)
    if ((along < b.length / 2) & (across < b.width / 2)).any():
        assert pictures.overlap(a, b)


path = LeftTurnPath((2.0, 14.0), straight_m=10.0, radius_m=6.0)


@given(st.floats(0, 30), st.floats(-2, 2))
def test_projection_inverts_the_pose(s_m, right_m):
    pose = path.pose(s_m)
    x = pose.x - right_m * math.sin(pose.heading)
    y = pose.y + right_m * math.cos(pose.heading)
    assert path.project(x, y) == pytest.approx((s_m, right_m), abs=1e-9)


view = pictures.Rasteriser(left_m=-20.0, top_m=-11.25, metres_per_pixel=0.5)
roads = [Rectangle(0.0, 0.4, 0.0, 90.0, 7.3), Rectangle(3.0, 9.0, 1.5, 20.0, 8.0)]
paved = pictures.Rasteriser(view.left_m, view.top_m, view.metres_per_pixel, roads)


def _plain_frame(traffic: list[Rectangle], ego: Rectangle) -> np.ndarray:
    """One rectangle after another, each blended into the whole picture."""
    picture = paved.background.copy()
    x = view.left_m + (np.arange(pictures.COLUMNS) + 0.5) * view.metres_per_pixel
    y = view.top_m + (np.arange(pictures.ROWS)[:, None] + 0.5) * view.metres_per_pixel
    for shape, value in [*((car, pictures.TRAFFIC) for car in traffic), (ego, pictures.EGO)]:
        cos, sin = math.cos(shape.heading), math.sin(shape.heading)
        along = np.abs((x - shape.x) * cos + (y - shape.y) * sin)
        across = np.abs((y - shape.y) * cos - (x - shape.x) * sin)
        inside = np.ones_like(along)
        for offset_m, side_m in ((along, shape.length), (across, shape.width)):
            inside *= np.clip((0.5 * side_m - offset_m) / view.metres_per_pixel + 0.5, 0.0, 1.0)
        picture += inside * (value - picture)
    return (picture + 0.5).astype(np.uint8)


def _cars(headings: st.SearchStrategy[float]) -> st.SearchStrategy[Rectangle]:
    """Also outside the picture, across its edges, and into each other: the ego car is on top."""
    sides = st.floats(2.0, 8.0), st.floats(0.8, 2.5)
    return st.builds(Rectangle, st.floats(-26, 26), st.floats(-14, 14), headings, *sides)


straight, turned = _cars(st.just(0.0)), _cars(st.floats(-4, 4))


@given(st.lists(straight, max_size=11) | st.lists(straight | turned, max_size=4), turned)
def test_cars_drawn_at_once_are_to_the_bit_those_drawn_one_after_another(traffic, ego):
    assert np.array_equal(paved.frame(traffic, ego), _plain_frame(traffic, ego))


if __name__ == "__main__":
    for _, *drives in EPISODES:
        print(digest(*drives)[:16], *drives[2:])
