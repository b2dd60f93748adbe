"""One sitting: a person, a pace and a recording around what drives the environment.

The loop calls ``begin`` after a reset, ``decide`` before and ``moved`` after each of the
environment's steps, and ``rest`` after an episode.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from trainer.person.interface import LET_GO, Person, View
from trainer.person.recording import DISCARDED, Recorder, Step
from trainer.person.takeover import Applied, Intent, TakeOver
from trainer.scenarios.environment import Action
from trainer.scenarios.environment import Step as EnvironmentStep

Observation = NDArray[np.uint8]
REST_S = 1.0
"""Between two episodes: time to see how it ended, and to take the hands to rest."""
STOPPED, RESTARTED = "stopped", "restarted"
"""Outcomes of an episode that the person ended; or ``recording.DISCARDED``."""
LATE_S = 0.02
"""A period that begins later than this is counted: a fifth of it is about what a person feels."""


class SittingOver(Exception):  # noqa: N818 (no error: it was asked for)
    """The person has quit between two episodes."""


class Sitting:
    """From the opening of the window to its closing.

    Args:
        person: hands and eyes.
        recorder: keeps every step.
        env: the scenario that is driven, to show it.
        alone: nobody but the person drives.
        speed: simulated seconds in one of the person's; below one is slow motion.
    """

    def __init__(
        self, person: Person, recorder: Recorder, env: Any, alone: bool = False, speed: float = 1.0
    ) -> None:
        self.person, self.recorder, self.env, self.alone = person, recorder, env, alone
        self.pacer = Pacer(env.config.control_period_s / speed)
        self.stop = False
        """The sitting is to end: asked for by the person, or by a signal."""
        self.progress = ""
        self.episodes = self.interventions = self.human_steps = self.discarded = 0
        """The last counts what the others leave out."""
        self._last_step: Step | None = None
        """Of an episode that has ended, until it is known whether the person discards it."""
        self._take_over, self._intent = TakeOver(), Intent(person.moving)
        self._paused = False
        self.closed = False
        self._begun = False
        """There is something to show."""
        self._policy_action: float | None = None
        self._frames: Observation = env.frames
        self._forget(0, 0)

    def begin(self, observation: Observation, episode: int, seed: int) -> None:
        """Start an episode as soon as the person is there.

        Raises:
            SittingOver: the person quits instead.
        """
        self._forget(episode, seed)
        self._frames, self._begun = observation, True
        while not self.person.device.present and not self.stop:
            self._idle("waiting for the person's device")
        if self.stop:
            raise SittingOver
        self._restart = self._discard = False
        self.pacer.restart()

    def decide(self, observation: Observation, policy_action: float | None) -> Applied:
        """Show what is, wait for the control period, and ask the hands as late as possible.

        Args:
            observation: what the policy sees, uint8 [2, 45, 80].
            policy_action: what it would do, in [-1, 1]; None where the person drives alone.
        """
        self._frames, self._policy_action = observation, policy_action
        self._show()
        self.pacer.wait()
        self._read()
        if self._paused:
            self._pause()
        self._applied = self._weigh(policy_action)
        return self._applied

    def moved(
        self,
        next_observation: Observation,
        reward: float,
        terminated: bool,
        truncated: bool,
        outcome: str | None,
    ) -> tuple[bool, str | None]:
        """Keep the step that ``decide`` led to.

        Args:
            next_observation: s', uint8 [2, 45, 80].
            reward: the environment's.
            terminated: it ends the episode.
            truncated: its time is over.
            outcome: how it ended, if it did.

        Returns:
            ``truncated`` and ``outcome``, as the person has them who may end the episode here.
        """
        if not (terminated or truncated) and (self.stop or self._restart or self._discard):
            outcome, truncated = STOPPED if self.stop else RESTARTED, True
        step = self._step(next_observation, reward, terminated, truncated, outcome)
        if terminated or truncated:
            self._last_step = step
        else:
            self.recorder.write(step)
        self._human_steps += self._applied.human
        self._interventions += self._applied.first
        self._number += 1
        return truncated, outcome

    def rest(self, outcome: str) -> str:
        """Show for a moment how the episode ended; the person may still discard it.

        Returns:
            How it ended, now that it is known.
        """
        end_s = time.monotonic() + REST_S * self.pacer.period_s / self.env.config.control_period_s
        while not self.stop and time.monotonic() < end_s:
            self._idle("episode discarded" if self._discard else f"episode ended: {outcome}")
            if self._discard:
                self._write_last_step()  # At once: no kill shall take that back.
        self._write_last_step()
        if self._discard:
            self.discarded += 1
            return DISCARDED
        self.episodes += 1
        self.human_steps += self._human_steps
        self.interventions += self._interventions
        return outcome

    def announce(self, message: str) -> None:
        """Show a line before something that takes a moment."""
        self._show(message)

    def quit(self) -> bool:
        """Ask for the end of the sitting; False where it is over already."""
        self.stop = self.stop or not self.closed
        return not self.closed

    def close(self) -> None:
        """Close the person's devices and the recording; twice is once."""
        self.closed = True
        self.person.close()
        self._write_last_step()
        self.recorder.close()

    def _write_last_step(self) -> None:
        """Record an episode's last step, which says whether it was discarded."""
        step, self._last_step = self._last_step, None
        if step is not None:
            outcome = DISCARDED if self._discard else step.outcome
            self.recorder.write(structs.replace(step, outcome=outcome))

    def _forget(self, episode: int, seed: int) -> None:
        """Nothing of an episode has happened yet."""
        self._episode, self._seed, self._number = episode, seed, 0
        self._take_over.reset()
        self._intent.reset()
        self._reading, self._read_ns = LET_GO, 0
        self._applied = Applied(0.0, "human" if self.alone else "policy", self.alone, False)
        self._policy_action = None
        self._human_steps = self._interventions = 0
        self._restart = self._discard = False

    def _weigh(self, policy_action: float | None) -> Applied:
        if policy_action is None:
            return self._alone()
        holds = self._intent.update(self._reading, time.monotonic())
        return self._take_over.step(policy_action, self._reading.action, holds)

    def _alone(self) -> Applied:
        """The hands decide; where they are gone, the car rolls, and that demonstrates nothing."""
        if not self.person.device.present:
            return Applied(0.0, "policy", False, False)
        first = self._number == 0 or not self._applied.human
        return Applied(self._reading.action, "human", True, first)

    def _read(self) -> None:
        """Ask the hands, and heed what they wish."""
        self._read_ns = time.time_ns()
        self._reading = self.person.device.poll(time.monotonic())
        wishes = self._reading.wishes
        self.stop = self.stop or "quit" in wishes
        self._restart = self._restart or "restart" in wishes
        self._discard = self._discard or "discard" in wishes
        self._paused = self._paused != ("pause" in wishes)

    def _pause(self) -> None:
        """Stand still until the person goes on, quits or begins anew."""
        while self._paused and not (self.stop or self._restart or self._discard):
            self._idle("")
        self._paused = False
        self.pacer.restart()

    def _idle(self, message: str) -> None:
        """A control period in which nothing moves."""
        self._show(message)
        self.pacer.restart()
        self.pacer.wait()
        self._read()

    def _show(self, message: str = "") -> None:
        if self._begun and not self.closed:
            self.person.display.show(self._view(message))

    def _view(self, message: str) -> View:
        env = self.env
        return View(
            scenario=env.scenario,
            scene=env.scene(),
            frames=self._frames,
            policy_action=self._policy_action,
            human_action=self._reading.action,
            applied_action=self._applied.action,
            control=self._applied.control,
            speed_mps=float(env.ego.speed),
            distance_m=float(env.distance_m),
            goal_m=float(env.config.goal_m),
            episode=self._episode,
            step=self._number,
            time_s=self._number * env.config.control_period_s,
            late_ticks=self.pacer.late,
            paused=self._paused,
            progress=self.progress,
            message=message,
            help=self.person.device.help,
        )

    def _step(
        self,
        next_observation: Observation,
        reward: float,
        terminated: bool,
        truncated: bool,
        outcome: str | None,
    ) -> Step:
        env, applied = self.env, self._applied
        sitting, index = self.recorder.position
        return Step(
            sitting=sitting,
            index=index,
            scenario=env.scenario,
            seed=self._seed,
            episode=self._episode,
            step=self._number,
            time_ns=self._read_ns,
            time_s=self._number * env.config.control_period_s,
            frames=self._frames.tobytes(),
            next_frame=next_observation[1].tobytes(),
            policy_action=self._policy_action,
            human_action=self._reading.action,
            action=applied.action,
            control=applied.control,
            human=applied.human,
            first=applied.first,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            speed_mps=float(env.ego.speed),
            outcome=outcome or "",
        )


class Pacer:
    """Absolute deadlines, one a period: what is late once is not late for ever after.

    A delay of less than a period is caught up. After a longer one the deadlines begin anew: a car
    that leaps through what was missed cannot be driven.

    Args:
        period_s: wall time of a control period.
        clock: monotonic seconds.
        sleep: waits for so many seconds.
    """

    def __init__(
        self,
        period_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period_s = period_s
        self.late = 0
        """Periods that began too late."""
        self._clock, self._sleep = clock, sleep
        self.restart()

    def restart(self) -> None:
        """Let the next period begin one period from now: after a pause, or a new episode."""
        self._deadline_s = self._clock() + self.period_s

    def wait(self) -> float:
        """Wait for the next period to begin; returns by how many seconds it is late."""
        # Python's main thread sleeps on through a signal that another thread took; a period is
        # short enough to hear of it afterwards.
        while (left_s := self._deadline_s - self._clock()) > 0.0:
            self._sleep(left_s)
        late_s = max(-left_s, 0.0)
        self.late += late_s > LATE_S
        if late_s < self.period_s:
            self._deadline_s += self.period_s
        else:
            self.restart()
        return late_s


class WatchedEnv:
    """A scenario's environment in a sitting; all else is the scenario's own.

    Args:
        env: the scenario.
        sitting: whoever sits there.
    """

    def __init__(self, env: Any, sitting: Sitting) -> None:
        self._env, self._sitting = env, sitting
        self.episode = 0
        """The number of the next episode."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, seed: int) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Start an episode, once the person is there.

        Raises:
            SittingOver: the person quits instead.
        """
        observation, info = self._env.reset(seed=seed)
        self._sitting.begin(observation, self.episode, seed)
        return observation, info

    def step(self, action: Action) -> EnvironmentStep:
        """One control period; the person may end the episode after it, which truncates it."""
        observation, reward, terminated, truncated, info = self._env.step(action)
        outcome = info.get("outcome")
        truncated, outcome = self._sitting.moved(
            observation, float(reward), terminated, truncated, outcome
        )
        if outcome is not None:
            info = {**info, "outcome": outcome}
        return observation, reward, terminated, truncated, info
