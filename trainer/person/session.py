"""One sitting: a person, a pace and a recording around what drives the environment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from msgspec import structs

from trainer.person.interface import LET_GO, Person, Reading, View
from trainer.person.recording import DISCARDED, Recorder, Step
from trainer.person.takeover import Applied, Intent, TakeOver
from trainer.scenarios.environment import Action, Observation
from trainer.scenarios.environment import Step as EnvironmentStep

REST_S = 1.0
"""Between two episodes: time to see how it ended, and to take the hands to rest."""
STOPPED, RESTARTED = "stopped", "restarted"
"""Outcomes of an episode that the person ended; or ``recording.DISCARDED``."""
LATE_S = 0.02
"""A period that begins later than this is counted: a fifth of it is about what a person feels."""


class SittingOver(Exception):  # noqa: N818 (no error: it was asked for)
    """The person has quit between two episodes."""


class Sitting:
    """A scenario's environment with a person at the wheel, from the window's opening to its end.

    The loop calls ``reset``, then ``decide`` before and ``step`` for each control period, and
    ``rest`` after an episode. All else is the environment's own. ``alone``: nobody but the person
    drives; ``speed``: simulated seconds in one of the person's.
    """

    def __init__(
        self, person: Person, recorder: Recorder, env: Any, alone: bool = False, speed: float = 1.0
    ) -> None:
        self.env = env
        self.person, self.recorder, self.alone = person, recorder, alone
        self.pacer = Pacer(env.config.control_period_s / speed)
        self.stop = False
        """The sitting is to end: asked for by the person, or by a signal."""
        self.closed = False
        self.episode = 0
        """The number of the episode, or of the next one; the loop counts."""
        self.progress = ""
        self.episodes = self.interventions = self.human_steps = self.discarded = 0
        """The last counts what the others leave out."""
        self._paused = False
        self._last_step: Step | None = None
        """An ended episode's, until it is known whether the person discards it."""
        self._frames: Observation | None = None
        """What the policy sees; None before the first episode, when there is nothing to show."""
        self._policy_action: float | None = None
        self._forget(0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, seed: int) -> tuple[Observation, dict[str, Any]]:
        """Start an episode as soon as the person is there.

        Raises:
            SittingOver: the person quits instead.
        """
        observation, info = self.env.reset(seed=seed)
        self._forget(seed)
        self._frames = observation
        while not self.person.present and not self.stop:
            self._idle("waiting for the person's device")
        if self.stop:
            raise SittingOver
        self._restart = self._discard = False
        self.pacer.restart()
        return observation, info

    def decide(self, observation: Observation, policy_action: float | None) -> Applied:
        """Show what is, wait for the control period, and ask the hands as late as possible.

        ``policy_action`` is what the policy would do about the observation uint8 [2, 45, 80], in
        [-1, 1]; None where the person drives alone.
        """
        self._frames, self._policy_action = observation, policy_action
        self.show()
        self.pacer.wait()
        self._read()
        if self._paused:
            while self._paused and not (self.stop or self._restart or self._discard):
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
            self._applied = Applied(0.0, "policy", False, False)
        return self._applied

    def step(self, action: Action) -> EnvironmentStep:
        """One control period; it is recorded. The person may end the episode after it."""
        assert self._frames is not None
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not (terminated or truncated) and (self.stop or self._restart or self._discard):
            truncated = True
            info = {**info, "outcome": STOPPED if self.stop else RESTARTED}
        applied = self._applied
        step = Step(
            sitting=self.recorder.sitting,
            index=self.recorder.index,
            scenario=self.env.scenario,
            seed=self._seed,
            episode=self.episode,
            step=self._number,
            time_ns=self._read_ns,
            time_s=self._number * self.env.config.control_period_s,
            frames=self._frames.tobytes(),
            next_frame=observation[1].tobytes(),
            policy_action=self._policy_action,
            human_action=self._reading.action,
            action=applied.action,
            control=applied.control,
            human=applied.human,
            first=applied.first,
            reward=float(reward),
            terminated=terminated,
            truncated=truncated,
            speed_mps=float(self.env.ego.speed),
            outcome=info.get("outcome", ""),
        )
        if terminated or truncated:
            self._last_step = step
        else:
            self.recorder.write(step)
        self._human_steps += applied.human
        self._interventions += applied.first
        self._number += 1
        return observation, reward, terminated, truncated, info

    def rest(self, outcome: str) -> str:
        """Show how the episode ended, which the person may still discard; how it really ended."""
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

    def show(self, message: str = "") -> None:
        """Show what is, and a line on what is going on besides driving."""
        if self._frames is None or self.closed:
            return
        env = self.env
        view = View(
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
            episode=self.episode,
            step=self._number,
            time_s=self._number * env.config.control_period_s,
            late_ticks=self.pacer.late,
            paused=self._paused,
            progress=self.progress,
            message=message,
            help=self.person.help,
        )
        self.person.show(view)

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

    def _forget(self, seed: int) -> None:
        """Nothing of an episode has happened yet."""
        self._seed, self._number = seed, 0
        self._take_over, self._intent = TakeOver(), Intent(self.person.moving)
        self._reading: Reading = LET_GO
        self._read_ns = 0
        self._applied = Applied(0.0, "human" if self.alone else "policy", self.alone, False)
        self._policy_action = None
        self._human_steps = self._interventions = 0
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
    """Absolute deadlines, one a period: what is late once is not late for ever after.

    A delay of less than a period is caught up. After a longer one the deadlines begin anew: a car
    that leaps through what was missed cannot be driven.
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

    def wait(self) -> None:
        """Wait for the next period to begin."""
        # Python's main thread sleeps on through a signal that another thread took; a period is
        # short enough to hear of it afterwards.
        while (left_s := self._deadline_s - self._clock()) > 0.0:
            self._sleep(left_s)
        self.late += -left_s > LATE_S
        if -left_s < self.period_s:
            self._deadline_s += self.period_s
        else:
            self.restart()
