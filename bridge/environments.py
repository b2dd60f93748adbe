"""Finding the environment to serve, and checking that it keeps the contract of the wire.

The bridge knows environments only by name: it is given a gymnasium id and imports nothing of the
trainer itself.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import re
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import namespace
from gymnasium.spaces import Box

from edge_runtime.policy import Manifest, task_text
from edge_runtime.util import UserError
from edge_runtime.wire import FRAMES_SHAPE

SCENARIOS = {"left_turn": "phil/LeftTurn-v0", "congestion": "phil/Congestion-v0"}
"""Scenario word on the command line and in the report -> gymnasium id."""
NOMINAL = "nominal"
CONDITIONS = {
    NOMINAL: "the scene that is trained in",
    "variant": "more vehicles, and other types of them",
    "dense": "closer and less even traffic",
}
"""Scenes that can be served, with what they are."""

PLUGIN_GROUP, ROOT = "gymnasium.envs", "__root__"

HINT = f"use {', '.join(SCENARIOS)}, a gymnasium id, or module:id"
_NAME = re.compile(r"(?:\w+(?:\.\w+)*:)?[^:\s]+")


def make_environment(name: str, condition: str = NOMINAL) -> gymnasium.Env[Any, Any]:
    """Make the environment of a scenario word, a gymnasium id or ``module:id``.

    Another condition than the nominal one is asked for by the keyword ``scene``.

    Raises UserError for an unknown name, a module that does not import, or an environment whose
    observation or action space the wire cannot carry.
    """
    environment_id = SCENARIOS.get(name, name)
    if environment_id.startswith("phil/"):
        environment_id = f"trainer.scenarios:{environment_id}"  # the module that registers it
    if not _NAME.fullmatch(environment_id):
        raise UserError(f"{name!r} names no environment; {HINT}")
    try:
        load_plugin(environment_id)
        options: dict[str, Any] = {} if condition == NOMINAL else {"scene": condition}
        environment = gymnasium.make(environment_id, **options)
    except (Exception, SystemExit) as error:  # A module may raise anything when it is imported.
        first_line = (str(error).splitlines() or [""])[0]
        what = f"{type(error).__name__}: {first_line}" if first_line else type(error).__name__
        raise UserError(f"no environment {name!r}: {what} ({HINT})") from error
    _check_spaces(environment, name)
    return environment


def scenario_of(name: str) -> str:
    """Return the scenario word for any form of an environment's name; the name if it has none."""
    words = {environment_id: word for word, environment_id in SCENARIOS.items()}
    return words.get(name.rpartition(":")[2], name)


def task_of(
    environment: gymnasium.Env[Any, Any], name: str, manifest: Manifest | None = None
) -> str:
    """Return what the environment is for, as a policy's manifest says it of itself.

    The scenario is known by its word or id, the actions' names of an environment that has
    ``action_names``, their ranges always. What is not known is taken from ``manifest``; without
    one the answer is empty then.
    """
    scenario = scenario_of(name)
    names = list(getattr(environment.unwrapped, "action_names", ()))
    if manifest is not None:
        scenario = scenario if scenario in SCENARIOS else manifest.scenario
        names = names or [action.name for action in manifest.action]
    elif scenario not in SCENARIOS or not names:
        return ""
    space = environment.action_space
    assert isinstance(space, Box)
    names += ["an action"] * (len(space.low) - len(names))
    return task_text(scenario, list(zip(names, space.low, space.high, strict=False)))


def load_plugin(environment_id: str) -> None:
    """Let an installed package register the id, as Gymnasium did by itself before 1.0.

    Such a package declares an entry point of the group ``gymnasium.envs``: its name is the
    namespace of its ids (ROOT: none), its value a function that registers them. Only what the id
    needs is imported.
    """
    if ":" in environment_id or environment_id in gymnasium.registry:
        return
    wanted = environment_id.rpartition("/")[0]
    for plugin in importlib.metadata.entry_points(group=PLUGIN_GROUP):
        space = "" if plugin.name == ROOT else plugin.name
        if space == wanted:
            register = plugin.load()
            with namespace(space) if space else contextlib.nullcontext():
                if callable(register):  # A module has registered them by being imported.
                    register()


def _check_spaces(environment: gymnasium.Env[Any, Any], name: str) -> None:
    observation, action = environment.observation_space, environment.action_space
    frames = isinstance(observation, Box) and observation.shape == FRAMES_SHAPE
    if not frames or observation.dtype != np.uint8:
        raise UserError(
            f"environment {name!r} observes {observation}; the wire carries uint8 {FRAMES_SHAPE}"
        )
    bounded = isinstance(action, Box) and np.all(action.low == -1) and np.all(action.high == 1)
    if not bounded or len(action.shape or ()) != 1:
        raise UserError(f"environment {name!r} acts in {action}; the wire carries Box(-1, 1, (n,))")


def brake_action(environment: gymnasium.Env[Any, Any]) -> np.ndarray:
    """Return the action of a safe stop, float32 [n]: the environment's own, or -1 throughout.

    An environment whose action brakes gives full brake here; one that is steered gives the last
    steering, and brakes by ``press_brake``.
    """
    own = getattr(environment.unwrapped, "brake_action", None)
    if own is not None:
        return np.asarray(own, dtype=np.float32)
    return np.full(environment.action_space.shape or (1,), -1.0, dtype=np.float32)


def press_brake(environment: gymnasium.Env[Any, Any], pressed: bool) -> None:
    """Press or release the brake of an environment whose action only steers; others have none."""
    press = getattr(environment.unwrapped, "press_brake", None)
    if callable(press):
        press(pressed)


def scene_of(environment: gymnasium.Env[Any, Any]) -> dict[str, Any] | None:
    """Return the picture seen from above, for viewers only; None if there is none."""
    scene = getattr(environment.unwrapped, "scene", None)
    return scene() if callable(scene) else None
