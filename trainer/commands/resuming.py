"""Whether a training may begin in a directory, or go on there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_runtime.util import UserError
from trainer.commands.options import read_json
from trainer.commands.settings import settings
from trainer.drivers import CHECKPOINT_FILE
from trainer.person.options import PERSON
from trainer.person.registry import HUMANS
from trainer.training.config import RunConfig
from trainer.training.run import CONFIG_FILE

OPTIONS = ("scenario", "algorithm", "seed", "human", "latency", "device", "threads")
"""What an option of its own decides."""
EXTENT = ("episodes", "steps")
"""How long a run is: it may go on for longer."""


def check_directory(run_dir: Path, config: RunConfig, resume: bool) -> None:
    """Refuse to overwrite a run, or to resume one under other settings; raises UserError."""
    started = (run_dir / CHECKPOINT_FILE).is_file()
    if started and not resume:
        raise UserError(f"{run_dir} holds a run; add --resume, or choose another --out")
    if resume and not started:
        raise UserError(f"{run_dir} holds no checkpoint to resume from")
    if resume:
        _check_settings(run_dir, config)


def _check_settings(run_dir: Path, config: RunConfig) -> None:
    path = run_dir / CONFIG_FILE
    saved = _flat(read_json(path, "run config"))
    wanted = _flat(config.as_dict())
    if not all(isinstance(saved.get(name), int) for name in EXTENT):
        raise UserError(f"run config {path} does not say how many episodes and steps")
    changed = [
        f"{_given(name, saved)} (now {_value(name, wanted)})"
        for name in wanted
        if name not in EXTENT and (name not in saved or saved[name] != wanted[name])
    ]
    if changed:
        raise UserError(f"{run_dir} was trained with {', '.join(changed)}: repeat what it had")
    for name in EXTENT:
        if 0 < wanted[name] < saved[name]:
            raise UserError(f"{run_dir} is a run of {saved[name]} {name}, not fewer")


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    """A config's settings by their names, those of the learner among them."""
    learner = values.get("learner")
    own = {name: value for name, value in values.items() if name != "learner"}
    return {**own, **learner} if isinstance(learner, dict) else own


def _given(name: str, values: dict[str, Any]) -> str:
    """A setting as it is typed."""
    if name not in values:
        return f"no {name}"
    if name in OPTIONS:
        return f"--{name} {_value(name, values)}"
    word = "--set " if name in settings() else ""
    return f"{word}{name}={_value(name, values)}"


def _value(name: str, values: dict[str, Any]) -> str:
    value = values[name]
    # A run may go on with another device of the person's.
    return "|".join(HUMANS) if (name, value) == ("human", PERSON) else str(value)
