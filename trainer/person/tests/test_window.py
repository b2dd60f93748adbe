"""The window: on a small screen, resized, and in the colours of who drives."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bridge import rerun
from trainer.person.devices import pygame
from trainer.person.web.tests.views import first_view
from trainer.person.window import SIZE, Window


@pytest.fixture
def opened(monkeypatch):
    """Opens a window on a screen of a size."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")

    def opened(*screen):
        monkeypatch.setattr(pygame.display, "get_desktop_sizes", lambda: [screen])
        return Window()

    yield opened
    pygame.quit()


def shown() -> pygame.Surface:
    """What is in the window."""
    surface = pygame.display.get_surface()
    assert surface is not None
    return surface


def found(colour):
    """Where a colour is seen, as (left, top, right, bottom)."""
    mask = pygame.mask.from_threshold(shown(), colour, (12, 12, 12, 255))
    boxes = mask.get_bounding_rects()
    assert boxes, "not seen"
    return boxes[0].unionall(boxes[1:])


@pytest.mark.parametrize("screen", [(800, 480), (480, 800), (1024, 600), (3840, 2160)])
def test_all_of_it_is_seen_on_any_screen(opened, screen):
    window = opened(*screen)
    window.show(replace(first_view(), applied_action=1.0, human_action=1.0))
    width, height = pygame.display.get_window_size()
    assert width <= min(screen[0], SIZE[0])
    assert height <= min(screen[1], SIZE[1])
    bar = found(rerun.APPLIED)  # Also the other car's colour, further up.
    assert bar.bottom / height == pytest.approx((400 + 16 + 24 + 2 * 42 + 18) / SIZE[1], abs=0.01)


def test_a_window_that_is_resized_shows_all_of_it_in_its_shape(opened):
    window = opened(1920, 1080)
    pygame.display.set_mode((520, 680), pygame.RESIZABLE)
    window.show(replace(first_view(), human_action=1.0, control="policy"))
    assert found(rerun.HUMAN).width == pytest.approx(200 / 2, abs=3)
    assert found(rerun.HUMAN).top > 170, "in the middle"


@pytest.mark.parametrize("control", ["policy", "human", "returning"])
def test_the_car_has_the_colour_of_who_drives(opened, control):
    opened(1920, 1080).show(replace(first_view(), control=control, human_action=0.0))
    car = shown().subsurface((0, 0, 736, 400))
    seen = {tuple(car.get_at((x, y)))[:3] for x in range(736) for y in range(400)}
    others = {rerun.POLICY, rerun.HUMAN, rerun.RETURNING} - {rerun.BY_NAME[control]}
    assert rerun.BY_NAME[control] in seen
    assert not seen & others
