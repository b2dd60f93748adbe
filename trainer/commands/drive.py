"""Drive yourself, or take over from a policy; every step is recorded, nothing is learned."""

from __future__ import annotations

import argparse
from pathlib import Path

from edge_runtime.cli import add_public_key, examples, not_negative, positive
from edge_runtime.util import UserError, counted
from trainer.commands.options import add_scenario, add_threads, set_threads
from trainer.drivers import load_driver, make_environment
from trainer.person.options import add_person, person_options
from trainer.person.recording import Recorder
from trainer.person.registry import HUMANS
from trainer.person.sitting import Sitting
from trainer.signals import quit_on_signals

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
        help="what your hands are on",
    )
    parser.add_argument(
        "--policy",
        metavar="POLICY",
        help="who drives until you take over: see `trainer evaluate` (default: you drive alone)",
    )
    add_public_key(parser)
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument(
        "--out",
        metavar="REC_DIR",
        default="runs/drives",
        help="directory of the recordings; sittings add up there",
    )
    goal.add_argument(
        "--calibrate",
        metavar="F.toml",
        help="do not drive: ask for a wheel's or gamepad's axes and buttons, write a profile",
    )
    parser.add_argument(
        "--episodes", type=positive, default=None, help="stop after so many (default: no end)"
    )
    parser.add_argument(
        "--seed", type=not_negative, default=0, help="of the episodes, others in every sitting"
    )
    add_person(parser)
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Drive until the person quits; returns the exit status."""
    from trainer.person.drive import drive

    if arguments.calibrate is not None:
        return _calibrate(arguments)
    set_threads(arguments.threads)
    env = make_environment(arguments.scenario)
    policy = None
    if arguments.policy is not None:
        policy, _ = load_driver(arguments.policy, env, arguments.public_key)
    person = HUMANS[arguments.human](person_options(arguments))
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
    ends = ", ".join(f"{count} {word}" for word, count in outcomes.items()) or "none"
    print(
        f"episodes: {ends}; {counted(recorder.index, 'step')}, "
        f"{sitting.human_steps} of them yours in "
        f"{counted(sitting.interventions, 'intervention')}; "
        f"{counted(sitting.pacer.late, 'control period')} late"
    )
    if recorder.index:
        print(recorder.path)
    return 0


def _calibrate(arguments: argparse.Namespace) -> int:
    if arguments.human not in ("gamepad", "wheel"):
        raise UserError("--calibrate asks a --human gamepad or wheel")
    from trainer.person.calibrate import calibrate

    calibrate(arguments.human, Path(arguments.calibrate))
    return 0
