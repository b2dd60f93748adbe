"""The decisions of the edge runtime: state, answer and time in, orders out. No clock, no socket.

First how an action is limited, and the plan of a ride-through; then the controller. Times are
monotonic seconds. The caller serialises the calls (loop.py holds one lock). Contract, section 5.
"""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional, Sequence, Union

import msgspec
import numpy as np

from edge_runtime import safety as rules
from edge_runtime.latest import Freshness
from edge_runtime.manifest import Action
from edge_runtime.safety import Event, Mode, Safety
from edge_runtime.util import UserError
from edge_runtime.wire import DRIVE, MAX_PLAN, MAX_RIDE_S, SAFE_STOP, Command, State, is_foreign

LATE_PERIODS = 1.2  # A command later than this counts as missing: T, and a fifth for jitter


class ActionLimit(NamedTuple):
    """The range of one action, and its fastest change (inf: at once).

    `stop` is its value in a safe stop, None to hold the last one; a vehicle's limits leave it out.
    """

    low: float
    high: float
    slew_per_s: float = math.inf
    stop: Optional[float] = None


Limits = Dict[str, ActionLimit]  # by the action's name


def shared_limits(actions: Sequence[Action], vehicle: Limits) -> Limits:
    """Cut the manifest's ranges to the vehicle's, in the policy's order. Raises UserError."""
    limits = {}
    for row in actions:
        if vehicle and row.name not in vehicle:
            has, its = ", ".join(sorted(vehicle)), f"{row.name!r}, which the policy acts on"
            raise UserError(f"the vehicle has no {its}; it has {has}")
        theirs = vehicle.get(row.name) or ActionLimit(row.low, row.high)
        low, high = max(row.low, theirs.low), min(row.high, theirs.high)
        if low > high:
            raise UserError(f"the policy's and the vehicle's range of {row.name!r} do not meet")
        slew_per_s = min(row.slew_per_s or math.inf, theirs.slew_per_s)
        stop = None if row.stop is None else min(max(row.stop, low), high)
        limits[row.name] = ActionLimit(low, high, slew_per_s, stop)
    return limits


def limit_action(
    wanted: Sequence[float], last: Sequence[float], limits: Limits, elapsed_s: float
) -> List[float]:
    """Clamp `wanted` to each range, and to the change from `last` that `elapsed_s` allows."""
    limited = []
    for value, previous, limit in zip(wanted, last, limits.values()):
        if limit.slew_per_s < math.inf:
            most = limit.slew_per_s * elapsed_s
            value = min(max(value, previous - most), previous + most)
        limited.append(min(max(value, limit.low), limit.high))
    return limited


def neutral_action(limits: Limits) -> List[float]:
    """Return the action before the first command: 0, or the nearest that the range allows."""
    return [min(max(0.0, limit.low), limit.high) for limit in limits.values()]


def stop_action(last: Sequence[float], limits: Limits) -> List[float]:
    """Return each action's stop value, or its last value where it has none (steering)."""
    pairs = zip(limits.values(), last)
    return [value if limit.stop is None else limit.stop for limit, value in pairs]


class Ride:
    """Makes the plan of each drive command and, with `plays`, plays the newest one to the vehicle.

    A plan repeats the policy's action in each further period: nothing else worked better
    (docs/ride_through.md). Raises UserError for a `max_s` that no plan can cover.
    """

    def __init__(self, max_s: float, period_s: float, limits: Limits, plays: bool) -> None:
        within = 0.0 < max_s <= MAX_RIDE_S  # nor is NaN
        self.periods = int(max_s / period_s + 1e-9) if within else 0
        if not 1 <= self.periods <= MAX_PLAN:
            most_s = min(MAX_RIDE_S, MAX_PLAN * period_s)
            words = f"for this policy's T use {period_s:g} to {most_s:g} s, or 0 for off"
            raise UserError(f"ride_through.max_s {max_s:g} is not valid: {words}")
        self.max_s = self.periods * period_s
        self._period_s, self._limits, self._plays = period_s, limits, plays
        self._left: List[List[float]] = []
        self._next_s = math.inf

    def begin(self, wanted: List[float], action: List[float], now_s: float) -> List[List[float]]:
        """Plan the actions after the command `action`: on towards `wanted`, within its limits."""
        plan = []
        for _ in range(self.periods):
            action = limit_action(wanted, action, self._limits, self._period_s)
            plan.append(action)
        if self._plays:
            self._left, self._next_s = list(plan), now_s + LATE_PERIODS * self._period_s
        return plan

    @property
    def due_s(self) -> float:
        """When the next action is due for the vehicle; inf where none is left."""
        return self._next_s if self._left else math.inf

    def play(self, now_s: float) -> Optional[List[float]]:
        """Return the action that is due, or None; skip those whose time has passed."""
        action = None
        while now_s >= self.due_s:
            action = self._left.pop(0)
            self._next_s += self._period_s
        return action

    def end(self) -> None:
        self._left = []


class Received(NamedTuple):
    """An accepted state and its arrival. `follows_final`: it replaced an unanswered final state."""

    state: State
    arrived_s: float
    arrived_ns: int
    follows_final: bool = False

    @property
    def trip_s(self) -> Optional[float]:
        """Round trip of the simulator's newest command and this state; None where it is unknown."""
        heard_sent_ns, heard_ns = self.state.heard_sent_ns, self.state.heard_ns
        # Subtract stamps of the same clock: those of two clocks may be decades apart.
        if isinstance(heard_sent_ns, int) and isinstance(heard_ns, int):
            held_ns = self.state.sent_ns - heard_ns
            return (self.arrived_ns - heard_sent_ns - held_ns) * 1e-9
        return None


class Order(NamedTuple):
    """A command without the sender's stamps. `ridden`: from a plan, for the own vehicle only."""

    answers: Received
    mode: str
    action: List[float]
    reason: str
    inference_ns: int
    plan: Union[List[List[float]], msgspec.UnsetType] = msgspec.UNSET
    ridden: bool = False

    def command(self, policy_id: str, sent_ns: int) -> Command:
        state = self.answers.state
        return Command(
            session=state.session,
            episode=state.episode,
            step=state.step,
            mode=self.mode,
            action=self.action,
            policy_id=policy_id,
            received_ns=self.answers.arrived_ns,
            inference_ns=self.inference_ns,
            sent_ns=sent_ns,
            reason=self.reason,
            plan=self.plan,
        )


class ControllerConfig(NamedTuple):
    """A controller's settings.

    `needs_rearm`: a vehicle is attached, and only an operator lets it drive after a stop; with
    `each_episode` also in each new episode, except the first after an armed start. `task` is the
    policy's, `ride_s` is [ride_through] max_s.
    """

    limits: Limits
    control_period_s: float
    needs_rearm: bool = False
    armed_at_start: bool = True
    task: str = ""
    ride_s: float = 0.0
    each_episode: bool = False


class Controller:
    """Handles one state at a time: `begin` when inference starts, `finish` with its answer.

    The caller calls `tick` at `next_deadline_s` for the orders that time alone causes.
    """

    def __init__(self, config: ControllerConfig) -> None:
        self._limits, self._period_s = config.limits, config.control_period_s
        self._needs_rearm, self._task = config.needs_rearm, config.task
        self.each_episode = config.needs_rearm and config.each_episode
        self._ride: Optional[Ride] = None
        if config.ride_s:
            self._ride = Ride(config.ride_s, self._period_s, self._limits, self._needs_rearm)
        self.safety = Safety(self._period_s, ride_s=self._ride.max_s if self._ride else 0.0)
        self._freshness = Freshness(self.safety.answer_s)
        self._lag_s = 0.0  # of the newest state
        self._fresh_before_s: Optional[float] = None  # `last_fresh_s` before the newest state
        self.deadline_misses = 0
        self.vehicle_fault = ""  # what is wrong with the vehicle now; the shell keeps it current
        self.leash_is_used = False  # likewise
        self._latched_fault = ""  # what stopped it, until it is re-armed
        self._policy_is_dead = False
        self._last_action = neutral_action(self._limits)
        self._ordered_s = -math.inf  # when that was ordered
        self._newest: Optional[Received] = None
        self._driven: Optional[Received] = None  # the state whose plan is played
        self._begun_s: Optional[float] = None
        self._next_stop_s = math.inf  # nothing is repeated before a first safe stop
        if self._needs_rearm and not config.armed_at_start:
            self._apply(Event.NOT_ARMED)

    @property
    def waits_for_rearm(self) -> bool:
        stopped = self.safety.mode is Mode.SAFE_STOP
        return self._needs_rearm and stopped and not self.safety.rearmed

    @property
    def vehicle_words(self) -> str:
        """The vehicle's fault or, once that has passed, the fault that stopped it."""
        return self.vehicle_fault or self._latched_fault

    def begin(self, received: Received, now_s: float) -> None:
        session, arrived_s = received.state.session, received.arrived_s
        # The gap counts even if the watchdog did not run within it.
        event = rules.classify_arrival(self.safety, session, arrived_s, self._needs_rearm)
        if event is not Event.OTHER_SESSION and self._begins_episode(received):
            event = Event.EPISODE
        if event is not None and not (event is Event.SILENT and self._stopped_late):
            self._apply(event)
        self._lag_s = self._freshness.lag_s(
            session,
            received.state.sent_ns * 1e-9,
            arrived_s,
            received.trip_s,
            stands=self.safety.mode is Mode.SAFE_STOP,
            final=received.state.final,
        )
        self._fresh_before_s = self.safety.last_fresh_s
        if not self._is_late:
            self.safety = rules.note_arrival(self.safety, session, arrived_s)
        self._newest = received
        self._begun_s = now_s

    def finish(
        self, output: Optional[np.ndarray], inference_ns: int, now_s: float
    ) -> Optional[Order]:
        """Turn the policy's answer into an order; None if none is due. No `output`: it failed."""
        if self._begun_s is None or self._newest is None:
            return None
        overdue = now_s - self._begun_s > self._period_s
        # A process that was suspended in between would act on an old state.
        age_s = now_s - self._newest.arrived_s
        if overdue or age_s > self.safety.answer_s:
            return self._give_up(now_s)
        self._begun_s = None
        if not self._is_late and self._lag_s + age_s > self.safety.answer_s:
            # Too late by now: the state is not answered, so it does not end a silence.
            self._lag_s += age_s
            self.safety = self.safety._replace(last_fresh_s=self._fresh_before_s)
        if age_s > self._period_s:
            self.deadline_misses += 1
        wanted: List[float] = []
        form = (np.float32, (len(self._limits),))
        if output is not None and (output.dtype, output.shape) == form:
            wanted = output.tolist()
        event = self._event_of(self._newest.state, wanted)
        self._apply(event)
        if self.safety.mode is Mode.SAFE_STOP:
            self._next_stop_s = now_s + self._period_s
            return self._stop_order(inference_ns, now_s)
        if event is Event.LATE:
            return None  # as if it had not come
        if self._newest.state.final and (self._needs_rearm or self._is_late):
            # A vehicle that is told to drive on would do so until its own watchdog stops it.
            return self._stop_order(inference_ns, now_s)._replace(reason=Event.FINAL.value)
        self._driven = self._newest
        order = self._drive_order(self._newest, wanted, inference_ns, now_s)
        if self._ride is None or self.safety.mode is not Mode.DRIVE:
            return order
        return order._replace(plan=self._ride.begin(wanted, order.action, now_s))

    def policy_died(self) -> None:
        """Note that the policy's thread has ended: a stop for good, which `tick` orders at once."""
        self._policy_is_dead = True
        self._begun_s, self._next_stop_s = None, -math.inf
        self._apply(Event.DEAD)

    def tick(self, now_s: float) -> Optional[Order]:
        """Order what is due by time alone: a stop, its repetition, or a step of a plan."""
        if self._begun_s is not None and now_s - self._begun_s > self._period_s:
            return self._give_up(now_s)
        was, watched = self.safety.mode, self._newest is not None and not self._stopped_late
        if self._policy_is_dead:
            pass  # no later fault replaces this reason
        elif was is not Mode.STANDBY and watched and rules.is_silent(self.safety, now_s):
            self._apply(Event.SILENT)
        elif self.vehicle_fault:
            self._apply(Event.VEHICLE)  # it may be over before the next state
        elif self.leash_is_used:
            self._apply(Event.LEASH)
        if self._newest is None:
            return None  # before the first state there is nobody to tell
        if self.safety.mode is not Mode.SAFE_STOP:
            ridden = self._ride.play(now_s) if self._ride else None
            if ridden is None or self._driven is None:
                return None
            return self._drive_order(self._driven, ridden, 0, now_s)._replace(ridden=True)
        if was is Mode.SAFE_STOP and now_s < self._next_stop_s:
            return None
        self._schedule_stop(now_s, on_grid=was is Mode.SAFE_STOP)
        return self._stop_order(0, now_s)

    def next_deadline_s(self) -> Optional[float]:
        """Return when `tick` must be called next; None while nothing is due by time alone."""
        due = []
        if self._begun_s is not None:
            due.append(self._begun_s + self._period_s)
        if self.safety.mode is Mode.SAFE_STOP and self._newest is not None:
            due.append(self._next_stop_s)
        elif self.safety.mode is Mode.DRIVE and self.safety.last_fresh_s is not None:
            due.append(self.safety.last_fresh_s + self.safety.silence_s)
            due += [self._ride.due_s] if self._ride else []
        return min(due) if due else None

    def rearm(self, now_s: float, stop: str = "") -> str:
        """Take an operator's permission to drive again; return why it is refused, or "".

        `stop` is SESSION/EPISODE/SAFE_STOPS as the operator saw it: no later stop is released.
        """
        if self.safety.mode is not Mode.SAFE_STOP:
            return f"nothing to re-arm: the mode is {self.safety.mode.value}"
        if self._policy_is_dead:
            return "the policy's thread is dead: restart the runtime"
        if not self._needs_rearm:
            return "no vehicle is attached: it drives again by itself after fresh states"
        if self.vehicle_fault:
            return f"the vehicle is at fault: {self.vehicle_fault}"
        if self._is_late or rules.is_silent(self.safety, now_s):
            # Kept for later, the permission would move the vehicle when the link returns.
            arrives = "only late" if self._is_late else "no fresh"
            return f"{arrives} states arrive; re-arm when the link is back"
        assert self._newest is not None  # is_silent covers None
        now = self._newest.state
        if stop not in ("", f"{now.session}/{now.episode}/{self.safety.safe_stops}"):
            return "the vehicle has stopped anew since the status was read; re-arm again"
        self.leash_is_used = False
        self._apply(Event.REARM)
        self.safety = self.safety._replace(permitted_s=now_s)
        return ""

    def farewell(self) -> Optional[Order]:
        """Order the safe stop of a runtime that is ended while it answers a simulator."""
        if self.safety.mode is Mode.STANDBY or self._newest is None:
            return None
        return self._stop_order(0, self._ordered_s)._replace(reason="runtime_ended")

    def _event_of(self, state: State, wanted: List[float]) -> Event:
        """Return the event of an answer; `wanted` is empty if it failed or has a wrong shape."""
        if self._task and is_foreign(state, self._task):
            return Event.OTHER_TASK
        if not wanted:
            return Event.FAILED
        # One or two numbers: numpy would take ten times as long for them.
        if not all(map(math.isfinite, wanted)):
            return Event.NOT_FINITE
        if self.vehicle_fault:
            return Event.VEHICLE
        if self.leash_is_used:
            return Event.LEASH
        if self._is_late:  # the end of the episode ends the drive, however late it is
            return Event.FINAL if state.final and self.safety.mode is Mode.DRIVE else Event.LATE
        return rules.classify_fresh(self.safety, state.final, self._needs_rearm)

    def _begins_episode(self, received: Received) -> bool:
        """Return whether a state begins an episode that needs a re-arm; its number may repeat."""
        before, now = self._newest, received.state
        if not self.each_episode or before is None:
            return False
        same = (before.state.session, before.state.episode) == (now.session, now.episode)
        return not same or before.state.final or received.follows_final

    @property
    def _is_late(self) -> bool:
        return self._lag_s > self.safety.answer_s

    @property
    def _stopped_late(self) -> bool:
        """Whether late states keep it stopped: the lack of fresh ones is then no new event."""
        return self._is_late and self.safety.mode is Mode.SAFE_STOP

    def _give_up(self, now_s: float) -> Order:
        """Stop because the policy takes too long; its answer, should it come, is not used."""
        self._begun_s = None
        self.deadline_misses += 1
        self._apply(Event.TOO_LONG)
        self._schedule_stop(now_s, on_grid=False)
        return self._stop_order(0, now_s)

    def _schedule_stop(self, now_s: float, on_grid: bool) -> None:
        """Keep repetitions on a grid, so that late wake-ups do not lower the rate of 1/T."""
        grid_s = self._next_stop_s + self._period_s
        self._next_stop_s = grid_s if on_grid and grid_s > now_s else now_s + self._period_s

    def _drive_order(
        self, answers: Received, wanted: List[float], inference_ns: int, now_s: float
    ) -> Order:
        # A simulator applies an action for T, however fast it runs. A vehicle applies it in real
        # time; there more than T counts as T, so that the action does not leap after a pause.
        passed_s = now_s - self._ordered_s if self._needs_rearm else self._period_s
        elapsed_s = min(max(passed_s, 0.0), self._period_s)
        self._last_action = limit_action(wanted, self._last_action, self._limits, elapsed_s)
        self._ordered_s = now_s
        return Order(answers, DRIVE, self._last_action, "", inference_ns)

    def _stop_order(self, inference_ns: int, now_s: float) -> Order:
        assert self._newest is not None  # a safe stop is an answer to a state
        if self._ride:
            self._ride.end()
        self._last_action = stop_action(self._last_action, self._limits)
        self._ordered_s = now_s
        return Order(self._newest, SAFE_STOP, self._last_action, self.safety.reason, inference_ns)

    def _apply(self, event: Event) -> None:
        self.safety = rules.advance(self.safety, event)
        if event is Event.VEHICLE:
            self._latched_fault = self._latched_fault or self.vehicle_fault
        elif event is Event.REARM or self.safety.mode is not Mode.SAFE_STOP:
            self._latched_fault = ""
