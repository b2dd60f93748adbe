"""The example of a camera: it shows what was taken after it was asked, and says when it is gone."""

import importlib
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

FRAME_S = 0.02


@pytest.fixture
def frames():
    return SimpleNamespace(left=1000)


@pytest.fixture
def my_camera(monkeypatch, tmp_path, frames):
    """The example, with an OpenCV whose frames hold the time at which their exposure began."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples/my_camera")
    monkeypatch.delitem(sys.modules, "my_camera", raising=False)

    class VideoCapture:
        def __init__(self, device):
            assert device == 0

        def read(self):
            began_s = time.monotonic()
            time.sleep(FRAME_S)
            frames.left -= 1
            return frames.left > 0, np.full((90, 160), began_s)

    fake = SimpleNamespace(
        VideoCapture=VideoCapture, COLOR_BGR2GRAY=0, INTER_AREA=0,
        cvtColor=lambda frame, how: frame,
        resize=lambda frame, size, interpolation: frame[: size[1], : size[0]],
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "cv2", fake)
    my_camera = importlib.import_module("my_camera")
    monkeypatch.setattr(my_camera, "FOLDER", tmp_path / "pictures")
    return my_camera


def test_a_camera_shows_what_was_taken_since_it_was_asked_and_says_when_it_is_gone(
    my_camera, frames
):
    camera, seen = my_camera.Camera(), []
    for _ in range(3):
        time.sleep(3 * FRAME_S)
        asked_s = time.monotonic()
        seen.append(camera.observe()["frames"])
        assert seen[-1].shape == (2, 45, 80)
        assert (seen[-1][1] >= asked_s).all()
    assert (seen[2][0] == seen[1][1]).all()
    frames.left = 1
    for _ in range(2):  # it does not hang either
        with pytest.raises(OSError, match="no frame"):
            camera.observe()


def test_a_folder_of_pictures_stands_in_for_it(my_camera):
    my_camera.draw(my_camera.FOLDER, 3)
    source = my_camera.Pictures()
    seen = [source.observe()["frames"] for _ in range(4)]
    assert {(each.shape, str(each.dtype)) for each in seen} == {((2, 45, 80), "uint8")}
    assert (seen[3][1] == seen[0][1]).all()  # from the beginning again
    assert (seen[1] != seen[2]).any()


def test_a_folder_without_pictures_says_so(my_camera):
    my_camera.FOLDER.mkdir()
    with pytest.raises(OSError, match="no picture"):
        my_camera.Pictures()
