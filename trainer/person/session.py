"""A sitting: a person at the wheel beside a loop, which is paced, shown and recorded for them.

`Sitting` is the loop's guide and recorder, `PacedEnvironment` the environment that it steps.
"""

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from bridge.fork import ForkedEnvironment, find_fork
from bridge.outcomes import DISCARDED, FAILED, GOAL, RESTARTED, STOPPED, TRUNCATED, UNKNOWN, UNTOLD
from edge_runtime.cli import quit_on_signals
from edge_runtime.files import check_writable
from edge_runtime.util import UserError
from trainer.environments import Adapted, make_environment, scenario_of
from trainer.evaluation import drive_episodes, load_driver, located, trained_in
from trainer.human.guide import BY_PERSON, Driver, Guide, GuideGone, Intervention
from trainer.learner.replay import Action, Observation, Transition
from trainer.person import Amount, Control, Intent, Reading, TakeOver, View, amount, vector, web
from trainer.person.recording import RecordedStep, Recorder, packed
from trainer.scenarios import SCENARIOS
from trainer.util import Purpose, episode_seed, set_threads

REST_S = 1.0  # Between two episodes: time to see how it ended, and to take the hands to rest
JUDGE_S = 3.0  # The same, where the person may say whether it succeeded


class Pacer:
    """Waits for absolute deadlines, a period apart. A delay below one period is caught up; after a
    longer one the deadlines start anew: a car that leaps ahead cannot be driven.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.restart()

    def restart(self) -> None:
        self._deadline_s = time.monotonic() + self.period_s

    def wait(self) -> None:
        # A signal that another thread received does not wake this sleep; it is handled afterwards.
        while (left_s := self._deadline_s - time.monotonic()) > 0.0:
            time.sleep(left_s)
        if -left_s < self.period_s:
            self._deadline_s += self.period_s
        else:
            self.restart()


class Sitting(Guide):
    """A person as a guide: paces the control periods, reads the device, and shows the scene.

    ``env`` is the environment without wrappers, ``recorder`` writes the sitting, ``speed`` is
    simulated seconds per real second.
    """

    def __init__(self, person: web.Cockpit, env: Any, recorder: Recorder, speed: float) -> None:
        self.person, self.env, self.recorder = person, env, recorder
        self.pacer = Pacer(env.control_period_s / speed)
        self.stop = self.closed = False
        self.episode = 0  # Number of the current or next episode
        self.progress = ""
        self.outcomes = Counter[str]()  # In this sitting
        self.saved_at = 0, 0
        """Sitting and step up to which the checkpoint holds the recorded steps."""
        self._paused = False
        self._rest = amount(env.rest_action)
        self._newest: tuple[Observation, dict[str, Any]] | None = None
        """The newest observation and info; None before the first episode."""
        self._forget()

    def _forget(self) -> None:
        self._step = self._read_ns = 0
        self._take_over = TakeOver()
        self._intent = Intent(self._rest)
        self._reading = Reading(self._rest)
        self._policy_action: Amount | None = None
        self._intervention: Intervention | None = None
        self.applied: Amount = self._rest
        self._control: Control = "policy"
        self._restart = self._discard = False
        self._judged = ""  # The person's word on how the episode ended

    def begin(self, seed: int, observation: Observation, info: dict[str, Any]) -> None:
        """Start an episode once the person is present; GuideGone if the person quits."""
        self._seed, self._newest = seed, (observation, info)
        self._forget()
        while not self.person.present and not self.stop:
            self._idle("waiting for the person's device")
        if self.stop:
            raise GuideGone
        self._restart = self._discard = False
        self.pacer.restart()

    def watch(
        self, observation: Observation, policy_action: Action | None, doubt: float = 0.0
    ) -> Intervention | None:
        """Show the scene, wait for the control period, and read the device as late as possible.

        ``policy_action`` is None where the person drives alone. In a hand-over the action is
        between the person's and the policy's; the replay buffer stores it as the person's.
        """
        self._policy_action = None if policy_action is None else amount(policy_action)
        self.show()
        self.pacer.wait()
        self._read()
        while self._paused and not self._to_end:
            self._idle("")
        self._paused = False
        before, hands = self._intervention, self._reading.action
        if self._policy_action is not None:
            holds = self._intent.update(self._reading, time.monotonic())
            self._intervention = self._take_over.step(self._policy_action, hands, holds)
            assert self._take_over.applied is not None  # Set by step
            self.applied = self._take_over.applied
            self._control = self._take_over.control
        elif self.person.present:
            self._intervention = Intervention(vector(hands), BY_PERSON, first=before is None)
            self.applied, self._control = hands, "human"
        else:  # Nobody drives: the car rolls, which is no demonstration.
            self._intervention, self.applied, self._control = None, self._rest, "policy"
        self._moment = {**self._now(), "time_ns": self._read_ns}
        return self._intervention

    def moved(self, observation: Observation, info: dict[str, Any]) -> str:
        """Take a step's result; return the outcome if the person ends the episode, else ''."""
        self._newest = observation, info
        self._step += 1
        return (STOPPED if self.stop else RESTARTED) if self._to_end else ""

    def record(self, transition: Transition, _: Any, info: dict[str, Any]) -> None:
        """Record a control period: the transition and the person's part."""
        self.recorder.add(
            RecordedStep(
                **self._moment,
                sitting=self.recorder.sitting,
                index=self.recorder.index,
                seed=self._seed,
                seen=packed(transition.observation),
                seen_next=packed(transition.next_observation),
                action=self.applied,
                human=self._intervention is not None,
                first=self._intervention is not None and self._intervention.first,
                reward=float(transition.reward),
                terminated=transition.terminal,
                truncated=transition.truncated,
                outcome=info.get("outcome", ""),
                ahead=tuple(map(packed, transition.foreseen[1:])),
            )
        )

    def end_episode(self, outcome: str) -> str:
        """Show the outcome for a moment, in which the person may discard or judge; return it."""
        is_open = outcome in (UNKNOWN, TRUNCATED)
        rest_s = JUDGE_S if is_open else REST_S
        # Counted in periods, so that a machine that stalls still lets the person answer.
        for _ in range(math.ceil(rest_s / self.env.control_period_s)):
            if self.stop or (self._judged and is_open):
                break
            self._idle("episode discarded" if self._discard else f"episode ended: {outcome}")
            if self._discard:  # Written at once, so that a kill does not lose it.
                self.recorder.end_episode(DISCARDED)
        if outcome in UNTOLD:
            outcome = self._judged or outcome
        outcome = DISCARDED if self._discard else outcome
        self.recorder.end_episode(outcome)
        self.outcomes[outcome] += 1
        self.episode += 1
        return outcome

    def show(self, message: str = "") -> None:
        """Show the scene, with a line of text."""
        if self._newest is None or self.closed:
            return
        observation, info = self._newest
        scene = self.env.scene()
        view = View(
            **self._now(),
            scene=scene,
            picture=self.env.render() if scene is None else None,
            frames=observation if self.env.layout.stacked else None,
            applied_action=self.applied,
            distance_m=float(info["distance_m"]),
            goal_m=float(self.env.goal_m),
            paused=self._paused,
            progress=self.progress,
            message=message,
        )
        self.person.show(view)

    def summary(self) -> str:
        if not self.recorder.index:
            return "nothing was driven, and nothing recorded"
        listed = ", ".join(f"{count} {word}" for word, count in self.outcomes.items())
        return f"episodes: {listed or 'none'}: {self.recorder.path}"

    def quit(self) -> bool:
        """End the sitting; False where it is over already."""
        self.stop = self.stop or not self.closed
        return not self.closed

    def close(self) -> None:
        """Close the cockpit and the recording; a second call does nothing."""
        self.closed = True
        self.person.close()
        if self._discard:
            self.recorder.end_episode(DISCARDED)
        self.recorder.close()

    def state_dict(self) -> dict[str, Any]:
        self.show("saving")  # The person sees why nothing moves.
        return {"recorded": [self.recorder.sitting, self.recorder.index]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        sitting, index = map(int, state["recorded"])
        self.saved_at = sitting, index

    @property
    def _to_end(self) -> bool:
        return self.stop or self._restart or self._discard

    def _now(self) -> dict[str, Any]:
        """Return the fields of the control period that views and recorded steps share."""
        assert self._newest is not None
        return {
            "scenario": self.env.scenario,
            "episode": self.episode,
            "step": self._step,
            "time_s": self._step * self.env.control_period_s,
            "policy_action": self._policy_action,
            "human_action": self._reading.action,
            "control": self._control,
            "speed_mps": float(self._newest[1]["speed_mps"]),
        }

    def _read(self) -> None:
        self._read_ns = time.time_ns()
        self._reading = self.person.poll(time.monotonic())
        wishes = self._reading.wishes
        self.stop |= "quit" in wishes
        self._restart |= "restart" in wishes
        self._discard |= "discard" in wishes
        self._paused ^= "pause" in wishes
        for wish, outcome in (("succeeded", GOAL), ("failed", FAILED)):
            self._judged = outcome if wish in wishes else self._judged

    def _idle(self, message: str) -> None:
        """Let a control period pass in which nothing moves."""
        self.show(message)
        self.pacer.restart()
        self.pacer.wait()
        self._read()


class PacedEnvironment:
    """Wraps an environment: an episode waits for the person, and ends when they wish."""

    def __init__(self, env: Any, sitting: Sitting) -> None:
        self.env, self.sitting = env, sitting
        self.control_period_s: float = env.control_period_s

    def reset(self, *, seed: int) -> tuple[Observation, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed)
        self.sitting.begin(seed, observation, info)
        return observation, info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        ended = self.sitting.moved(observation, info)
        if ended and not (terminated or truncated):
            truncated, info = True, {**info, "outcome": ended}
        return observation, reward, terminated, truncated, info


class SharedWheel(Driver):
    """A driver shared by a policy, if any, and the person who may take over."""

    def __init__(self, sitting: Sitting, policy: Driver | None) -> None:
        self.sitting, self.policy = sitting, policy

    def reset(self) -> None:
        if self.policy is not None:
            self.policy.reset()

    def act(self, observation: Observation) -> Action:
        action = None if self.policy is None else self.policy.act(observation)
        self.sitting.watch(observation, action)
        return vector(self.sitting.applied)


def run(arguments: argparse.Namespace) -> int:
    set_threads(arguments.threads)
    arguments.policy = arguments.policy and located(arguments.policy)
    env, seed_of = _environment(arguments)
    policy = None
    if arguments.policy is not None:
        policy, _ = load_driver(arguments.policy, env, arguments.public_key)
    out = Path(arguments.out)
    check_writable(out / "sitting")  # Before a browser opens.
    with closing(env), closing(web.open_cockpit(arguments, env)) as person:
        sitting = Sitting(person, env, Recorder(out), arguments.speed)
        with closing(sitting), quit_on_signals(sitting.quit):
            drive(sitting, policy, seed_of, arguments.episodes)
    print(sitting.summary())
    return 0


def drive(
    sitting: Sitting,
    policy: Driver | None,
    seed_of: Callable[[int], int],
    episodes: int | None = None,
) -> None:
    """Drive so many episodes, or until the person quits.

    The policy drives until the person takes over; without one, the person drives alone.
    ``seed_of``: an episode's number over all sittings -> its seed.
    """

    def seeds() -> Iterator[int]:
        while not sitting.stop and sitting.episode != episodes:
            yield seed_of((sitting.recorder.sitting << 32) + sitting.episode)

    with suppress(GuideGone):
        vehicle, driver = PacedEnvironment(sitting.env, sitting), SharedWheel(sitting, policy)
        drive_episodes(
            vehicle, driver, seeds(), recorders=[sitting.record],
            on_episode=lambda result: sitting.end_episode(result.outcome),
        )  # fmt: skip


def _environment(options: argparse.Namespace) -> tuple[Any, Callable[[int], int]]:
    """Make the environment and its seeds: new ones in every sitting, or a recorded drive's."""
    if options.recording is None:
        if options.at or options.episode is not None or options.vehicle_id:
            raise UserError("--at, --episode and --vehicle-id need a recording: --from F.mcap")
        seed_of = partial(episode_seed, options.seed, Purpose.SITTINGS)
        period_s = options.policy and trained_in(options.policy, options.public_key)[1]
        return make_environment(options.scenario or "left_turn", period_s=period_s), seed_of
    recorded, step = find_fork(options.recording, options)
    own = recorded.environment(options.scenario, "--scenario")
    name = scenario_of(options.scenario or recorded.origin.environment)
    is_ours = name in SCENARIOS
    env: Any = ForkedEnvironment(own.unwrapped if is_ours else own, recorded, step)
    env.control_period_s = recorded.task.control_period_s
    return (env if is_ours else Adapted(env, name)), lambda number: recorded.origin.seed
