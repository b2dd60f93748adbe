"""Finding an environment by its name, and what it asks of a policy.

The bridge knows environments only by name, and imports nothing of the trainer itself: a scenario's
word is an entry point of the group ``phil.scenarios``, whose value is a gymnasium id in a module
that registers it. Whatever an environment offers beyond gymnasium's own is found by name, and
optional; docs/own_environment.md lists it.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import json
import math
import os
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium.envs.registration import namespace
from gymnasium.spaces import Box, Dict
from PIL import Image

from edge_runtime.manifest import DTYPES, Action, Car, Entry, Task, check_task
from edge_runtime.policy import OUTPUT
from edge_runtime.util import UserError

# Environments draw into memory. Left to itself SDL looks for a screen, with an "error:" that looks
# like ours, and takes SIGTERM for itself. Its "dummy" screen makes highway-env draw nothing.
os.environ.setdefault("SDL_VIDEODRIVER", "offscreen")
os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")

Environment = gymnasium.Env[Any, Any]
SCENARIO_GROUP = "phil.scenarios"
NOMINAL = "nominal"
CONDITIONS = {
    NOMINAL: "the scene that is trained in",
    "variant": "more vehicles, and other types of them",
    "dense": "closer and less even traffic",
}

PLUGIN_GROUP, ROOT = "gymnasium.envs", "__root__"
PLAIN = "observation"  # The entry's name where an environment observes one array
RENDERED = "rgb_array"
_NAME = re.compile(r"(?:\w+(?:\.\w+)*:)?[^:\s]+")


def scenarios() -> dict[str, str]:
    """Scenario word -> ``module:id`` of its environment, of all installed packages."""
    found = importlib.metadata.entry_points(group=SCENARIO_GROUP)
    return {one.name: one.value for one in found}


def hint() -> str:
    """What a name may be."""
    return f"use {', '.join(sorted(scenarios()))}, a gymnasium id, or module:id"


def make_environment(name: str, condition: str = NOMINAL) -> Environment:
    """Make the environment of a scenario word, a gymnasium id or ``module:id``.

    Another condition than the nominal one is asked for by the keyword ``scene``. An environment
    that can draw itself is made so that it does.

    Raises UserError for an unknown name, or a module that does not import.
    """
    if not _NAME.fullmatch(name):
        raise UserError(f"{name!r} names no environment; {hint()}")
    try:
        words = importlib.metadata.entry_points(group=SCENARIO_GROUP, name=name)
        # To load a scenario's word imports the module that registers it.
        environment_id = next((str(one.load()) for one in words), name)
        _load_plugin(environment_id)
        options: dict[str, Any] = {} if condition == NOMINAL else {"scene": condition}
        modes = _metadata(environment_id).get("render_modes") or ()
        drawn = {"render_mode": RENDERED} if RENDERED in modes else {}
        try:
            return _OneLine(_make_quietly(environment_id, **options, **drawn))
        except TypeError as error:
            if "render_mode" not in str(error):  # Not every constructor takes it.
                raise
            return _OneLine(_make_quietly(environment_id, **options))
    except (Exception, SystemExit) as error:  # A module may raise anything when it is imported.
        first_line = (str(error).splitlines() or [""])[0]
        what = f"{type(error).__name__}: {first_line}" if first_line else type(error).__name__
        raise UserError(f"no environment {name!r}: {what} ({hint()})") from error


class _OneLine(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Says in one line what a stranger's environment raises while it drives or draws, and where."""

    def reset(self, **options: Any) -> Any:
        """Begin an episode."""
        return self._do(self.env.reset, **options)

    def step(self, action: Any) -> Any:
        """One control period; the environment may write into its copy of the action."""
        return self._do(self.env.step, np.array(action))

    def render(self) -> Any:
        """What it draws."""
        return self._do(self.env.render)

    def close(self) -> None:
        """Close it; a fault in that is said, and costs nobody what was driven."""
        try:
            self._do(self.env.close)
        except UserError as error:
            print(error, file=sys.stderr)

    def _do(self, call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        try:
            return call(*arguments, **named)
        except UserError:
            raise
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            what = f"{type(error).__name__}: {error} ({where})"
            own = self.spec.id if self.spec else type(self.unwrapped).__name__
            raise UserError(f"environment {own} failed in {call.__name__}: {what}") from error


def _make_quietly(environment_id: str, **options: Any) -> Environment:
    """Make it without Gymnasium's advice to its author, which would stand before our one line."""
    level, gymnasium.logger.min_level = gymnasium.logger.min_level, gymnasium.logger.ERROR
    try:
        return gymnasium.make(environment_id, **options)
    finally:
        gymnasium.logger.min_level = level


def _metadata(environment_id: str) -> dict[str, Any]:
    """What the environment's class says of itself, before one is made."""
    module, _, plain_id = environment_id.rpartition(":")
    if module:
        importlib.import_module(module)
    entry_point = gymnasium.spec(plain_id).entry_point
    made = (
        gymnasium.envs.registration.load_env_creator(entry_point)
        if isinstance(entry_point, str)
        else entry_point
    )
    found = getattr(made, "metadata", None)
    return found if isinstance(found, dict) else {}  # A wrapper's is a property of each object.


def _load_plugin(environment_id: str) -> None:
    """Let an installed package register the id, as Gymnasium did by itself before 1.0.

    Such a package declares an entry point of the group ``gymnasium.envs``: its name is the
    namespace of its ids (ROOT: none), its value a function that registers them. Only what the id
    needs is imported.
    """
    if ":" in environment_id or environment_id in gymnasium.registry:
        return
    wanted = environment_id.rpartition("/")[0]
    known = importlib.metadata.entry_points
    # The second form is highway-env's.
    plugins = [
        *known(group=PLUGIN_GROUP, name=wanted or ROOT),
        *known(group=f"{PLUGIN_GROUP}.{wanted or ROOT}"),
    ]
    for plugin in plugins:
        register = plugin.load()
        with namespace(wanted) if wanted else contextlib.nullcontext():
            if callable(register):  # A module has registered them by being imported.
                register()
    failures = []
    for scenario in known(group=SCENARIO_GROUP):  # One may be named by its id.
        if environment_id in gymnasium.registry:
            return
        try:
            scenario.load()
        except (Exception, SystemExit) as error:  # It may be the one that is wanted, or not.
            failures.append(f"{scenario.value}: {type(error).__name__}: {error}")
    if failures and environment_id not in gymnasium.registry:
        raise UserError(f"nobody registers it; these scenarios fail: {', '.join(failures)}")


def describe(
    environment: Environment, period_s: float | None = None, unknown_s: float | None = None
) -> Task:
    """What the environment asks of a policy: its observation, actions, and control period.

    The period is ``period_s`` where that is given, else the environment's ``control_period_s``,
    that of ``config["policy_frequency"]`` (highway-env's), ``dt``, a guess from ``render_fps``, or
    ``unknown_s``. A line says of the last two that they were taken.

    Raises UserError where the wire cannot carry it, or where nothing says how long a step is.
    """
    spec = environment.spec
    own = spec.id if spec else type(environment.unwrapped).__name__
    name = offered(environment, "scenario") or own
    try:
        car = msgspec.convert(offered(environment, "car"), Car | None)
    except msgspec.ValidationError as error:
        raise UserError(f"environment {name!r}: its car is not valid: {error}") from None
    task = Task(
        task=name,
        observation=_entries(environment, name),
        action=_actions(environment, name),
        control_period_s=period_s or _period_s(environment, name, unknown_s),
        car=car,
    )
    check_task(task)
    return task


def offered(environment: Environment, name: str, default: Any = None) -> Any:
    """What the outermost of an environment's wrappers that has this name, or it itself, has."""
    try:
        return environment.get_wrapper_attr(name)
    except AttributeError:
        return default


@cache
def say_once(text: str) -> None:
    """Say it on stderr; many environments may be made of one kind."""
    print(text, file=sys.stderr)


def _entries(environment: Environment, name: str) -> dict[str, Entry]:
    space = environment.observation_space
    meanings = offered(environment, "observation_meanings", {})
    boxes = dict(space.spaces) if isinstance(space, Dict) else {entry_name(environment): space}
    entries = {}
    for entry, box in boxes.items():
        if not entry or entry.isdigit() or entry == OUTPUT:  # An ONNX graph would rename it
            taken = "an observation's name must not be empty, a number or the policy's output"
            raise UserError(f"environment {name!r} observes {entry!r}: {taken}")
        dtype = str(getattr(box, "dtype", None)).replace("float64", "float32")
        if not isinstance(box, Box) or dtype not in DTYPES:
            known = f"Box or a flat Dict of Boxes of {', '.join(DTYPES)}"
            raise UserError(f"environment {name!r} observes {space}; the wire carries {known}")
        meaning = meanings.get(entry, "")
        entries[entry] = Entry(dtype=dtype, shape=list(box.shape), meaning=meaning)
    return entries


def entry_name(environment: Environment) -> str:
    """How an environment calls its one observation."""
    return str(offered(environment, "observation_name", PLAIN))


def _actions(environment: Environment, name: str) -> list[Action]:
    space = environment.action_space
    if not isinstance(space, Box) or not np.all(np.isfinite([space.low, space.high])):
        raise UserError(f"environment {name!r} acts in {space}; the wire carries a Box with bounds")
    low, high = space.low.ravel().tolist(), space.high.ravel().tolist()
    count = len(low)
    names, empty = [f"action_{number}" for number in range(count)], [""] * count
    defaults = {"action_names": names, "action_meanings": empty, "action_units": empty}
    said: dict[str, Any] = {k: offered(environment, k) or kept for k, kept in defaults.items()}
    said["brake_action"] = known_stops(environment) or [None] * count
    for key, values in said.items():
        if len(values) != count:
            raise UserError(f"environment {name!r}: {key} has {len(values)} entries, not {count}")
    rows = zip(*said.values(), low, high, strict=True)
    fields = ("name", "meaning", "unit", "stop", "low", "high")
    return [Action(**dict(zip(fields, row, strict=True))) for row in rows]


def known_stops(environment: Environment) -> list[float | None] | None:
    """Each action's value in a safe stop as the environment says it; None where it does not.

    One that has a brake of its own (``press_brake``) holds the last action and presses it.
    """
    size = math.prod(environment.action_space.shape or (1,))
    if callable(offered(environment, "press_brake")):
        return [None] * size
    brake = offered(environment, "brake_action")
    return None if brake is None else [float(value) for value in np.ravel(brake)]


def _period_s(environment: Environment, name: str, unknown_s: float | None) -> float:
    own, config = (offered(environment, key) for key in ("control_period_s", "config"))
    if own is not None:
        return finite("control_period_s", own)
    # These names others have, too: what is no number means something else.
    rate = _number(config.get("policy_frequency")) if isinstance(config, Mapping) else None
    if found := (rate and 1.0 / rate) or _number(offered(environment, "dt")):
        return found
    says = f"{name} does not say how long a step is"
    if frames_per_s := _number(environment.metadata.get("render_fps")):
        say_once(f"{says}: {1.0 / frames_per_s:g} s is guessed from its render_fps")
        return 1.0 / frames_per_s
    if unknown_s is None:
        raise UserError(f"environment {says}; give it --period")
    say_once(f"{says}: {unknown_s} s is taken")
    return unknown_s


def finite(name: str, value: Any) -> float:
    """The number; UserError for one that is not finite, or none: no wire or report carries it."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise UserError(f"the environment's {name} is {value!r}, no number") from None
    if not math.isfinite(number):
        raise UserError(f"the environment's {name} is {number}, not a finite number")
    return number


def _number(value: Any) -> float | None:
    is_number = isinstance(value, int | float | np.integer | np.floating)
    return float(value) if is_number and value > 0 else None


def scene_of(environment: Environment) -> dict[str, Any] | None:
    """Return the picture seen from above, for viewers only; None if there is none."""
    scene = offered(environment, "scene")
    return scene() if callable(scene) else None


def picture_of(environment: Environment) -> bytes:
    """A JPEG of what ``render()`` shows; empty for an environment that does not draw itself."""
    if environment.render_mode != RENDERED:
        return b""
    shown = io.BytesIO()
    Image.fromarray(np.asarray(environment.render())).save(shown, "JPEG")
    return shown.getvalue()


def changed(task: Task, changes: Sequence[str]) -> Task:
    """The task with changes such as ``action.0.stop=-1`` in it.

    ``stop``, ``slew_per_s``, ``meaning`` and ``unit`` of an action can be changed; the value is
    JSON, or plain text. Raises UserError for anything else.
    """
    actions = list(task.action)
    for change in changes:
        place, found, text = change.partition("=")
        match = re.fullmatch(r"action\.(\d+)\.(stop|slew_per_s|meaning|unit)", place)
        if match is None or not found or int(match[1]) >= len(actions):
            most = len(actions) - 1
            form = f"action.N.stop=VALUE, or slew_per_s, meaning, unit, with N from 0 to {most}"
            raise UserError(f"--set {change}: expected {form}")
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        row = msgspec.to_builtins(actions[int(match[1])]) | {match[2]: value}
        try:
            actions[int(match[1])] = msgspec.convert(row, Action)
        except msgspec.ValidationError as error:
            raise UserError(f"--set {change}: {error}") from None
    task = msgspec.structs.replace(task, action=actions)
    check_task(task)
    return task
