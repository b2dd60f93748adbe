"""The replay buffer when it is full: milliseconds and bytes."""

from __future__ import annotations

import time
import tracemalloc
from typing import Any

import numpy as np

from trainer.benches.effort import Effort
from trainer.benches.experience import Experience, gather
from trainer.benches.memory import apart, resident_bytes
from trainer.learner.replay import ReplayBuffer

EPISODE_STEPS = 60
OBSERVATIONS = 1000
"""Driven ones; they go round until the buffer is full."""


def measure_replay(effort: Effort) -> dict[str, Any]:
    """Drawing, new priorities, adding, and memory, in a fresh process."""
    return apart(_measure, effort)


def _measure(effort: Effort) -> dict[str, Any]:
    transitions, draws = effort.replay_transitions, effort.replay_draws
    random, experience = np.random.default_rng(0), gather(OBSERVATIONS)
    before = resident_bytes()
    tracemalloc.start()
    replay = ReplayBuffer(transitions)
    allocated, _ = tracemalloc.get_traced_memory()
    # Tracing makes the filling five times as slow.
    tracemalloc.stop()
    _fill(replay, experience, transitions)
    grown = resident_bytes() - before
    held = len(replay)
    times_ms = _time(replay, effort, random)
    add_ms = _time_adding(replay, experience, draws)
    return {
        "transitions": held,
        "batch_size": effort.batch_size,
        "draws": draws,
        "sample_ms": float(np.median(times_ms[0])),
        "update_priorities_ms": float(np.median(times_ms[1])),
        "add_ms": add_ms,
        "allocated_mb": 1e-6 * allocated,
        "resident_mb": 1e-6 * grown,
    }


def _fill(replay: ReplayBuffer, experience: Experience, transitions: int) -> None:
    for step in range(transitions):
        if step % EPISODE_STEPS == 0:
            replay.start_episode(experience.frames[step % OBSERVATIONS])
        _add(replay, experience, step)


def _add(replay: ReplayBuffer, experience: Experience, step: int) -> None:
    i = step % OBSERVATIONS
    replay.add(
        experience.actions[i],
        float(experience.rewards[i]),
        experience.frames[i + 1],
        False,
        bool(experience.human[i]),
    )


def _time(
    replay: ReplayBuffer, effort: Effort, random: np.random.Generator
) -> tuple[list[float], list[float]]:
    # As they are after a while, no longer all alike.
    everything = np.arange(len(replay))
    replay.update_priorities(everything, random.exponential(size=len(everything)))
    drawing_ms, updating_ms = [], []
    for _ in range(effort.replay_draws):
        priorities = random.exponential(size=effort.batch_size)
        began_s = time.perf_counter()
        batch = replay.sample(effort.batch_size, random)
        drawn_s = time.perf_counter()
        replay.update_priorities(batch.indices, priorities)
        updating_ms.append(1e3 * (time.perf_counter() - drawn_s))
        drawing_ms.append(1e3 * (drawn_s - began_s))
    return drawing_ms, updating_ms


def _time_adding(replay: ReplayBuffer, experience: Experience, count: int) -> float:
    times_ms = []
    for step in range(count):
        began_s = time.perf_counter()
        _add(replay, experience, step)
        times_ms.append(1e3 * (time.perf_counter() - began_s))
    return float(np.median(times_ms))
