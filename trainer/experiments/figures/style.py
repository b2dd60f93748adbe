"""Names and colours of the algorithms, the same in every figure, and how a figure is kept."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from edge_runtime.files import write_atomic
from trainer.experiments.plan import HUMAN_MODEL

DOTS_PER_INCH = 120
LABELS = {
    "phil_td3": "PHIL-TD3",
    "ia_td3": "IA-TD3",
    "hi_td3": "HI-TD3",
    "per_td3": "vanilla (PER-TD3)",
    "phil_td_only": "TD, human doubled",
    "phil_q_advantage_only": "Q-advantage only",
    "phil_advantage_0.1": "TDQA, w = 0.1",
    "phil_advantage_100": "TDQA, w = 100",
    "rd2_td3": "RD2-TD3",
    "rd2_phil": "RD2-PHIL",
    "phil_without_cloning": "without cloning",
    "phil_without_shaping": "without shaping",
    HUMAN_MODEL: "human model",
}
SCENE_KEY = "L: left turn; C: congestion; -N: with command noise; -V: variant scene"
_COLOURS = {"phil_td3": "C3", "ia_td3": "C0", "hi_td3": "C2", "per_td3": "C7", HUMAN_MODEL: "C1"}
_OTHERS = ("C4", "C5", "C6", "C8", "C9", "black")


def label(algorithm: str) -> str:
    """The algorithm's name in a figure."""
    return LABELS.get(algorithm, algorithm)


def colour(algorithm: str, place: int = 0) -> str:
    """Its colour; those without one of their own take turns by their place in the figure."""
    return _COLOURS.get(algorithm, other_colour(place))


def other_colour(place: int) -> str:
    """A colour that no algorithm has for itself."""
    return _OTHERS[place % len(_OTHERS)]


def short(algorithm: str) -> str:
    """A name for narrow places."""
    return label(algorithm).replace("vanilla (PER-TD3)", "vanilla")


def new_figure(width: float, height: float) -> Figure:
    """A figure in inches."""
    return Figure(figsize=(width, height), layout="constrained")


def letter(panel: Any, number: int, title: str) -> None:
    """A panel's title behind its letter."""
    panel.set_title(f"{'abcdefgh'[number]}  {title}", loc="left", fontsize=10)


def note_missing(panel: Any) -> None:
    """Say in an empty panel that it is empty."""
    panel.text(
        0.5, 0.5, "no data yet", ha="center", va="center", color="0.5", transform=panel.transAxes
    )


def write_figure(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH)
    write_atomic(path, buffer.getvalue())
