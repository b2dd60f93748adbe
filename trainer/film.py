"""Films of test episodes: ``python -m trainer evaluate --video F.mp4``."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from bridge import environments as bridge
from edge_runtime.files import check_writable, make_directory
from edge_runtime.util import UserError
from trainer.human.guide import Record
from trainer.learner.replay import Transition
from trainer.scenarios import SCENARIOS

HELD_S = 1.0  # An episode's last picture


def check_film(path: str | PathLike[str]) -> Path:
    """Return the absolute path of a film to write; UserError where that would fail."""
    if Path(path).suffix != ".mp4":
        raise UserError(f"{path}: a film's name ends in .mp4")
    return Path(check_writable(path) or "")


@contextmanager
def filmed(env: Any, target: Path) -> Iterator[Record]:
    """Film drives; yield what takes each control period. The film appears when it is complete."""
    from bridge.film import film  # Its library is an extra

    if env.scenario not in SCENARIOS and not bridge.draws(env.env):
        raise UserError(f"{env.scenario} draws no rgb_array that could be filmed")
    make_directory(target.parent)
    part = target.with_name(f".{os.getpid()}.{target.name}")
    episode, step, period_s = 1, 0, env.control_period_s
    try:
        with film(part, Fraction(1 / period_s).limit_denominator(1000)) as add:

            def record(seen: Transition, _: Any, info: Mapping[str, Any]) -> None:
                nonlocal episode, step
                step, ended = step + 1, seen.terminal or seen.truncated
                picture = Image.fromarray(np.asarray(env.render()))
                said = f"episode {episode}, {step * period_s:.1f} s {info.get('outcome', '')}"
                look: Any = {"font_size": 18, "stroke_width": 2, "stroke_fill": "white"}
                ImageDraw.Draw(picture).text((8, 6), said, "black", **look)
                for _ in range(round(HELD_S / period_s) if ended else 1):
                    add(np.asarray(picture))
                if ended:
                    episode, step = episode + 1, 0

            yield record
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)
