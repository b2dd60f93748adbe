"""One sitting: a person, a pace and a recording around an environment; and the command ``drive``.

In ``drive`` a policy or the person drives, every step is recorded, and nothing is learned.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from msgspec import structs

from bridge.fork import ForkedEnvironment, find_fork
from bridge.outcomes import DISCARDED, RESTARTED, STOPPED, failed, settled
from edge_runtime.cli import quit_on_signals
from edge_runtime.files import check_writable
from edge_runtime.util import UserError, counted
from trainer.drivers import load_driver, located
from trainer.environments import Adapted, make_environment, scenario_of
from trainer.evaluation import trained_in
from trainer.human.guide import Action, Driver, Observation
from trainer.options import set_threads
from trainer.person.coach import Coach, SittingEpisode
from trainer.person.controls import controls_of
from trainer.person.interface import (
    Amount,
    Person,
    Reading,
    View,
    amount,
    open_person,
    vector,
)
from trainer.person.recording import Recorder, Step, packed
from trainer.person.takeover import Applied, Intent, TakeOver
from trainer.scenarios import SCENARIOS
from trainer.util import Purpose, episode_seed

REST_S = 1.0  # Between two episodes: time to see how it ended, and to take the hands to rest
BARE: dict[str, Any] = {"roads": (), "road_width_m": 4.0, "path": (), "goal": None, "vehicles": ()}
"""What an environment's scene may leave out."""
LATE_S = 0.02
"""A control period that begins later than this counts as late: a fifth of a period, about what a
person notices."""


def run(arguments: argparse.Namespace) -> int:
    """Drive until the person quits; returns the exit status."""
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
        recorder = Recorder(out)
        made = Sitting(person, recorder, env, alone=policy is None, speed=arguments.speed)
        with closing(made) as sitting, quit_on_signals(sitting.quit):
            outcomes = drive(sitting, policy, seed_of, arguments.episodes)
    print(f"outcomes: {_listed(outcomes) or 'none'}; {sitting.summary()}")
    return 0


SeedOf = Callable[[int], int]  # Of an episode, given its number over all sittings


def _environment(asked: argparse.Namespace) -> tuple[Any, SeedOf]:
    """What is driven: episodes that are others in every sitting, or one recorded drive's."""
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


def drive(
    sitting: Sitting, policy: Driver | None, seed_of: SeedOf, episodes: int | None
) -> Counter[str]:
    """Drive until the person quits, or so many episodes (None: no end); how often one ended how.

    The policy drives until the person takes over; without one, the person drives alone.
    """
    outcomes = Counter[str]()
    number = sitting.recorder.sitting
    while not sitting.stop and outcomes.total() != episodes:
        seed = seed_of((number << 32) + sitting.episode)
        try:
            observation, _ = sitting.reset(seed)
        except SittingOver:
            break
        if policy is not None:
            policy.reset()
        ended = False
        while not ended:
            policy_action = None if policy is None else amount(policy.act(observation))
            applied = sitting.decide(observation, policy_action)
            action = vector(applied.action)
            observation, _, terminated, truncated, info = sitting.step(action)
            ended = terminated or truncated
        outcomes[sitting.rest(info["outcome"])] += 1
        sitting.episode += 1
        sitting.progress = _listed(outcomes)
    return outcomes


def _listed(outcomes: Counter[str]) -> str:
    return ", ".join(f"{count} {word}" for word, count in outcomes.items())


class SittingOver(Exception):  # noqa: N818 (no error: it was asked for)
    """The person has quit between two episodes."""


class Sitting:
    """A scenario's environment with a person at the wheel, from the cockpit's opening to its end.

    The loop calls ``reset``, then ``decide`` before and ``step`` for each control period, and
    ``rest`` after an episode. All else is the environment's own. ``alone``: nobody but the person
    drives; ``speed``: simulated seconds in one of the person's.
    """

    def __init__(
        self, person: Person, recorder: Recorder, env: Any, alone: bool = False, speed: float = 1.0
    ) -> None:
        self.env = env
        self.person, self.recorder, self.alone = person, recorder, alone
        self.pacer = Pacer(env.control_period_s / speed)
        self.stop = False  # The sitting is to end: asked for by the person, or by a signal
        self.closed = False
        self.episode = 0  # The number of the episode, or of the next one; the loop counts
        self.progress = ""
        self.episodes = self.interventions = self.human_steps = self.discarded = 0
        """Discarded episodes are counted in `discarded` alone."""
        self.cost: dict[str, float] = {"human_s": 0.0, "takeovers": 0, "failures": 0}
        """What the person has given so far, seconds of simulated time, in discarded episodes, too,
        and the episodes that missed the goal. A run that goes on adds what it had."""
        self.ended: list[str] = []  # How each episode ended
        self.coach = Coach()
        self._taken_over_at = math.nan  # The step at which the last take-over began
        self._paused = False
        self._last_step: Step | None = None
        """Of an episode that has ended, until it is known whether the person discards it."""
        self._frames: Observation | None = None
        """What the policy sees; None before the first episode, when there is nothing to show."""
        self._policy_action: Amount | None = None
        self._layout = env.layout
        self._rest = amount(env.rest_action)
        self._info: dict[str, Any] = {}
        self._forget(0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, seed: int) -> tuple[Observation, dict[str, Any]]:
        """Start an episode as soon as the person is there; SittingOver where the person quits."""
        self._frames, self._info = self.env.reset(seed=seed)
        self._forget(seed)
        while not self.person.present and not self.stop:
            self._idle("waiting for the person's device")
        if self.stop:
            raise SittingOver
        self._restart = self._discard = False
        self.pacer.restart()
        return self._frames, self._info

    def decide(self, observation: Observation, policy_action: Amount | None) -> Applied:
        """Show what is, wait for the control period, and ask the hands as late as possible.

        ``policy_action`` is what the policy would do about the observation, in
        [-1, 1]; None where the person drives alone.
        """
        self._frames, self._policy_action = observation, policy_action
        self.show()
        self.pacer.wait()
        self._read()
        if self._paused:
            while self._paused and not self._to_end:
                self._idle("")
            self._paused = False
            self.pacer.restart()
        if policy_action is not None:
            holds = self._intent.update(self._reading, time.monotonic())
            self._applied = self._take_over.step(policy_action, self._reading.action, holds)
        elif self.person.present:
            first = self._number == 0 or not self._applied.human
            self._applied = Applied(self._reading.action, "human", True, first)
        else:  # The car rolls, and that demonstrates nothing.
            self._applied = Applied(self._rest, "policy", False, False)
        return self._applied

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control period; it is recorded. The person may end the episode after it."""
        assert self._frames is not None
        now = self._now()
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._info = info
        if self._to_end and not (terminated or truncated):
            truncated = True
            info = {**info, "outcome": STOPPED if self.stop else RESTARTED}
        applied = self._applied
        step = Step(
            **now,
            sitting=self.recorder.sitting,
            index=self.recorder.index,
            seed=self._seed,
            time_ns=self._read_ns,
            seen=packed(self._frames),
            seen_next=packed(observation),
            action=applied.action,
            human=applied.human,
            first=applied.first,
            reward=float(reward),
            terminated=terminated,
            truncated=truncated,
            outcome=info.get("outcome", ""),
        )
        if terminated or truncated:
            self._last_step = step
        else:
            self.recorder.write(step)
        self._human_steps += applied.human
        self._interventions += applied.first
        if applied.first:
            self._taken_over_at = self._number
        self.cost["human_s"] += applied.human * self.env.control_period_s
        self.cost["takeovers"] += applied.first
        self._number += 1
        return observation, reward, terminated, truncated, info

    def rest(self, outcome: str) -> str:
        """Show how the episode ended, which the person may still discard; how it really ended."""
        # Counted in periods: on a machine that stands still, too, the person is asked.
        for _ in range(math.ceil(REST_S / self.env.control_period_s)):
            if self.stop:
                break
            self._idle("episode discarded" if self._discard else f"episode ended: {outcome}")
            if self._discard:
                self._write_last_step()  # At once: no kill shall take that back.
        self._write_last_step()
        told = DISCARDED if self._discard else outcome
        self.ended.append(told)
        self.cost["failures"] = sum(map(failed, settled(self.ended)))
        period_s = self.env.control_period_s
        driven_s = self._human_steps * period_s
        since_s = (self._number - self._taken_over_at) * period_s
        episode = SittingEpisode(self.episode, told, driven_s, self._interventions, since_s)
        self.coach.episodes.append(episode)
        if self._discard:
            self.discarded += 1
            return DISCARDED
        self.episodes += 1
        self.human_steps += self._human_steps
        self.interventions += self._interventions
        return outcome

    def show(self, message: str = "") -> None:
        """Show what is, and a line on what is going on besides driving."""
        if self._frames is None or self.closed:
            return
        scene = self.env.scene()
        view = View(
            **self._now(),
            scene=None if scene is None else {**BARE, **scene},
            picture=self.env.render() if scene is None else None,
            frames=self._frames if self._layout.stacked else None,
            applied_action=self._applied.action,
            distance_m=float(self._info["distance_m"]),
            goal_m=float(self.env.goal_m),
            late_ticks=self.pacer.late,
            paused=self._paused,
            progress=self.progress,
            coach=self.coach.show(self.cost),
            message=message,
        )
        self.person.show(view)

    def _now(self) -> dict[str, Any]:
        """What a view and a recorded step both say of the control period."""
        return {
            "scenario": self.env.scenario,
            "episode": self.episode,
            "step": self._number,
            "time_s": self._number * self.env.control_period_s,
            "policy_action": self._policy_action,
            "human_action": self._reading.action,
            "control": self._applied.control,
            "speed_mps": float(self._info["speed_mps"]),
        }

    def summary(self) -> str:
        """What it amounts to, in a line."""
        if not self.recorder.index:
            return "nothing was driven, and nothing recorded"
        discarded = f"{counted(self.discarded, 'episode')} discarded, " * bool(self.discarded)
        return (
            f"{counted(self.episodes, 'episode')}, {discarded}"
            f"{counted(self.interventions, 'intervention')}, "
            f"{counted(self.human_steps, 'step')} yours, "
            f"{counted(self.pacer.late, 'control period')} late: {self.recorder.path}"
        )

    def quit(self) -> bool:
        """Ask for the end of the sitting; False where it is over already."""
        self.stop = self.stop or not self.closed
        return not self.closed

    def close(self) -> None:
        """Close the cockpit and the recording; a second call does nothing."""
        self.closed = True
        self._write_last_step()
        self.recorder.close()
        self.person.close()

    @property
    def _to_end(self) -> bool:
        """Whether the person wants the episode to end."""
        return self.stop or self._restart or self._discard

    def _write_last_step(self) -> None:
        """Record an episode's last step, which says whether it was discarded."""
        step, self._last_step = self._last_step, None
        if step is not None:
            outcome = DISCARDED if self._discard else step.outcome
            self.recorder.write(structs.replace(step, outcome=outcome))

    def _forget(self, seed: int) -> None:
        """Nothing of an episode has happened yet."""
        self._seed, self._number = seed, 0
        self._take_over, self._intent = TakeOver(), Intent(self._rest)
        self._reading, self._read_ns = Reading(self._rest), 0
        self._applied = Applied(self._rest, "human" if self.alone else "policy", self.alone, False)
        self._policy_action = None
        self._human_steps = self._interventions = 0
        self._taken_over_at = math.nan
        self._restart = self._discard = False

    def _read(self) -> None:
        """Ask the hands, and heed what they wish."""
        self._read_ns = time.time_ns()
        self._reading = self.person.poll(time.monotonic())
        wishes = self._reading.wishes
        self.stop |= "quit" in wishes
        self._restart |= "restart" in wishes
        self._discard |= "discard" in wishes
        self._paused ^= "pause" in wishes

    def _idle(self, message: str) -> None:
        """A control period in which nothing moves."""
        self.show(message)
        self.pacer.restart()
        self.pacer.wait()
        self._read()


class Pacer:
    """Absolute deadlines, one a period, so that one delay does not make every later period late.

    A delay of less than a period is caught up. After a longer one the deadlines begin anew: a car
    that leaps through what was missed cannot be driven.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.late = 0  # Periods that began too late
        self.restart()

    def restart(self) -> None:
        """Let the next period begin one period from now: after a pause, or a new episode."""
        self._deadline_s = time.monotonic() + self.period_s

    def wait(self) -> None:
        """Wait for the next period to begin."""
        # A signal that another thread took does not wake Python's main thread. A period is short
        # enough to notice it afterwards.
        while (left_s := self._deadline_s - time.monotonic()) > 0.0:
            time.sleep(left_s)
        self.late += -left_s > LATE_S
        if -left_s < self.period_s:
            self._deadline_s += self.period_s
        else:
            self.restart()
