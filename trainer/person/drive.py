"""Drive yourself, or take over from a policy: every step is recorded, and nothing is learned."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from edge_runtime.cli import add_public_key, examples, positive
from edge_runtime.util import UserError, counted
from trainer.drivers import load_driver, make_environment
from trainer.human.guide import Driver
from trainer.options import add_scenario, add_seed, add_threads, set_threads
from trainer.person.interface import HUMANS, add_person, open_person
from trainer.person.recording import Recorder
from trainer.person.session import Sitting, SittingOver
from trainer.util import Purpose, episode_seed, quit_on_signals

EXAMPLE = examples(
    "python -m trainer drive --human keyboard --out runs/drives",
    "python -m trainer drive --policy runs/phil_1 --human wheel --profile my.toml \\\n"
    "    --out runs/drives",
    "python -m trainer drive --human wheel --calibrate my.toml",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_scenario(parser)
    parser.add_argument(
        "--human",
        "--device",
        dest="human",
        choices=list(HUMANS),
        default="keyboard",
        help="the device that your hands are on",
    )
    parser.add_argument(
        "--policy",
        metavar="POLICY",
        help="what drives until you take over: see `trainer evaluate` (default: you drive alone)",
    )
    add_public_key(parser)
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument(
        "--out",
        metavar="REC_DIR",
        default="runs/drives",
        help="the directory of the recordings; sittings add up there",
    )
    goal.add_argument(
        "--calibrate",
        metavar="F.toml",
        help="instead of driving, ask for a wheel's or gamepad's axes and buttons, and write a "
        "profile",
    )
    parser.add_argument(
        "--episodes",
        type=positive,
        metavar="N",
        help="stop after so many episodes (default: no end)",
    )
    add_seed(parser, "the episodes, which are others in every sitting")
    add_person(parser)
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Drive until the person quits; returns the exit status."""
    if arguments.calibrate is not None:
        if arguments.human not in ("gamepad", "wheel"):
            raise UserError("--calibrate asks a --human gamepad or wheel")
        from trainer.person.profile import calibrate

        calibrate(arguments.human, Path(arguments.calibrate))
        return 0
    set_threads(arguments.threads)
    env = make_environment(arguments.scenario)
    policy = None
    if arguments.policy is not None:
        policy, _ = load_driver(arguments.policy, env, arguments.public_key)
    person = open_person(arguments)
    try:
        recorder = Recorder(Path(arguments.out))
        sitting = Sitting(person, recorder, env, alone=policy is None, speed=arguments.speed)
        try:
            with quit_on_signals(sitting.quit):
                outcomes = drive(sitting, policy, arguments.seed, arguments.episodes)
        finally:
            sitting.close()
    finally:
        person.close()
    print(
        f"episodes: {_listed(outcomes) or 'none'}; {counted(recorder.index, 'step')}, "
        f"{sitting.human_steps} of them yours in "
        f"{counted(sitting.interventions, 'intervention')}; "
        f"{counted(sitting.pacer.late, 'control period')} late"
    )
    if recorder.index:
        print(recorder.path)
    return 0


def drive(
    sitting: Sitting, policy: Driver | None, run_seed: int, episodes: int | None
) -> Counter[str]:
    """Drive until the person quits, or so many episodes (None: no end).

    The policy drives until the person takes over; without one, the person drives alone. The seed
    decides the episodes, which are others in every sitting.

    Returns:
        How often an episode ended how.
    """
    outcomes = Counter[str]()
    number = sitting.recorder.sitting
    while not sitting.stop and outcomes.total() != episodes:
        seed = episode_seed(run_seed, Purpose.SITTINGS, (number << 32) + sitting.episode)
        try:
            observation, _ = sitting.reset(seed)
        except SittingOver:
            break
        if policy is not None:
            policy.reset()
        ended = False
        while not ended:
            policy_action = None if policy is None else float(policy.act(observation)[0])
            applied = sitting.decide(observation, policy_action)
            action = np.array([applied.action], np.float32)
            observation, _, terminated, truncated, info = sitting.step(action)
            ended = terminated or truncated
        outcomes[sitting.rest(info["outcome"])] += 1
        sitting.episode += 1
        sitting.progress = _listed(outcomes)
    return outcomes


def _listed(outcomes: Counter[str]) -> str:
    return ", ".join(f"{count} {word}" for word, count in outcomes.items())
