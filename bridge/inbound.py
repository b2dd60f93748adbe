"""The vehicle's side of the safety rules: which messages count, and when it brakes. Pure.

`CommandCheck` and `FeedbackCheck` reject messages and count them by reason. `CommandHold` holds the
newest command from tick to tick, and brakes 2 T after it, or where it says ``safe_stop``.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec

from edge_runtime import wire
from edge_runtime.manifest import Action, Task
from edge_runtime.wire import DRIVE, SAFE_STOP, Command, Feedback, Reason, Rejection

BRAKE_PERIODS = 2  # After so many T without a command the vehicle brakes by itself
ROUNDING_S = 1e-9
"""Sums such as 0.3 + 0.01 + 0.015 miss 0.325 by less than this; no real delay is as short."""
NO_COMMAND = "no_command"  # Brake reason: the vehicle brakes by itself after 2 T of silence
UNKNOWN_SAFE_STOP = "safe_stop"  # Brake reason when a safe_stop command gives none of its own
NO_FEEDBACK = "no_feedback"
"""Brake reason: the vehicle sent no feedback for 2 T, so the simulated car brakes."""
SELF_BRAKING = "self_braking"  # Brake reason: the vehicle says that it brakes by itself
UNKNOWN_STEP = "unknown_step"  # The message answers a state that was never sent
NOT_COMMANDED = ""
"""Session of a vehicle that has not taken a command since its edge runtime was started."""
COMMAND_ROUNDING, FEEDBACK_ROUNDING = 1e-6, 5e-4
"""Share of an action's range: a policy clamps to the last bit, an actuator is measured."""


@dataclass(frozen=True)
class Decision:
    command: Command | None  # The newest command, held; None before the first of the episode
    fresh: bool  # It arrived since the decision before this one
    brake_reason: str  # Why the vehicle brakes; empty while it obeys the command
    ridden: int = 0
    """Number, from 1, of the plan's action that ``command`` now has; 0: its own action."""
    feedback: Feedback | None = None
    """The report of a vehicle in the loop; None without a vehicle, or while it is silent."""


class CommandHold:
    def __init__(self, now_s: float, period_s: float) -> None:
        self._period_s, self._silence_s = period_s, BRAKE_PERIODS * period_s
        self.newest: Command | None = None
        self._heard_s = now_s
        self._fresh = False

    @property
    def newest_step(self) -> int:
        return -1 if self.newest is None else self.newest.step

    def admit(self, command: Command, now_s: float) -> bool:
        """Take the command if it is newer than the newest one; return whether it was taken.

        In a safe stop the repeated answer to the last state is a heartbeat, too. A repeated
        ``drive`` is not: it would keep a frozen controller alive.
        """
        repeats_stop = command.step == self.newest_step and command.mode == SAFE_STOP
        if command.step <= self.newest_step and not repeats_stop:
            return False
        self.newest, self._heard_s, self._fresh = command, now_s, True
        return True

    def decide(self, now_s: float, edge_silent: bool = False) -> Decision:
        """Decide this tick; ``edge_silent``: lock-step got no answer in wall time."""
        brake_reason, command, ridden = "", self.newest, 0
        plan = command.plan or [] if command is not None and command.mode == DRIVE else []
        silent_s = now_s - self._heard_s
        ride_s = len(plan) * self._period_s
        if edge_silent or silent_s > self._silence_s + ride_s + ROUNDING_S:
            brake_reason = NO_COMMAND
        elif command is not None and command.mode == SAFE_STOP:
            brake_reason = command.reason or UNKNOWN_SAFE_STOP
        elif command is not None and plan:
            ridden = min(int((silent_s + ROUNDING_S) / self._period_s), len(plan))
            if ridden:
                command = msgspec.structs.replace(command, action=plan[ridden - 1])
        fresh, self._fresh = self._fresh, False
        return Decision(command, fresh, brake_reason, ridden)


class CommandCheck:
    """Reads the commands of one session, under the clock's lock; counts over the whole run.

    ``policy_ids`` holds the policies that answered, each once, in order of appearance.
    """

    def __init__(self, session: str, task: Task) -> None:
        self.session, self.task = session, task
        self.rejected: Counter[str] = Counter()
        self.policy_ids: list[str] = []
        self.newest = (0, -1)  # Episode and step of the newest state that was sent
        self._is_over = False
        self._stamps: deque[int] = deque(maxlen=64)  # Of recent commands: a copy counts once
        self.heard: dict[str, int] = {}
        """The next state's fields about this session's commands; empty before the first."""

    def begin(self, episode: int) -> None:
        self.newest, self._is_over = (episode, -1), False

    def sent(self, step: int) -> None:
        self.newest = (self.newest[0], step)

    def end(self, final_step: int) -> None:
        self.sent(final_step)
        self._is_over = True

    def read(self, payload: bytes, now_ns: int = 0) -> Command | None:
        """Return the command if it answers a state of this episode, else None.

        An answer after its episode's end is no fault. ``now_ns`` is the wall clock.
        """
        command = wire.decode_command(payload)
        if isinstance(command, Rejection):
            self.reject(command.reason.value)
            return None
        if command.session == self.session and command.sent_ns not in self._stamps:
            self._stamps.append(command.sent_ns)
            heard = self.heard.get("heard", 0) + 1
            self.heard = {"heard": heard, "heard_sent_ns": command.sent_ns, "heard_ns": now_ns}
        if fault := self._fault(command):
            self.reject(fault)
            return None
        if self._is_over or command.episode < self.newest[0]:
            return None
        if command.policy_id not in self.policy_ids:
            self.policy_ids.append(command.policy_id)
        if command.mode == SAFE_STOP and _action_fault(command.action, self.task.action):
            # The mode alone makes it a stop; its action is replaced by a valid one.
            stop = [row.stop or min(max(0.0, row.low), row.high) for row in self.task.action]
            return msgspec.structs.replace(command, action=stop)
        return command

    def reject(self, reason: str) -> None:
        self.rejected[reason] += 1

    def _fault(self, command: Command) -> str:
        if command.session != self.session:
            return Reason.FOREIGN_SESSION.value
        plan = command.plan or []
        for action in (command.action, *plan) if command.mode == DRIVE else ():
            if fault := _action_fault(action, self.task.action):
                return fault
        if len(plan) * self.task.control_period_s > wire.MAX_RIDE_S + ROUNDING_S:
            return "plan_too_long"  # It lasts longer than MAX_RIDE_S
        if (command.episode, command.step) > self.newest:
            return UNKNOWN_STEP
        return ""


def _action_fault(
    values: Sequence[float], actions: Sequence[Action], rounding: float = COMMAND_ROUNDING
) -> str:
    if len(values) != len(actions):
        return "action_size"  # Another number of actions than the environment's
    for value, row in zip(values, actions, strict=True):
        slack = rounding * (row.high - row.low)
        if not row.low - slack <= value <= row.high + slack:
            return "action_range"
    return ""


class FeedbackCheck:
    """Reads feedback for the session of ``commands``, and counts what it rejects there.

    Feedback of another session is no fault until the vehicle has taken a command of this one. Older
    stamps are stale; after 2 T of silence any stamp is accepted, because the board may be another.
    """

    def __init__(self, commands: CommandCheck) -> None:
        self.heard: Feedback | None = None
        """The last readable feedback, of any session: it shows that a vehicle is there."""
        self.heard_s = 0.0
        self.commands, self._silence_s = commands, BRAKE_PERIODS * commands.task.control_period_s
        self._met = False  # The vehicle has taken a command of this session.
        self._newest: Feedback | None = None
        self._newest_s = 0.0

    def read(self, payload: bytes, now_s: float) -> Feedback | None:
        """Return the feedback if it is this vehicle's newest, else None; ``now_s`` is monotonic."""
        feedback = wire.decode_feedback(payload)
        if isinstance(feedback, Rejection):
            self.commands.reject(f"feedback_{feedback.reason.value}")
            return None
        self.heard, self.heard_s = feedback, now_s
        own = feedback.session in (self.commands.session, NOT_COMMANDED)
        if fault := self._fault(feedback, now_s) if own else Reason.FOREIGN_SESSION.value:
            if own or self._met:
                self.commands.reject(f"feedback_{fault}")
            return None
        self._met = self._met or feedback.session == self.commands.session
        self._newest, self._newest_s = feedback, now_s
        return feedback

    def decide(self, by_commands: Decision, episode: int, now_s: float) -> Decision:
        """Decide by feedback for the tick that ends now.

        ``by_commands`` is the decision by the vehicle's commands, which the simulator receives,
        too. It only gives a stop its reason.
        """
        silent = now_s - self._newest_s > self._silence_s + ROUNDING_S
        feedback, reason = None if silent else self._newest, ""
        if feedback is None:
            reason = NO_FEEDBACK
        elif feedback.episode != episode:
            # Until the vehicle has taken a command of this episode, it stands because the last
            # one has ended: no fault, unless there are no commands.
            reason = by_commands.brake_reason
        elif feedback.mode == SAFE_STOP:
            reason = by_commands.brake_reason or UNKNOWN_SAFE_STOP
        elif feedback.self_braking:
            reason = SELF_BRAKING
        ridden = 0 if reason else by_commands.ridden
        return replace(by_commands, brake_reason=reason, ridden=ridden, feedback=feedback)

    def _fault(self, feedback: Feedback, now_s: float) -> str:
        actions = self.commands.task.action
        if fault := _action_fault(feedback.action, actions, FEEDBACK_ROUNDING):
            return fault
        if (feedback.episode, feedback.step) > self.commands.newest:
            return UNKNOWN_STEP
        newest_ns = -1 if self._newest is None else self._newest.sent_ns
        if feedback.sent_ns == newest_ns:
            return Reason.DUPLICATE.value
        in_order = now_s - self._newest_s <= self._silence_s
        return Reason.STALE.value if in_order and feedback.sent_ns < newest_ns else ""
