"""Make environments by name, describe them for a policy file, and adapt them to a task.

The bridge imports no environment itself. Everything beyond gymnasium's interface is optional, and
looked up by name on the environment or one of its wrappers (docs/own_environment.md).
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import math
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium.spaces import Box, Dict
from PIL import Image

from edge_runtime.manifest import DTYPES, Action, Car, Entry, Task, check_task
from edge_runtime.policy import OUTPUT
from edge_runtime.util import UserError

# Environments draw into memory. By default SDL looks for a screen, prints an "error:" that looks
# like ours, and handles SIGTERM itself. With its "dummy" screen highway-env draws nothing.
os.environ.setdefault("SDL_VIDEODRIVER", "offscreen")
os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")

Environment = gymnasium.Env[Any, Any]
SCENARIO_GROUP = "phil.scenarios"
NOMINAL = "nominal"
CONDITIONS = {
    NOMINAL: "the scene of the training",
    "variant": "more vehicles, and other types of them",
    "dense": "closer and less even traffic",
}
PLUGIN_GROUP = "gymnasium.envs.__root__"
PLAIN = "observation"  # The entry's name where an environment observes one array
RENDERED = "rgb_array"


def scenarios() -> dict[str, str]:
    """Return scenario word -> ``module:id`` of its environment, of all installed packages."""
    return {word.name: word.value for word in importlib.metadata.entry_points(group=SCENARIO_GROUP)}


def make_environment(name: str, condition: str = NOMINAL) -> Environment:
    """Make the environment of a scenario word, a gymnasium id or ``module:id``; UserError.

    Another condition than the nominal one is passed as the keyword ``scene``, and
    ``render_mode="rgb_array"`` to a constructor that takes it.
    """
    level, gymnasium.logger.min_level = gymnasium.logger.min_level, gymnasium.logger.ERROR
    try:
        # Loading a scenario's word imports the module that registers it.
        words = importlib.metadata.entry_points(group=SCENARIO_GROUP, name=name)
        environment_id = next((str(each.load()) for each in words), name)
        _register(environment_id)
        options: dict[str, Any] = {} if condition == NOMINAL else {"scene": condition}
        try:
            environment = gymnasium.make(environment_id, render_mode=RENDERED, **options)
        except Exception:  # Not every constructor takes render_mode
            environment = gymnasium.make(environment_id, **options)
        return _OneLine(environment)
    except (Exception, SystemExit) as error:  # A module may raise anything when it is imported
        what = f"{type(error).__name__}: {error}".splitlines()[0]
        hint = f"use {', '.join(sorted(scenarios()))}, a gymnasium id, or module:id"
        raise UserError(f"no environment {name!r}: {what} ({hint})") from error
    finally:  # Until here, because gymnasium's advice to authors would precede our one line
        gymnasium.logger.min_level = level


class _OneLine(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Turns an exception of a foreign environment into a UserError of one line."""

    def reset(self, **options: Any) -> Any:
        return self._do(self.env.reset, **options)

    def step(self, action: Any) -> Any:
        return self._do(self.env.step, np.array(action))  # A copy, into which it may write

    def render(self) -> Any:
        return self._do(self.env.render)

    def close(self) -> None:
        with contextlib.suppress(Exception):  # A fault here must not cost the drive's results
            self.env.close()

    def _do(self, call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        try:
            return call(*arguments, **named)
        except UserError:
            raise
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            what = f"{call.__name__}: {type(error).__name__}: {error} ({where})"
            raise UserError(f"environment {name_of(self)} failed in {what}") from error


def _register(environment_id: str) -> None:
    """Let installed scenarios, and Gymnasium's plug-ins such as highway-env, register their ids."""
    if ":" in environment_id or environment_id in gymnasium.registry:
        return
    for scenario in importlib.metadata.entry_points(group=SCENARIO_GROUP):
        with contextlib.suppress(Exception):  # Another package's scenario may fail to load
            scenario.load()
    for plugin in importlib.metadata.entry_points(group=PLUGIN_GROUP):
        register = plugin.load()
        if callable(register):
            register()


def describe(
    environment: Environment, period_s: float | None = None, unknown_s: float | None = None
) -> Task:
    """Return the observation, the actions and the control period of an environment.

    The period is ``period_s`` where given, else the environment's ``control_period_s``, that of
    ``config["policy_frequency"]`` (highway-env's), ``dt``, a guess from ``render_fps``, or
    ``unknown_s``; the last two print a line. UserError where the wire cannot carry the task.
    """
    name = offered(environment, "scenario") or name_of(environment)
    try:
        car = msgspec.convert(offered(environment, "car"), Car | None)
    except msgspec.ValidationError as error:
        raise UserError(f"environment {name!r}: its car is not valid: {error}") from None
    entries, action = _entries(environment, name), _actions(environment, name)
    period_s = period_s or _period_s(environment, name, unknown_s)
    task = Task(task=name, observation=entries, action=action, control_period_s=period_s, car=car)
    check_task(task)
    return task


def name_of(environment: Environment) -> str:
    spec = environment.spec
    return spec.id if spec else type(environment.unwrapped).__name__


def offered(environment: Environment, name: str, default: Any = None) -> Any:
    """Return the attribute of the outermost wrapper that has it, or of the environment itself."""
    try:
        return environment.get_wrapper_attr(name)
    except AttributeError:
        return default


@cache
def say_once(text: str) -> None:
    """Print a line on stderr once a process: a process may make many environments of a kind."""
    print(text, file=sys.stderr)


def _entries(environment: Environment, name: str) -> dict[str, Entry]:
    space = environment.observation_space
    meanings = offered(environment, "observation_meanings", {})
    plain = str(offered(environment, "observation_name", PLAIN))
    entries = {}
    for entry, box in (space.spaces if isinstance(space, Dict) else {plain: space}).items():
        if not entry or entry.isdigit() or entry == OUTPUT:  # The ONNX export would rename it
            taken = "an observation's name must not be empty, a number or the policy's output"
            raise UserError(f"environment {name!r} observes {entry!r}: {taken}")
        dtype = str(getattr(box, "dtype", None)).replace("float64", "float32")
        if not isinstance(box, Box) or dtype not in DTYPES:
            known = f"Box or a flat Dict of Boxes of {', '.join(DTYPES)}"
            raise UserError(f"environment {name!r} observes {space}; the wire carries {known}")
        meaning = meanings.get(entry, "")
        entries[entry] = Entry(dtype=dtype, shape=list(box.shape), meaning=meaning)
    return entries


def _actions(environment: Environment, name: str) -> list[Action]:
    space = environment.action_space
    if not isinstance(space, Box) or not np.all(np.isfinite([space.low, space.high])):
        raise UserError(f"environment {name!r} acts in {space}; the wire carries a Box with bounds")
    low, high = space.low.ravel().tolist(), space.high.ravel().tolist()
    count = len(low)
    columns = {
        "name": offered(environment, "action_names", [f"action_{n}" for n in range(count)]),
        "meaning": offered(environment, "action_meanings", [""] * count),
        "unit": offered(environment, "action_units", [""] * count),
        "stop": known_stops(environment) or [None] * count,
    }
    for key, values in columns.items():
        if len(values) != count:
            raise UserError(f"environment {name!r}: {len(values)} of {key}, and {count} actions")
    rows = zip(*columns.values(), low, high, strict=True)
    return [Action(**dict(zip((*columns, "low", "high"), row, strict=True))) for row in rows]


def known_stops(environment: Environment) -> list[float | None] | None:
    """Return each action's value in a safe stop; None where the environment does not say.

    An environment with a brake of its own (``press_brake``) holds the last action and presses it.
    """
    if callable(offered(environment, "press_brake")):
        return [None] * math.prod(environment.action_space.shape or (1,))
    brake = offered(environment, "brake_action")
    return None if brake is None else [float(value) for value in np.ravel(brake)]


def _period_s(environment: Environment, name: str, unknown_s: float | None) -> float:
    own, config = (offered(environment, key) for key in ("control_period_s", "config"))
    if own is not None:
        return finite("control_period_s", own)
    # Other environments may use these names for things that are no positive number.
    rate = _positive(config.get("policy_frequency")) if isinstance(config, Mapping) else None
    if period_s := (rate and 1.0 / rate) or _positive(offered(environment, "dt")):
        return period_s
    says = f"{name} does not say how long a step is"
    if frames_per_s := _positive(environment.metadata.get("render_fps")):
        say_once(f"{says}: {1.0 / frames_per_s:g} s is guessed from its render_fps")
        return 1.0 / frames_per_s
    if unknown_s is None:
        raise UserError(f"environment {says}; give it --period")
    say_once(f"{says}: {unknown_s} s is taken")
    return unknown_s


def _positive(value: Any) -> float | None:
    is_number = isinstance(value, int | float | np.integer | np.floating)
    return float(value) if is_number and value > 0 else None


def finite(name: str, value: Any) -> float:
    """Return the value as a finite number; UserError for any other."""
    with contextlib.suppress(TypeError, ValueError):
        if math.isfinite(number := float(value)):
            return number
    raise UserError(f"the environment's {name} is {value!r}, no finite number")


def scene_of(environment: Environment) -> dict[str, Any] | None:
    scene = offered(environment, "scene")
    return scene() if callable(scene) else None


def draws(environment: Environment) -> bool:
    modes = environment.metadata.get("render_modes") or ()
    return environment.render_mode == RENDERED and RENDERED in modes


def picture_of(environment: Environment) -> bytes:
    """Return ``render()``'s picture as JPEG; empty for an environment that does not draw."""
    if not draws(environment):
        return b""
    shown = io.BytesIO()
    Image.fromarray(np.asarray(environment.render())).save(shown, "JPEG")
    return shown.getvalue()


class Adapter:
    """Converts a task's actions and observations for its environment.

    The environment's ``brake_action`` and ``press_brake`` outrank the task's safe stop values.
    """

    def __init__(self, env: Environment, task: Task) -> None:
        self.env, self.task = env, task
        space: Any = env.action_space
        self._space = space
        self.hands_off: np.ndarray = np.clip(0.0, space.low, space.high).astype(space.dtype)
        """Zero, or the nearest in range: the action before the first command."""
        self.last = self.hands_off

    def pack(self, observation: Any) -> dict[str, bytes]:
        return {name: each.tobytes() for name, each in arrays_of(self.task, observation).items()}

    def within(self, action: Any) -> np.ndarray:
        values = np.asarray(action, self._space.dtype).reshape(self._space.shape)
        self.last = np.clip(values, self._space.low, self._space.high)
        return self.last

    def stop(self) -> np.ndarray:
        if (own := offered(self.env, "brake_action")) is not None:
            return self.within(own)
        pairs = zip(self.task.action, self.last.ravel().tolist(), strict=True)
        return self.within([last if row.stop is None else row.stop for row, last in pairs])

    def press_brake(self, pressed: bool) -> None:
        press = offered(self.env, "press_brake")
        if callable(press):
            press(pressed)


def arrays_of(task: Task, observation: Any) -> dict[str, np.ndarray]:
    """Return the task's entries; UserError for another shape, or where a number would change."""
    if not isinstance(observation, Mapping):
        observation = {next(iter(task.observation)): observation}
    return {name: _fitting(observation, name, entry) for name, entry in task.observation.items()}


def _fitting(observation: Mapping[str, Any], name: str, entry: Entry) -> np.ndarray:
    try:
        original = np.asarray(observation[name])
        array = np.asarray(original, entry.dtype)
    except (LookupError, TypeError, ValueError) as error:
        raise UserError(f"the observation {name}: {type(error).__name__}: {error}") from None
    if array.shape != tuple(entry.shape):
        raise UserError(f"the observation {name} is {array.shape}, not {tuple(entry.shape)}")
    is_whole = original.dtype.kind in "iub"  # A float may be rounded; these must not change
    if array.dtype.kind != "f" and not (is_whole and np.array_equal(array, original)):
        value = f"{original.ravel()[np.argmax(array != original)]} ({original.dtype})"
        raise UserError(f"the observation {name} holds {value}; it must be {array.dtype}")
    return array
