import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.scenarios.geometry import Rectangle
from trainer.scenarios.rasteriser import EGO, GROUND, TRAFFIC, Rasteriser

view = Rasteriser(left_m=-20.0, top_m=-11.25, metres_per_pixel=0.5)


def _drawn(shape: Rectangle) -> np.ndarray:
    picture = np.zeros((45, 80), np.float32)
    view.draw(picture, shape, 1.0)
    return picture


@given(st.floats(-12, 12), st.floats(-6, 6), st.floats(-4, 4))
def test_the_drawn_area_is_the_rectangles(x, y, heading):
    area_m2 = _drawn(Rectangle(x, y, heading, 5.0, 2.0)).sum() * 0.25
    assert area_m2 == pytest.approx(10.0, rel=0.06)


@given(st.floats(-12, 12), st.floats(-6, 6), st.floats(-4, 4))
def test_the_centre_of_mass_shows_movements_below_a_pixel(x, y, heading):
    picture = _drawn(Rectangle(x, y, heading, 5.0, 2.0))
    rows, columns = np.mgrid[:45, :80]
    mass_x = (columns * picture).sum() / picture.sum() * 0.5 - 20.0 + 0.25
    mass_y = (rows * picture).sum() / picture.sum() * 0.5 - 11.25 + 0.25
    assert (mass_x, mass_y) == pytest.approx((x, y), abs=0.06)


def test_what_lies_outside_leaves_no_trace_and_what_is_cut_off_no_error():
    assert not _drawn(Rectangle(100.0, 0.0, 0.3, 5.0, 2.0)).any()
    assert _drawn(Rectangle(-20.0, -11.0, 0.3, 5.0, 2.0)).any()


def test_classes_are_told_apart_and_the_ego_car_is_on_top():
    background = view.background([])
    car = Rectangle(0.0, 0.0, 0.0, 5.0, 2.0)
    frame = view.frame(background, [car], car._replace(x=10.0))
    assert frame.dtype == np.uint8
    assert frame[22, 40] == TRAFFIC
    assert frame[22, 60] == EGO
    assert frame[0, 0] == GROUND
    assert view.frame(background, [car], car)[22, 40] == EGO
    assert view.frame(background, [], car._replace(heading=math.pi))[22, 40] == EGO
