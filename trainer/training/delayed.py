"""Between policy and vehicle in training: directly, or over the network it will be deployed on.

Over a network, what is stored is what happens at the vehicle, beside what the policy knows of it:
in tick n the observation of tick n - d, the action carried out in tick n, its reward, and the
observation of tick n + 1 - d, where d is how many ticks old a command is that is on time. So a
reward stands beside the action that earned it, and a human's action beside the picture to which
the policy would have had to give it. Where the network makes a command late, lost or repeated, the
action carried out is another than the policy's answer; for a learner off policy that is a sample
like any other, and so is the brake.

What was carried out in the d ticks between is not in the picture: the delayed decision process is
only partially observed. `DelayAware` (``delay_known``) adds it to the observation, and makes the
delay constant by waiting.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict

from bridge.network import LatencySpec, Link
from bridge.virtual_link import COMMAND_WINDOW, ROUNDING_S, VirtualLink
from edge_runtime.util import UserError
from edge_runtime.wire import DRIVE, Command
from trainer.human.guide import Action, Observation
from trainer.learner.replay import Layout
from trainer.training.learning import LearningThread

Policy = Callable[[Observation], Action]
UNDER_WAY, PLAIN = "under_way", "observation"
JITTER_WAITED_FOR = 2.0  # Standard deviations: of normal jitter one command in 44 comes later


class DelayAware:
    """The observation with the actions that are on their way: d of them, where a command takes d.

    With a constant delay and these actions the decision process is Markov again (Katsikopoulos and
    Engelbrecht, 2003; rtgym's action buffer). So a command that comes early waits (the conservative
    agent). ``spec`` decides d; ``space`` and ``layout`` are of the larger observation.
    Raises UserError where d is 0.
    """

    def __init__(self, env: Any, spec: LatencySpec) -> None:
        self.ticks = ticks_late(spec, env.control_period_s, JITTER_WAITED_FOR)
        if not self.ticks:
            raise UserError(f"behind {spec} no command is a tick late: delay_known adds nothing")
        own, layout = env.observation_space, env.layout
        numbers = Box(-1.0, 1.0, (self.ticks * env.action_space.shape[0],), np.float32)
        entries = own.spaces if isinstance(own, Dict) else {PLAIN: own}
        self.space = Dict([*entries.items(), (UNDER_WAY, numbers)])
        plain: list[Any] = [(PLAIN, layout.dtype, layout.shape)]
        rows = [(name, layout.dtype[name]) for name in layout.dtype.names or ()] or plain
        self.layout = Layout((), np.dtype([*rows, (UNDER_WAY, np.float32, numbers.shape)]))

    def see(self, observation: Observation, under_way: Iterable[Action]) -> Observation:
        """Both together; the action that acts first comes first."""
        seen = np.zeros((), self.layout.dtype)
        *names, _ = self.layout.dtype.names or ()
        for name in names:
            seen[name] = observation[name] if observation.dtype.names else observation
        seen[UNDER_WAY] = np.concatenate(list(under_way))
        return seen


class VehicleEnd:
    """One episode of a policy behind a network.

    The brake of ``env`` is pressed here when commands stop. ``seed`` is the episode's, as in
    ``bridge simulate``, ``observation`` any one, for its size. ``aware``: the policy sees what is
    on its way, and each command waits for its tick.
    """

    def __init__(
        self,
        env: Any,
        spec: LatencySpec | Link,
        seed: int,
        observation: Observation,
        aware: DelayAware | None = None,
    ) -> None:
        self.env, self._aware = env, aware
        self._rest: Action = env.rest_action
        self._answers: dict[int, Action] = {}  # The policy's, by the step that they answer
        self._received: dict[int, Action] = {}  # Those of them that have come to the vehicle
        self._link: VirtualLink[Observation] = VirtualLink(
            spec, seed, env.control_period_s, observation.nbytes, on_command=self._receive
        )
        self._step = 0
        self.braking = False
        """The vehicle brakes: no command has come for 2 T, or the command is a safe stop."""

    def tick(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle does, float32 [action size], once the policy has answered what arrives.

        The policy is asked for each fresh observation that reaches the edge within the tick: often
        one, but none or several where the network drops, delays or bundles them.
        """
        self._link.send_state(self._step, observation)
        self._step += 1
        while arrival := self._link.next_at_edge():
            if not arrival.overtaken:
                answer = policy(self._seen(arrival.step, arrival.message))
                self._answers[arrival.step] = answer
                self._link.answer(arrival, _command(arrival.step, answer))
        decision = self._link.decide()
        self.press_brake(bool(decision.brake_reason))
        if self.braking:
            return self.env.brake_action
        if self._aware is not None:
            return self._newest(self._received, self._step - 1 - self._aware.ticks)
        command = decision.command
        return self._rest if command is None else np.array(command.action, np.float32)

    def _receive(self, command: Command) -> None:
        self._received[command.step] = np.array(command.action, np.float32)

    def _seen(self, step: int, observation: Observation) -> Observation:
        """What the policy sees of a step."""
        if self._aware is None:
            return observation
        before = range(step - self._aware.ticks, step)
        return self._aware.see(observation, [self._newest(self._answers, one) for one in before])

    def _newest(self, actions: dict[int, Action], step: int) -> Action:
        """The action that answers this step, or the newest one before; else hands off."""
        known = [one for one in actions if one <= step]
        return actions[max(known)] if known else self._rest

    def press_brake(self, pressed: bool) -> None:
        """Brake or not until the next tick: a scenario whose action only steers has a pedal."""
        self.braking = pressed
        press = getattr(self.env, "press_brake", None)
        if press is not None:
            press(pressed)


def _command(step: int, action: Action) -> Command:
    """As an edge runtime's, as far as a virtual link looks at it."""
    return Command(
        session="", episode=0, step=step, mode=DRIVE, action=action.tolist(), policy_id="",
        received_ns=0, inference_ns=0, sent_ns=0,
    )  # fmt: skip


class DelayedPolicy:
    """The policy as the training loop has it: behind a network, in virtual time, or ``none``.

    Each tick goes to ``store`` as a transition.
    """

    def __init__(
        self, store: LearningThread, env: Any, spec: LatencySpec, aware: DelayAware | None = None
    ) -> None:
        self._store, self._env, self._spec, self._aware = store, env, spec, aware
        late = aware.ticks if aware else ticks_late(spec, env.control_period_s)
        self._known: deque[Observation] = deque(maxlen=late + 1)
        """Observations of the ticks n - d to n."""
        self._carried_out: deque[Action] = deque(maxlen=late)
        """The actions of the ticks n - d to n - 1."""
        self._storing = False

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode; the seed decides the network's luck."""
        self._vehicle_end = None
        if self._spec != LatencySpec():
            self._vehicle_end = VehicleEnd(self._env, self._spec, seed, observation, self._aware)
        self._known.clear()
        self._carried_out.clear()
        self._storing = False

    def act(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle does: the newest command, or the brake."""
        self._known.append(observation)
        if not self._storing and len(self._known) == self._known.maxlen:
            self._store.start_episode(self._seen(self._known[0], self._carried_out))
            self._storing = True
        end = self._vehicle_end
        return end.tick(observation, policy) if end else policy(observation)

    def yield_to_human(self) -> None:
        """The vehicle lets go of the brake that it may have pressed for want of commands."""
        if self._vehicle_end:
            self._vehicle_end.press_brake(False)

    def store(
        self, action: Action, reward: float, observation: Observation, *rest: Any, **guidance: Any
    ) -> None:
        """Keep the tick that led to ``observation``; arguments as ``ReplayBuffer.add``.

        An episode's first d are not kept: the policy had seen nothing.
        """
        if ahead := guidance.get("foreseen"):
            guidance["foreseen"] = self._foreseen(ahead, guidance["overruled"])
        self._carried_out.append(action)
        if self._storing:
            known = self._seen([*self._known, observation][1], self._carried_out)
            self._store.add(action, reward, known, *rest, **guidance)

    def _foreseen(self, ahead: Sequence[Observation], held: Action) -> list[Observation]:
        """The same, each as late as all that the policy sees."""
        late, known = len(self._carried_out), [*self._known, *ahead[1:]]
        done = [*self._carried_out, *[held] * len(ahead)]
        return [self._seen(known[i], done[i : i + late]) for i in range(len(ahead))]

    def _seen(self, observation: Observation, done: Iterable[Action]) -> Observation:
        """What the policy would have seen, had it planned what was carried out."""
        return self._aware.see(observation, done) if self._aware else observation


def ticks_late(spec: LatencySpec, period_s: float, jitters: float = 0.0) -> int:
    """How many ticks old the state is that a command answers when it is on time.

    On time may be so many standard deviations of the jitter after the mean.
    """
    jitter_ms = math.hypot(spec.up.jitter_ms, spec.down.jitter_ms)
    round_trip_s = (spec.up.delay_ms + spec.down.delay_ms + jitters * jitter_ms) * 1e-3
    beyond_window_s = max(0.0, round_trip_s - COMMAND_WINDOW * period_s - ROUNDING_S)
    return math.ceil(beyond_window_s / period_s)
