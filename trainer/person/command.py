"""``trainer train --human keyboard`` and so on: the person, opened and closed around the run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from edge_runtime.files import make_directory
from edge_runtime.util import counted
from trainer.person.options import person_options
from trainer.person.registry import HUMANS
from trainer.person.run import PersonRun, check_settings
from trainer.training.config import RunConfig


@contextmanager
def training_with_person(
    arguments: argparse.Namespace, config: RunConfig, run_dir: Path
) -> Iterator[PersonRun]:
    """A run with a person in it, who keeps everything whatever ends it."""
    check_settings(config)
    person = HUMANS[arguments.human](person_options(arguments))
    try:
        make_directory(run_dir)
        training = PersonRun(config, run_dir, person, arguments.resume, arguments.speed)
        steps, human = training.recovered
        if steps:
            print(
                f"{steps} recorded steps after the checkpoint, {human} of them yours, are back",
                file=sys.stderr,
            )
        yield training
        print(summary(training), file=sys.stderr)
    finally:
        person.close()


def summary(training: PersonRun) -> str:
    """What the sitting amounts to, in a line."""
    sitting = training.sitting
    if not sitting.recorder.index:
        return "nothing was driven, and nothing recorded"
    discarded = f"{counted(sitting.discarded, 'episode')} discarded, " * bool(sitting.discarded)
    return (
        f"{counted(sitting.episodes, 'episode')}, {discarded}"
        f"{counted(sitting.interventions, 'intervention')}, "
        f"{counted(sitting.human_steps, 'step')} yours; "
        f"{counted(sitting.pacer.late, 'control period')} late, "
        f"checkpoints in {training.longest_save_s:.2f} s at most: {sitting.recorder.path}"
    )
