"""The command ``drive``: a policy or the person drives, every step is recorded, nothing learns."""

import argparse
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from bridge.fork import ForkedEnvironment, find_fork
from edge_runtime.cli import quit_on_signals
from edge_runtime.files import check_writable
from edge_runtime.util import UserError
from trainer.drivers import load_driver, located
from trainer.environments import Adapted, make_environment, scenario_of
from trainer.evaluation import trained_in
from trainer.human.guide import Driver, GuideGone, make_transition
from trainer.options import set_threads
from trainer.person.controls import controls_of
from trainer.person.interface import open_person, vector
from trainer.person.recording import Recorder
from trainer.person.session import PacedEnvironment, Sitting, SittingRecorder
from trainer.scenarios import SCENARIOS
from trainer.util import Purpose, episode_seed

SeedOf = Callable[[int], int]  # Of an episode, given its number over all sittings


def run(arguments: argparse.Namespace) -> int:
    """Drive until the person quits; return the exit status."""
    set_threads(arguments.threads)
    arguments.policy = arguments.policy and located(arguments.policy)
    env, seed_of = _environment(arguments)
    arguments.scenario = env.scenario  # By it the cockpit knows its keys.
    policy = None
    if arguments.policy is not None:
        policy, _ = load_driver(arguments.policy, env, arguments.public_key)
    out = Path(arguments.out)
    check_writable(out / "sitting")  # Before a browser opens.
    with closing(env), closing(open_person(arguments)) as person:
        made = Sitting(person, env, Recorder(out), alone=policy is None, speed=arguments.speed)
        with closing(made) as sitting, quit_on_signals(sitting.quit):
            drive(sitting, policy, seed_of, arguments.episodes)
    print(f"outcomes: {_listed(sitting) or 'none'}; {sitting.summary()}")
    return 0


def drive(
    sitting: Sitting, policy: Driver | None, seed_of: SeedOf, episodes: int | None = None
) -> None:
    """Drive until the person quits, or so many episodes (None: no end).

    The policy drives until the person takes over; without one, the person drives alone.
    """
    vehicle = PacedEnvironment(sitting.env, sitting)
    recorder, number = SittingRecorder(vehicle), sitting.recorder.sitting
    while not sitting.stop and sitting.episode != episodes:
        try:
            observation, info = vehicle.reset(seed=seed_of((number << 32) + sitting.episode))
        except GuideGone:
            break
        if policy is not None:
            policy.reset()
        ended = False
        while not ended:
            policy_action = None if policy is None else policy.act(observation)
            intervention = sitting.watch(observation, policy_action)
            action = vector(sitting.applied)
            stepped = vehicle.step(action)
            step = make_transition(observation, policy_action, action, intervention, stepped)
            observation, info = step.next_observation, stepped[-1]
            recorder.record(step, intervention, info)
            ended = step.terminal or step.truncated
        sitting.end_episode(info["outcome"])
        sitting.progress = _listed(sitting)


def _listed(sitting: Sitting) -> str:
    outcomes = Counter(episode.outcome for episode in sitting.driven)
    return ", ".join(f"{count} {word}" for word, count in outcomes.items())


def _environment(asked: argparse.Namespace) -> tuple[Any, SeedOf]:
    """Make what is driven: episodes that are others in every sitting, or one recorded drive's."""
    if asked.recording is None:
        if asked.at or asked.episode is not None or asked.vehicle_id:
            raise UserError("--at, --episode and --vehicle-id need a recording: --from F.mcap")
        seed_of = partial(episode_seed, asked.seed, Purpose.SITTINGS)
        period_s = None
        if asked.policy is not None:
            _, period_s = trained_in(asked.policy, asked.public_key)
        scenario = asked.scenario or "left_turn"
        controls_of(scenario)  # Now: of some simulators only one may live, and this closes its own.
        return make_environment(scenario, period_s=period_s), seed_of
    recorded, step = find_fork(asked.recording, asked)
    own = recorded.environment(asked.scenario, "--scenario")
    name = scenario_of(asked.scenario or recorded.origin.environment)
    is_ours = name in SCENARIOS
    env: Any = ForkedEnvironment(own.unwrapped if is_ours else own, recorded, step)
    env.control_period_s = recorded.task.control_period_s
    return (env if is_ours else Adapted(env, name)), lambda number: recorded.origin.seed
