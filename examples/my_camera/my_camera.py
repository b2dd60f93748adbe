"""Observe by a USB camera (OpenCV), or by a folder of pictures in its place.

`python -m my_camera` draws such pictures: a line that winds over dark ground. This file runs on the
board, in Python 3.8; my_task.py is for the training.
"""

from __future__ import annotations

import math
import os
import threading
from pathlib import Path

import numpy as np

HEIGHT, WIDTH = 45, 80
DEVICE, FOLDER = os.environ.get("MY_CAMERA", "0"), Path(os.environ.get("MY_PICTURES", "pictures"))


class Stacked:
    """Stacks pictures [45, 80] to the policy's observation: `frames`, [t-1, t]."""

    last: np.ndarray | None = None

    def observe(self) -> dict[str, np.ndarray]:
        """Take a new picture, exposed after the call, and stack it with the last one."""
        picture = self.take()
        last, self.last = picture if self.last is None else self.last, picture
        return {"frames": np.stack([last, picture])}


class Camera(Stacked):
    """A USB camera, by its number or address in MY_CAMERA."""

    def __init__(self) -> None:
        import cv2  # the extra `usb`

        self.cv2 = cv2
        self.camera = cv2.VideoCapture(int(DEVICE) if DEVICE.isdecimal() else DEVICE)
        self.ready, self.count, self.frame = threading.Condition(), 0, None
        threading.Thread(target=self.read, daemon=True).start()

    def read(self) -> None:
        """Read every frame: OpenCV queues unread ones, and they grow old."""
        good = True
        while good:
            good, frame = self.camera.read()
            with self.ready:
                self.count, self.frame = self.count + 1, frame if good else None
                self.ready.notify()

    def take(self) -> np.ndarray:
        """Wait for the second frame from now: the exposure of the first began before the call."""
        with self.ready:
            enough = self.count + 2
            self.ready.wait_for(lambda: self.count >= enough or (self.count and self.frame is None))
            frame = self.frame
        if frame is None:
            raise OSError(f"camera {DEVICE} gives no frame")
        grey = self.cv2.cvtColor(frame, self.cv2.COLOR_BGR2GRAY)
        return self.cv2.resize(grey, (WIDTH, HEIGHT), interpolation=self.cv2.INTER_AREA)


class Pictures(Stacked):
    """The pictures of the folder MY_PICTURES, sorted by name, in a loop."""

    def __init__(self) -> None:
        from PIL import Image

        opened = map(Image.open, sorted(FOLDER.iterdir()))
        self.pictures = [np.asarray(each.convert("L").resize((WIDTH, HEIGHT))) for each in opened]
        self.count = -1
        if not self.pictures:
            raise OSError(f"there is no picture in {FOLDER}")

    def take(self) -> np.ndarray:
        self.count += 1
        return self.pictures[self.count % len(self.pictures)]


def draw(folder: Path = FOLDER, count: int = 200) -> None:
    from PIL import Image, ImageDraw

    folder.mkdir()
    for number in range(count):
        image = Image.new("L", (4 * WIDTH, 4 * HEIGHT), 40)
        line = [(160 + 60 * math.sin(number / 8 + y / 90) * (1 - y / 400), y) for y in range(181)]
        ImageDraw.Draw(image).line(line, 220, 16)
        image.save(folder / f"{number:04d}.png")


if __name__ == "__main__":
    draw()
