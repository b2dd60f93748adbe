"""``train --demonstrations``: drives that fill the replay before the first step.

A person's sittings hold whole transitions. A recording of the wire holds actions, which are driven
again in the run's environment; one of `bridge sense` is used as it is, since it cannot be driven
again. A LeRobot data set holds observations and actions, with one picture per frame; a stack is
rebuilt from earlier frames. ``human:N`` stands for N drives of a scripted human.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge import fork
from bridge.clocks import STANDSTILL_MPS
from bridge.environments import NOMINAL
from bridge.messages import is_picture
from bridge.recording import Recording, choose_vehicle, valid_messages
from edge_runtime.manifest import Layout
from edge_runtime.util import UserError, read_json
from edge_runtime.wire import DRIVE, Feedback, State
from trainer.environments import BEYOND, as_array, check_recorded, inner, outer, task_of
from trainer.evaluation import Drive, Driver
from trainer.learner.replay import Transition
from trainer.person.recording import TOPIC, find_recordings, nonempty, read_episodes_of
from trainer.util import Purpose, episode_seed, fitting

Episode = list[Transition]
REWARD = "next.reward"  # Column of a data set; ours have none
SCRIPTED = re.compile(r"human:([1-9]\d*)")
"""Instead of a path: N drives of the run's scripted human, or of the expert beside a person."""


def read_demonstrations(place: Path, env: Any) -> Iterator[Episode]:
    """Yield the episodes of sittings, recordings (a file, or a directory of them) or a data set.

    Raises UserError: nothing of that kind, or of another task.
    """
    if (place / "meta/info.json").is_file():
        with fitting(f"{place} is damaged, or not of {env.scenario}"):
            yield from _from_dataset(place, env)
        return
    paths = nonempty(sorted(place.glob("*.mcap"))) if place.is_dir() else [place]
    for path in paths or find_recordings([place]):
        channel = next((channel for channel, _ in Recording(path).messages()), None)
        if channel is None:  # A sitting that was killed before its first step
            continue
        if channel.topic == TOPIC:
            for steps in read_episodes_of(env, path):
                yield [step.transition() for step in steps]
        else:
            drives = fork.read_episodes(path)
            again = (_driven_again(drive, env) for drive in drives)
            yield from again if drives else _as_recorded(path, env)


def drive_demonstrations(driver: Driver, env: Any, seed: int, episodes: int) -> Iterator[Episode]:
    """Yield episodes that the driver drives alone, with seeds derived from the run's ``seed``."""
    for number in range(episodes):
        drive, episode = Drive(env, episode_seed(seed, Purpose.DEMONSTRATIONS, number)), Episode()
        driver.reset()
        while not drive.over:
            drive.step(driver.act(drive.observation))
            episode.append(replace(drive.transition, overruled=None, human=True))
        yield episode


def _driven_again(drive: fork.RecordedEpisode, env: Any) -> Episode:
    """Drive the recorded actions again from the recorded seed; return the new transitions."""
    recorded, wanted = (drive.task.text, drive.origin.condition), (task_of(env).text, NOMINAL)
    if recorded != wanted:
        raise UserError(f"{drive.path} is of {' in the scene '.join(recorded)}, not of {wanted[0]}")
    options = {"standing": True} if drive.origin.standing else None
    observation, _ = env.reset(seed=drive.origin.seed, options=options)
    press_brake, episode = getattr(env, "press_brake", lambda pressed: None), Episode()
    for step in range(drive.steps):
        applied, braked = drive.applied[step]
        press_brake(braked)
        action = inner(env.action_range, applied)
        following, reward, terminated, truncated, _ = env.step(action)
        episode.append(
            Transition(observation, action, reward, following, terminated, truncated, human=True)
        )
        observation = following
        if terminated or truncated:
            break
    press_brake(False)
    return episode


def _as_recorded(path: Path, env: Any) -> Iterator[Episode]:
    """Yield the recorded observations with the vehicle's reported actions, without rewards.

    Where the runtime did not drive, a person did, by the vehicle's own remote control. Standstill
    before and after a drive is cut off. Raises UserError if the vehicle never moved.
    """
    recording, task, feedback = Recording(path), task_of(env), None
    layout, drives = Layout(task), dict[tuple[str, int], list[tuple[State, Feedback | None]]]()
    for _, message in valid_messages(recording, choose_vehicle(recording, None)):
        if isinstance(message, Feedback):
            feedback = message
        elif isinstance(message, State):
            if message.task != task.text or layout.refusal(message.observation):
                raise UserError(f"{path} is of {message.task}, not of {task.text}")
            drives.setdefault((message.session, message.episode), []).append((message, feedback))
    recording.say_trouble()

    def seen(state: State) -> NDArray[Any]:
        return as_array(env.layout, layout.arrays(state.observation))

    ever_moved = False
    for drive in drives.values():
        steps = [
            (state, after, report) for (state, _), (after, report) in pairwise(drive)
            if report is not None and after.step == state.step + 1
        ]  # fmt: skip
        rows = [n for n, (*_, report) in enumerate(steps) if abs(report.speed_mps) > STANDSTILL_MPS]
        if not rows:
            continue
        ever_moved, steps = True, steps[rows[0] : rows[-1] + 1]
        yield [
            Transition(seen(state), inner(env.action_range, report.action), 0.0, seen(after),
                       False, n == len(steps), report.mode != DRIVE)
            for n, (state, after, report) in enumerate(steps, 1)
        ]  # fmt: skip
    if not ever_moved:
        raise UserError(f"{path} shows no drive: the vehicle never moved, or nobody recorded it")


def _from_dataset(folder: Path, env: Any) -> Iterator[Episode]:
    """Yield the episodes of a LeRobotDataset v3.0 with this task's features."""
    try:
        import av
        from pyarrow.parquet import read_table
    except ImportError:
        raise UserError(
            "a data set needs av and pyarrow: pip install 'phil-hil[lerobot]'"
        ) from None

    task, info = task_of(env), read_json(folder / "meta/info.json", "data set")
    wanted, rate = [row.name for row in task.action], 1.0 / task.control_period_s
    names, fps = info["features"]["action"]["names"] or wanted, info["fps"]
    if names != wanted or not math.isclose(fps, rate, rel_tol=1e-3):
        raise UserError(f"{folder} has actions {names} at {fps:g} Hz, not {wanted} at {rate:g}")
    entries = task.observation
    plain = [name for name, entry in entries.items() if not is_picture(entry)]
    keys = {name: "observation.state" if len(plain) == 1 else f"observation.{name}"
            for name in plain}  # fmt: skip
    table = read_table(folder / "data").to_pydict()
    if missing := {"action", "episode_index", *keys.values()} - table.keys():
        raise UserError(f"{folder} lacks the features {', '.join(sorted(missing))}")
    observations = np.zeros((len(table["action"]), *env.layout.shape), env.layout.dtype)
    for name, entry in entries.items():
        column = observations[name] if observations.dtype.names else observations
        if name in keys:
            column[...] = np.reshape(table[keys[name]], column.shape)
            continue
        videos = sorted((folder / f"videos/observation.images.{name}").rglob("*.mp4"))
        colours = "rgb24" if entry.shape[-1] == 3 else "gray"
        frames = [f.to_ndarray(format=colours) for v in videos for f in av.open(str(v)).decode()]
        column[...] = _stacked(np.array(frames), column.shape, table["episode_index"])
    given = np.reshape(table["action"], (len(observations), -1))
    actions = [inner(env.action_range, action) for action in given]
    rewards = np.asarray(table.get(REWARD, np.zeros(len(actions))))
    same = np.isclose(given, [outer(env.action_range, action) for action in actions], atol=1e-4)
    if not (same.all() and np.isfinite(rewards).all()):
        raise UserError(f"{folder} holds {BEYOND}")
    done = table.get("next.done", np.zeros(len(actions), bool))
    for _, group in groupby(range(len(actions)), key=lambda row: table["episode_index"][row]):
        rows = list(group)
        for row in rows:
            check_recorded(env, folder, observations[row], actions[row])
        yield [
            Transition(observations[row], actions[row], float(rewards[row]), observations[after],
                       False, bool(done[row]), human=True)
            for row, after in pairwise(rows)
        ]  # fmt: skip


def _stacked(
    frames: NDArray[np.uint8], shape: tuple[int, ...], episodes: list[int]
) -> NDArray[np.uint8]:
    """Return pictures of ``shape``, [n, ...], stacked within an episode with the newest last."""
    if frames.ndim == len(shape):
        return frames
    row, begins = np.arange(len(frames)), np.searchsorted(episodes, episodes)
    ages = range(shape[1] - 1, -1, -1)
    return np.stack([frames[np.maximum(row - age, begins)] for age in ages], 1)
