"""A training that a person guides: the parts of such a run, and what a kill had taken from it."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from edge_runtime.files import make_directory
from edge_runtime.util import UserError
from trainer.human.guide import BY_PERSON, Intervention, Stepped, make_transition
from trainer.learner.config import find_algorithm
from trainer.person.coach import Coach, typical_curve
from trainer.person.interface import open_person, vector
from trainer.person.recording import DIRECTORY, RecordedStep, Recorder, read_episodes, steps_since
from trainer.person.session import PacedEnvironment, Sitting, SittingRecorder
from trainer.person.validation import PersonValidation
from trainer.training.config import RunConfig
from trainer.training.learning import UnhurriedLearning
from trainer.training.metrics import read_metrics, spent
from trainer.training.run import Parts, TrainingRun, make_vehicle

PRETENDED = ("poor_guidance_share", "late_to_s", "missed_share")
"""What makes a scripted human imperfect."""


@contextmanager
def training_with_person(
    arguments: argparse.Namespace, config: RunConfig, run_dir: Path
) -> Iterator[tuple[TrainingRun, Sitting]]:
    """A run with a person as its guide; everything is kept, whatever ends it.

    The recordings go into ``sittings`` in the run's directory, and a resumed run stores what was
    recorded after its checkpoint.
    """
    check_settings(config)
    with ExitStack() as stack:
        person = stack.enter_context(closing(open_person(arguments)))
        make_directory(run_dir)
        env, delayed = make_vehicle(config)
        recorder = Recorder(run_dir / DIRECTORY)
        sitting = Sitting(person, env, recorder, speed=arguments.speed)
        stack.enter_context(closing(sitting))
        learning = UnhurriedLearning(config, env)
        validation = PersonValidation(config, run_dir, learning, sitting)
        stack.enter_context(closing(validation))
        vehicle = PacedEnvironment(delayed or env, sitting)
        recorders = [SittingRecorder(vehicle)]
        parts = Parts(env, delayed, vehicle, sitting, learning, validation, [*recorders])
        training = TrainingRun(config, run_dir, arguments.resume, parts)
        if arguments.resume:
            _recover(training, sitting)
        else:
            training.save()  # So that a run killed in its first episode can be resumed.
        _recall(training, sitting)
        yield training, sitting
        print(sitting.summary(), file=sys.stderr)


def _recover(training: TrainingRun, sitting: Sitting) -> None:
    """Store what was recorded after the checkpoint as if it had just been driven."""
    steps = human = 0
    for episode in read_episodes(steps_since(training.run_dir / DIRECTORY, sitting.saved_at)):
        for step in episode:
            restore_step(training, step)
        training.learning.release()
        steps += len(episode)
        human += sum(step.human for step in episode)
    if steps:
        back = f"{steps} recorded steps after the checkpoint, {human} of them yours, are back"
        print(back, file=sys.stderr)
    # Episodes that ended after the checkpoint count: the person gave what their rows say.
    if ended := read_metrics(training.run_dir)[training.episode :]:
        training.episode += len(ended)
        training.steps = int(ended[-1]["total_steps"])


def restore_step(training: TrainingRun, step: RecordedStep) -> None:
    """Give the learner a recorded step as the loop gives it one that is driven."""
    action = vector(step.action)
    policy_action = action if step.policy_action is None else vector(step.policy_action)
    by_person = Intervention(action, BY_PERSON, step.first) if step.human else None
    stepped: Stepped = step.next_observation, step.reward, step.terminated, step.truncated, {}
    training.learning.add(
        make_transition(
            step.observation, policy_action, action, by_person, stepped,
            training.penalises(by_person), step.foreseen,
        )
    )  # fmt: skip


def _recall(training: TrainingRun, sitting: Sitting) -> None:
    """Tell the sitting of the episodes that the run has driven before it."""
    period_s = training.env.control_period_s
    before = read_metrics(training.run_dir)[: training.episode]
    given = spent(before, period_s)
    given["failures"] = sum(given["failures"].values())
    sitting.episode = training.episode
    sitting.ended = [row["outcome"] for row in before]
    sitting.cost.update({name: given[name] for name in sitting.cost})
    curve = typical_curve(training.config.scenario, training.config.algorithm)
    sitting.coach = Coach(curve, learning=True)
    sitting.coach.recall(before, period_s)


def check_settings(config: RunConfig) -> None:
    """Refuse what a person cannot be a part of; raises UserError."""
    row = find_algorithm(config.algorithm)
    if not row.guided:
        raise UserError(f"{config.algorithm} takes no guidance: nobody could take over")
    if row.asks:
        raise UserError(f"{config.algorithm} asks a scripted human or its model, and no person yet")
    if config.guided_share != 1 or config.guided_until_episode or config.guided_until_step:
        wanted = "guided_share must be 1, guided_until_episode and guided_until_step 0"
        raise UserError(f"a person watches every episode: {wanted}")
    for name in PRETENDED:
        if getattr(config, name):
            raise UserError(f"a person's actions are not replaced: {name} must be 0")
