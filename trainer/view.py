"""Show test episodes in rerun (``evaluate --rerun``), or film them (``--video``)."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from bridge.environments import draws
from bridge.rerun import APPLIED, POLICY, open_sink

# isort: split
import rerun as rr
import rerun.blueprint as rrb

from bridge.messages import SeenScene, read_scene
from bridge.rerun import draw
from bridge.rerun.draw import Canvas
from edge_runtime.files import draft_of
from edge_runtime.util import UserError
from trainer.environments import entries_of
from trainer.human.guide import Record
from trainer.learner.replay import Transition
from trainer.scenarios import SCENARIOS

HELD_S = 1.0  # How long a film shows an episode's last picture
PLOTS = {"action": "Action, from -1 to 1", "speed": "Speed, m/s", "reward": "Reward of a step"}


@contextmanager
def drives_watched(env: Any, sink: str) -> Iterator[Record]:
    """Show every step of test episodes in rerun; yield the function that records a step."""
    numbers = count()

    def record(step: Transition, _: Any, info: Mapping[str, Any]) -> None:
        canvas.stand_at(next(numbers))
        assert step.overruled is not None  # The policy's action, before the command noise
        canvas.scalar("action/policy", *step.overruled)
        canvas.scalar("action/applied", *step.action)
        canvas.scalar("speed/ego", info["speed_mps"])
        canvas.scalar("reward/step", step.reward)
        canvas.observation(entries_of(step.observation, "frames"))
        scene, picture = _from_above(env)
        if scene is not None or picture is not None:
            canvas.road(scene, picture, POLICY)
        canvas.status(f"# episode {info['episode'] + 1}: {info.get('outcome', 'drives')}")

    with open_sink(sink, "phil_hil_evaluation", lay_out(None)) as recording:
        canvas = Canvas(recording, lay_out, {})
        canvas.style("action/policy", POLICY, ["policy"])
        canvas.style("action/applied", APPLIED, ["applied"])
        yield record


def _from_above(env: Any) -> tuple[SeenScene | None, Any]:
    """Return the scene, else the environment's picture; None for what it does not have."""
    with suppress(Exception):  # An environment's own code may raise anything; the drive goes on.
        if (scene := env.scene()) is not None:
            return read_scene(scene), None
        return None, rr.Image(env.render(), color_model="RGB")
    return None, None


def lay_out(scene: SeenScene | None) -> rrb.Blueprint:
    """Lay out the views; ``scene`` fixes the ground shown (None: as rerun sees fit)."""
    right = rrb.Vertical(*(draw.plot_view(*plot) for plot in PLOTS.items()))
    return draw.two_columns(scene, right, "step")


@contextmanager
def filmed(env: Any, target: Path) -> Iterator[Record]:
    """Film test episodes; yield the function that films a step. The file appears once complete."""
    from bridge.lerobot import film  # It needs an extra

    if env.scenario not in SCENARIOS and not draws(env.env):
        raise UserError(f"{env.scenario} has no render mode rgb_array to film")
    period_s = env.control_period_s
    rate = Fraction(1 / period_s).limit_denominator(1000)

    def record(step: Transition, _: Any, info: Mapping[str, Any]) -> None:
        picture, at_s = Image.fromarray(np.asarray(env.render())), info["step"] * period_s
        caption = f"episode {info['episode'] + 1}, {at_s:.1f} s {info.get('outcome', '')}"
        look: Any = {"font_size": 18, "stroke_width": 2, "stroke_fill": "white"}
        ImageDraw.Draw(picture).text((8, 6), caption, "black", **look)
        for _ in range(round(HELD_S / period_s) if step.terminal or step.truncated else 1):
            add(np.asarray(picture))

    with draft_of(target) as draft, film(draft, rate) as add:
        yield record
