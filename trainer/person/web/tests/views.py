"""A real scene as a view, for tests that show something."""

from dataclasses import replace
from functools import cache

from trainer.drivers import make_environment
from trainer.person.interface import View


@cache
def first_view(scenario: str = "left_turn") -> View:
    """What a person sees of a scenario's first moment."""
    env = make_environment(scenario)
    frames, info = env.reset(seed=3)
    return View(
        scenario=scenario,
        scene=env.scene(),
        frames=frames,
        policy_action=0.25,
        human_action=-0.5,
        applied_action=0.25,
        control="policy",
        speed_mps=info["speed_mps"],
        distance_m=info["distance_m"],
        goal_m=env.config.goal_m,
        episode=1,
        step=0,
        time_s=0.0,
    )


def view_of_step(step: int) -> View:
    """The same, told apart by its step."""
    return replace(first_view(), step=step)
