"""The learner's whole update against its peers, in turn.

Each learns from a buffer of 1,000 transitions, not the paper's 100,000: what a full one costs is in
``replay.py``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from trainer.benches.effort import Effort
from trainer.benches.experience import Experience, fill, gather, save
from trainer.benches.peer_process import PeerProcess
from trainer.benches.turns import Contender, Rounds, Tick, compare, median, take_turns
from trainer.benches.updates import Learner, Updates
from trainer.learner.config import PHIL, LearnerConfig
from trainer.learner.networks import multiplies_bfloat16
from trainer.learner.replay import ReplayBuffer
from trainer.learner.td3 import TD3Learner
from trainer.tests.reference import ReferenceLearner

TRANSITIONS = 1000
OURS, FLOAT32, REFERENCE, SB3 = "ours", "ours_float32", "reference", "stable_baselines3"
SB3_SCRIPT = Path(__file__).with_name("sb3_td3.py")


def measure_learner(effort: Effort, sb3_python: Path | None, tick: Tick) -> dict[str, Any]:
    """Milliseconds of a PHIL-TD3 update, of its reference and of Stable-Baselines3's TD3.

    Ours in float32 is beside them where the processor has bfloat16; elsewhere ours is just that.

    Args:
        effort: rounds, and updates a round.
        sb3_python: an interpreter that has Stable-Baselines3; without it that peer is left out.
        tick: called once a round.
    """
    config, experience = LearnerConfig(batch_size=effort.batch_size), gather(TRANSITIONS)
    count = effort.updates_per_round
    precision = _precision(config)
    learners: dict[str, Learner] = {OURS: TD3Learner(config, PHIL, seed=0)}
    if precision != "float32":
        single = replace(config, precision="float32")
        learners[FLOAT32] = TD3Learner(single, PHIL, seed=0)
    learners[REFERENCE] = ReferenceLearner(config, PHIL, seed=0)
    updates = {name: _updates(learner, config, experience) for name, learner in learners.items()}
    contenders: dict[str, Contender] = {
        name: partial(own.run, count) for name, own in updates.items()
    }
    about: dict[str, Any] = {}
    with _sb3(sb3_python, config.batch_size, experience) as sb3:
        if sb3 is not None:
            contenders[SB3] = partial(sb3.run, count)
            about[SB3] = sb3.about
        times_ms = take_turns(contenders, effort.learner_rounds, tick)
    return {
        "batch_size": config.batch_size,
        "transitions": TRANSITIONS,
        "precision": precision,
        "rounds": effort.learner_rounds,
        "updates_per_round": count,
        **summary(times_ms, about),
    }


def summary(times_ms: dict[str, Rounds], about: dict[str, Any]) -> dict[str, Any]:
    """Medians of ours and of each peer, and how many times as long a peer takes."""
    ours = times_ms[OURS]
    return {
        "ms_per_update": median(ours),
        "updates_per_s": 1e3 / median(ours),
        "peers": {
            name: {
                "ms_per_update": median(rounds),
                "ratio": compare(ours, rounds)._asdict(),
                **({"about": about[name]} if name in about else {}),
            }
            for name, rounds in times_ms.items()
            if name != OURS
        },
    }


def _precision(config: LearnerConfig) -> str:
    """What our learner multiplies in on this processor: ``bfloat16`` or ``float32``."""
    return config.precision if multiplies_bfloat16("cpu") else "float32"


def _updates(learner: Learner, config: LearnerConfig, experience: Experience) -> Updates:
    replay = ReplayBuffer(TRANSITIONS)
    fill(replay, experience)
    return Updates(learner, replay, config.batch_size)


@contextmanager
def _sb3(
    python: Path | None, batch_size: int, experience: Experience
) -> Iterator[PeerProcess | None]:
    """The peer with the same experience and as many threads, where there is an interpreter."""
    if python is None:
        yield None
        return
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "experience.npz"
        save(experience, path)
        numbers = (str(torch.get_num_threads()), str(batch_size))
        # -I: nothing but what that interpreter has installed.
        command = [str(python), "-I", str(SB3_SCRIPT), *numbers, str(path)]
        with PeerProcess("the Stable-Baselines3 peer", command) as peer:
            yield peer
