"""What the policy and a person see of the congestion."""

from dataclasses import replace

import numpy as np
import pytest

from trainer.scenarios.congestion import CongestionEnv
from trainer.scenarios.picture import corners
from trainer.tests.test_congestion import CENTRED, STRAIGHT


def test_the_picture_moves_along_the_road_but_neither_aside_nor_round():
    def picture(offset_m: float, heading_rad: float) -> np.ndarray:
        config = replace(
            CENTRED,
            start_offset_m=(offset_m, offset_m),
            start_heading_rad=(heading_rad, heading_rad),
        )
        return CongestionEnv(config).reset(seed=0)[0][1]

    def ego_rows(frame: np.ndarray, columns: slice) -> float:
        ego = np.abs(frame[:, columns].astype(float) - 70.0) * (np.arange(45) > 17)[:, None]
        ego[27:] = 0.0
        return float((ego.sum(axis=1) * np.arange(45)).sum() / ego.sum())

    nose, tail = slice(34, 38), slice(26, 30)
    middle = ego_rows(picture(0.0, 0.0), nose)
    assert middle == pytest.approx(22.0, abs=0.05)
    # 0.3 m to the right is 0.8 pixels down; a heading of 0.05 rad tilts by 0.4 pixels in 8.
    assert ego_rows(picture(0.3, 0.0), nose) - middle == pytest.approx(0.8, abs=0.1)
    tilted = picture(0.0, 0.05)
    assert ego_rows(tilted, nose) - ego_rows(tilted, tail) == pytest.approx(0.4, abs=0.1)
    env = CongestionEnv(CENTRED)
    env.reset(seed=0)
    for _ in range(40):
        frames, *_ = env.step(STRAIGHT)
    assert env.ego.position[0] > 10.0
    assert ego_rows(frames[1], nose) == pytest.approx(middle, abs=0.05)


def test_no_lane_marking_is_in_the_picture():
    env = CongestionEnv(CENTRED)
    frames, _ = env.reset(seed=0)
    shapes = [env.ego.footprint, *(car.footprint for car in env.traffic)]
    free = np.ones((45, 80), bool)
    for shape in shapes:
        points = corners(shape) - [env.ego.position[0], 0.0]
        left, top = points.min(axis=0) - 0.4
        right, bottom = points.max(axis=0) + 0.4
        x = -12.0 + (np.arange(80) + 0.5) * 0.375
        y = (np.arange(45) - 22) * 0.375
        free &= ~np.outer((y > top) & (y < bottom), (x > left) & (x < right))
    inside = np.abs(np.arange(45) - 22) * 0.375 < 5.0
    assert free[inside].sum() > 500
    assert np.unique(frames[1][inside][free[inside]]).tolist() == [70]


def test_render_and_scene_show_what_is_there():
    env = CongestionEnv(render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 10
    scene = env.scene()
    assert [v["ego"] for v in scene["vehicles"]] == [True] + 8 * [False]
    assert scene["road_width_m"] == 10.5
    for _ in range(100):
        env.step(STRAIGHT)
    # The view goes with the car: it stays where it is in the picture.
    blue = (40, 120, 230)
    columns = [np.flatnonzero((p == blue).all(axis=2).any(axis=0)) for p in (first, env.render())]
    assert columns[0].min() == pytest.approx(columns[1].min(), abs=2)
