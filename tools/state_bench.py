"""Choose learner settings on a state observation: many seeds at once, in one process and thread.

The scenes, triggers and experts are the project's own; only the picture is left out, and an
observation of some 20 numbers takes its place. Networks are small and stacked: parameters are
[seeds, inputs, outputs]. The learner means the same as ``trainer.learner.td3``.

    python tools/state_bench.py GRID.json     # a list of {"scenario": ..., "algorithm": ..., ...}

Each setting adds one row a seed to ``results/choices/state_grid.csv``; settings already there are
left out.
"""

from __future__ import annotations

import csv
import json
import math
import sys
import time
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainer import seeds
from trainer.drivers import EXPERTS, TRIGGERS, make_environment
from trainer.human.congestion_trigger import CongestionTrigger
from trainer.human.guide import HumanGuide
from trainer.learner.algorithms import ALGORITHMS
from trainer.scenarios.geometry import Rectangle, overlap
from trainer.scenarios.vehicle_types import CAR

TABLE = Path("results/choices/state_grid.csv")
BATCH, WARMUP, EVERY, DRIVES, LONGEST = 128, 256, 500, 50, 8000
SENSOR = np.random.default_rng(0)
BIASED_ACTION = {"left_turn": 1.0, "congestion": 0.5}


@dataclass(frozen=True)
class Setting:
    """One run of the bench: the centre of the grid, unless said otherwise."""

    scenario: str
    algorithm: str
    n: int = 8
    saturation_weight: float = 0.03
    tau: float = 0.005
    actor_rate: float = 2e-4
    critic_rate: float = 5e-4
    rate_decay: float = 0.996
    exploration: float = 1.0
    exploration_decay: float = 0.985
    exploration_final: float = 0.05
    cloning_weight: float = 10.0
    penalty: str = "overruled"
    """human (eq. 17 as printed), overruled (a second target beside it), separate (a transition)."""
    cut_at_handover: bool = False
    bias: float = 0.0
    """Share of the human's actions that are one and the same wrong action."""
    random: float = 0.0
    """Share that is uniform at random."""
    gamma: float = 0.95
    alpha: float = 0.6
    width: int = 64
    steps: int = 4000
    seeds: int = 6
    coarse: float = 0.0
    """The congestion seen less well: noise of so many times 0.1 m on all places across the road
    and 0.02 rad on the heading, anew in each step, as a stand-in for a picture's pixels."""


# --- Observation: the same from one environment a seed and from arrays of drives.


def observe(
    scenario: str, ego: NDArray, cars: NDArray, coarse: float, random: np.random.Generator
) -> NDArray[np.float32]:
    """Some 20 numbers [drives, k] from ego [drives, (x, y, heading, speed, distance)] and
    cars [drives, cars, (x, y, speed, length, width)].
    """
    x, y, heading, speed, distance = ego.T
    if coarse:
        y = y + coarse * random.normal(0, 0.1, len(y))
        heading = heading + coarse * random.normal(0, 0.02, len(y))
    if scenario == "left_turn":
        own = np.stack([speed / 6, distance / 20], 1)
        along = np.clip(cars[..., 0] / 20, -3, 1.5)
        others = np.stack([along, cars[..., 2] / 6, cars[..., 3] / 5], 2)
    else:
        own = np.stack([speed / 6, y, 10 * heading], 1)
        ahead = np.clip((cars[..., 0] - x[:, None]) / 10, -3, 3)
        others = np.stack([ahead, cars[..., 1] - y[:, None], cars[..., 2] / 6], 2)
        others[..., 1] /= 3.5
    return np.concatenate([own, others.reshape(len(ego), -1)], 1).astype(np.float32)


def ego_state(env: Any) -> list[float]:
    """The ego car's x, y, heading, speed and distance."""
    e = env.ego
    return [*e.position.tolist(), e.heading, e.speed, env.distance_m]


def car_states(env: Any) -> list[list[float]]:
    """Without the one that follows the ego car: it never matters, and depends on the drive."""
    cars = [car for car in env.traffic if car.leader is not env.ego]
    return [[*car.position.tolist(), car.speed, car.LENGTH, car.WIDTH] for car in cars]


def blind_environment(scenario: str) -> Any:
    """The scenario without its picture."""
    env = make_environment(scenario)
    nothing = np.zeros((45, 80), np.uint8)
    env._frame = lambda: nothing
    return env


# --- Test drives, all at once: traffic is recorded, since it does not react to the ego car.


@cache
def recorded(scenario: str) -> tuple[NDArray, NDArray]:
    """Ego at the start [drives, 5]; cars at each step [steps + 1, drives, cars, 5]."""
    env = blind_environment(scenario)
    starts, tracks = [], []
    for drive in range(DRIVES):
        env.reset(seed=seeds.episode_seed(0, seeds.VALIDATION, drive))
        starts.append(ego_state(env))
        track = [car_states(env)]
        for _ in range(env.config.max_steps):
            env.step(np.zeros(1, np.float32))
            track.append(car_states(env))
        tracks.append(track)
    return np.array(starts), np.array(tracks).swapaxes(0, 1)


def overlaps(ego: NDArray, cars: NDArray) -> NDArray[np.bool_]:
    """Separating axes; the ego car is 5 m x 2 m, the others go along x: bool [drives]."""
    dx, dy = cars[..., 0] - ego[:, None, 0], cars[..., 1] - ego[:, None, 1]
    length, width = cars[..., 3], cars[..., 4]
    cos, sin = np.cos(ego[:, None, 2]), np.sin(ego[:, None, 2])
    c, s = abs(cos), abs(sin)
    apart = (2 * abs(dx) > length + 5 * c + 2 * s) | (2 * abs(dy) > width + 5 * s + 2 * c)
    apart |= 2 * abs(dx * cos + dy * sin) > 5 + length * c + width * s
    apart |= 2 * abs(dy * cos - dx * sin) > 2 + length * s + width * c
    return ~apart.all(1)


class TestDrives:
    """Each of ``actors`` policies drives the same test drives; all in step."""

    def __init__(self, scenario: str, actors: int, coarse: float = 0.0) -> None:
        self.coarse, self.random = coarse, np.random.default_rng(0)
        self.scenario, self.env = scenario, blind_environment(scenario)
        self.env.reset(seed=0)
        starts, self.cars = recorded(scenario)
        self.ego = np.tile(starts, (actors, 1))
        self.actors, self.step_number = actors, 0
        self.offset, self.integral = np.zeros(len(self.ego)), np.zeros(len(self.ego))

    def success(self, policy: Any) -> NDArray[np.float64]:
        """Share of goals of each actor; ``policy`` maps [actors, drives, k] to [actors, drives]."""
        running, goals = np.ones(len(self.ego), bool), np.zeros(len(self.ego), bool)
        for step in range(self.env.config.max_steps):
            cars = np.tile(self.cars[step], (self.actors, 1, 1))
            seen = observe(self.scenario, self.ego, cars, self.coarse, self.random)
            action = policy(torch.from_numpy(seen).view(self.actors, DRIVES, -1)).reshape(-1)
            self._move(np.clip(action, -1, 1).astype(float), cars)
            hit = overlaps(self.ego, np.tile(self.cars[step + 1], (self.actors, 1, 1)))
            failed, goal = hit | self._off_road(), self.ego[:, 4] >= self.env.config.goal_m
            goals |= running & goal & ~failed
            running &= ~failed & ~goal
            if not running.any():
                break
        return goals.reshape(self.actors, DRIVES).mean(1)

    def _move(self, action: NDArray, cars: NDArray) -> None:
        c = self.env.config
        if self.scenario == "left_turn":
            acceleration = action * np.where(action > 0, c.throttle_mps2, c.brake_mps2)
            self._drive(acceleration, self._tracker(), c.max_speed_mps)
            self._project()
        else:
            self._drive(self._pedals(cars), action * c.lambda_rad, c.desired_speed_mps)
            self.ego[:, 4] = self.ego[:, 0]

    def _drive(self, acceleration: NDArray, steering: NDArray, fastest: float) -> None:
        x, y, heading, speed, _ = self.ego.T
        slip = np.arctan(0.5 * np.tan(steering))
        after = np.clip(speed + 0.1 * acceleration, 0, fastest)
        self.ego[:, 0] = x + 0.1 * speed * np.cos(heading + slip)
        self.ego[:, 1] = y + 0.1 * speed * np.sin(heading + slip)
        self.ego[:, 2] = heading + 0.1 * speed * np.sin(slip) / 2.5
        self.ego[:, 3] = after

    def _tracker(self) -> NDArray:
        t, path = self.env.tracker, self.env.path
        self.integral = np.clip(self.integral + 0.1 * self.offset, -1, 1)
        on_arc = self.ego[:, 4] - path.straight_m
        bend = (on_arc > 0) & (on_arc <= path.arc_m)
        slip = np.arcsin(2.5 * np.where(bend, -1 / path.radius_m, 0))
        course = -0.5 * np.pi - np.clip(on_arc / path.radius_m, 0, 0.5 * np.pi)
        error = (course - slip - self.ego[:, 2] + np.pi) % (2 * np.pi) - np.pi
        angle = np.arctan(2 * np.tan(slip)) + t.HEADING_GAIN * error
        angle -= t.OFFSET_GAIN_RAD_PER_M * self.offset + t.INTEGRAL_GAIN_RAD_PER_MS * self.integral
        return np.clip(angle, -np.pi / 4, np.pi / 4)

    def _project(self) -> None:
        path, (x, y) = self.env.path, self.ego.T[:2]
        before, after = y >= path.centre_y, x <= path.centre_x
        dx, dy = x - path.centre_x, path.centre_y - y
        s = [path.start_y - y, path.straight_m + path.arc_m + path.centre_x - x]
        offset = [x - path.start_x, path.centre_y - path.radius_m - y]
        s_arc = path.straight_m + np.arctan2(dy, dx) * path.radius_m
        self.ego[:, 4] = np.select([before, after], s, s_arc)
        self.offset = np.select([before, after], offset, np.hypot(dx, dy) - path.radius_m)

    def _pedals(self, cars: NDArray) -> NDArray:
        """``idm_acceleration`` behind the nearest car in the corridor."""
        c, v = self.env.config, self.ego[:, 3]
        ahead = cars[..., 0] - self.ego[:, None, 0]
        leads = (ahead > 0) & (2 * abs(cars[..., 1] - self.ego[:, None, 1]) < 2 + cars[..., 4])
        ahead = np.where(leads, ahead, np.inf)
        nearest = ahead.argmin(1)[:, None]
        room = ahead - 0.5 * (5 + cars[..., 3])
        gap = np.take_along_axis(room, nearest, 1)[:, 0]
        closing = v - np.take_along_axis(cars[..., 2], nearest, 1)[:, 0]
        closing = np.where(np.isfinite(gap), closing, 0.0)
        a, b = CAR.acceleration_mps2, CAR.deceleration_mps2
        wanted = v * c.time_gap_factor * CAR.time_gap_s + v * closing / (2 * np.sqrt(a * b))
        wanted = CAR.standstill_gap_m + np.maximum(0, wanted)
        free = 1 - (v / c.desired_speed_mps) ** 4
        return np.maximum(a * (free - (wanted / np.maximum(gap, 0.1)) ** 2), -c.brake_mps2)

    def _off_road(self) -> NDArray[np.bool_]:
        if self.scenario == "left_turn":
            return abs(self.offset) > 0.5 * self.env.config.lane_width_m
        heading = self.ego[:, 2]
        reach = 2.5 * abs(np.sin(heading)) + abs(np.cos(heading))
        return abs(self.ego[:, 1]) + reach > 0.5 * self.env.road_width_m


# --- Learner.


class Stack:
    """``count`` networks of three layers in one flat tensor, with Adam and a slow copy."""

    def __init__(self, count: int, inputs: int, width: int, random: torch.Generator) -> None:
        sizes = [(inputs, width), (1, width), (width, width), (1, width), (width, 1), (1, 1)]
        bounds = [inputs, inputs, width, width, width, width]
        parts = [
            (torch.rand(count, a * b, generator=random) * 2 - 1) * i**-0.5
            for (a, b), i in zip(sizes, bounds, strict=True)
        ]
        self.flat, self.sizes = torch.cat(parts, 1), sizes
        self.slow = self.flat.clone()
        self.first, self.second = torch.zeros_like(self.flat), torch.zeros_like(self.flat)
        self.weights = [w.requires_grad_() for w in self._views(self.flat)]
        self.slow_weights = self._views(self.slow)
        self.updates = 0

    def _views(self, flat: Tensor) -> list[Tensor]:
        pieces = flat.split([a * b for a, b in self.sizes], 1)
        return [p.view(-1, a, b) for p, (a, b) in zip(pieces, self.sizes, strict=True)]

    @torch.no_grad()
    def step(self, gradients: tuple[Tensor, ...], rates: Tensor, tau: float) -> None:
        """Adam with a rate for each network [count, 1], then the soft update."""
        gradient = torch.cat([g.flatten(1) for g in gradients], 1)
        self.updates += 1
        self.first.lerp_(gradient, 0.1)
        self.second.mul_(0.999).addcmul_(gradient, gradient, value=0.001)
        root = (self.second / (1 - 0.999**self.updates)).sqrt_().add_(1e-8)
        self.flat.sub_((self.first / root).mul_(rates / (1 - 0.9**self.updates)))
        self.slow.lerp_(self.flat, tau)


def forward(weights: list[Tensor], x: Tensor) -> Tensor:
    """[count, batch] from [count, batch, inputs]."""
    w1, b1, w2, b2, w3, b3 = weights
    hidden = torch.baddbmm(b1, x, w1).relu_()
    hidden = torch.baddbmm(b2, hidden, w2).relu_()
    return torch.baddbmm(b3, hidden, w3).squeeze(2)


class Replay:
    """All seeds in step: slot ``t`` is step t of every seed, ``steps + t`` its overruled action."""

    def __init__(self, setting: Setting, inputs: int, random: torch.Generator) -> None:
        s, self.steps, self.random = setting.seeds, setting.steps, random
        self.n, self.gamma, self.alpha = setting.n, setting.gamma, setting.alpha
        slots = 2 * self.steps if setting.penalty == "separate" else self.steps
        self.used, self.slots = 0, slots
        self.here, self.there = torch.zeros(s, slots, inputs), torch.zeros(s, slots, inputs)
        names = ("action", "reward", "terminal", "human", "first", "overruled", "stop")
        self.columns = {name: torch.zeros(s, slots) for name in names}
        self.priority = torch.zeros(s, slots, dtype=torch.double)
        self.weight = torch.zeros_like(self.priority)
        self.base = torch.arange(s)[:, None] * slots

    def put(self, slot: int, here: NDArray, there: NDArray, mask: Any = 1.0, **row: Any) -> None:
        """Store one step of all seeds with each seed's highest priority; ``mask`` 0: not drawn."""
        highest = self.priority.amax(1) if self.used else torch.ones(len(self.base))
        self.here[:, slot], self.there[:, slot] = torch.from_numpy(here), torch.from_numpy(there)
        for name, values in row.items():
            self.columns[name][:, slot] = torch.as_tensor(np.asarray(values, np.float32))
        mask = torch.as_tensor(np.broadcast_to(np.asarray(mask, float), len(self.base)).copy())
        self.priority[:, slot] = highest * mask
        self.weight[:, slot] = highest**self.alpha * mask

    def take(self, name: str, index: Tensor) -> Tensor:
        """A column at flat indices."""
        return self.columns[name].view(-1)[index]

    def sample(self) -> dict[str, Tensor]:
        """A prioritised, stratified batch [seeds, batch] with its n-step sums."""
        cumulated = self.weight.cumsum(1)
        share = torch.rand(len(self.base), BATCH, generator=self.random, dtype=torch.double)
        share = (torch.arange(BATCH) + share) / BATCH * cumulated[:, -1:]
        index = torch.searchsorted(cumulated, share, right=True).clamp_(max=self.slots - 1)
        own = index + self.base
        newest = torch.where(index >= self.steps, self.steps, 0) + self.used - 1
        steps = index[..., None] + torch.arange(self.n)
        inside = steps <= newest[..., None]
        flat = torch.minimum(steps, newest[..., None]) + self.base[..., None]
        going = torch.ones(flat.shape)
        going[..., 1:] = (1 - self.take("stop", flat)[..., :-1]).cumprod(2)
        going *= inside
        powers = self.gamma ** torch.arange(self.n)
        count = going.sum(2)
        last = own + count.long() - 1
        batch = {name: self.take(name, own) for name in ("action", "human", "first", "overruled")}
        batch["return"] = (going * powers * self.take("reward", flat)).sum(2)
        batch["discount"] = self.gamma**count * (1 - self.take("terminal", last))
        width = self.here.shape[2]
        batch["here"] = self.here.view(-1, width)[own]
        batch["there"] = self.there.view(-1, width)[last]
        batch["index"] = own
        return batch

    def set_priorities(self, index: Tensor, priority: Tensor) -> None:
        """New priorities at flat indices."""
        self.priority.view(-1)[index] = priority.double()
        self.weight.view(-1)[index] = priority.double() ** self.alpha


class Learner:
    """TD3 with human guidance for all seeds of a setting."""

    PENALTY = -10.0

    def __init__(self, setting: Setting, inputs: int) -> None:
        self.c, self.row = setting, ALGORITHMS[setting.algorithm]
        self.random = torch.Generator().manual_seed(1)
        s = setting.seeds
        self.actor = Stack(s, inputs, setting.width, self.random)
        self.critics = Stack(2 * s, inputs + 1, setting.width, self.random)
        self.replay = Replay(setting, inputs, self.random)
        self.seen = {"score": np.zeros(s), "q": np.zeros(s)}

    def update(self, decay: Tensor) -> None:
        """One step of all seeds; ``decay`` [seeds, 1] is the factor on their learning rates."""
        c, b, s = self.c, self.replay.sample(), self.c.seeds
        here, human = b["here"], b["human"]
        pair = lambda x, a: torch.cat([x, a[..., None]], 2)  # noqa: E731
        with torch.no_grad():
            noise = torch.randn(human.shape, generator=self.random).mul_(0.2).clamp_(-0.5, 0.5)
            following = forward(self.actor.slow_weights, b["there"]).tanh_().add_(noise)
            x = pair(b["there"], following.clamp_(-1, 1)).repeat(2, 1, 1)
            value = forward(self.critics.slow_weights, x).view(2, s, BATCH).amin(0)
            target = b["return"] + b["discount"] * value
        x = pair(here, b["action"])
        error = target - forward(self.critics.weights, x.repeat(2, 1, 1)).view(2, s, BATCH)
        loss, size = error.square().sum(), error[0].detach().abs()
        rows = int(b["first"].sum(1).max()) if c.penalty == "overruled" else 0
        if rows:
            mask, chosen = b["first"].topk(rows, 1)
            width = here.shape[2]
            few = here.gather(1, chosen[..., None].expand(-1, -1, width))
            x_over = pair(few, b["overruled"].gather(1, chosen))
            q = forward(self.critics.weights, x_over.repeat(2, 1, 1)).view(2, s, rows)
            wrong = (self.PENALTY - q) * mask
            loss = loss + wrong.square().sum()
            larger = torch.maximum(size.gather(1, chosen), wrong[0].detach().abs())
            size = size.scatter(1, chosen, larger)
        critic_gradients = torch.autograd.grad(loss / BATCH, self.critics.weights)

        score = forward(self.actor.weights, here)
        own = score.tanh()
        first = [w[:s].detach() for w in self.critics.weights]
        q_own = forward(first, pair(here, own))
        policy = -q_own.sum() / BATCH + c.saturation_weight * score.square().sum() / BATCH
        if self.row.behaviour_cloning:
            apart = ((b["action"] - own).square() * human).sum(1) / human.sum(1).clamp(min=1)
            policy = policy + c.cloning_weight * apart.sum()
        actor_gradients = torch.autograd.grad(policy, self.actor.weights)

        priority = size + 1e-3
        if self.row.advantage_weight:
            with torch.no_grad():
                slow = [w[:s] for w in self.critics.slow_weights]
                better = forward(slow, x) - forward(slow, pair(here, own.detach()))
            priority = priority + better.clamp_(-4, 4).exp_() * human
        self.replay.set_priorities(b["index"], priority)
        self.actor.step(actor_gradients, c.actor_rate * decay, c.tau)
        self.critics.step(critic_gradients, c.critic_rate * decay.repeat(2, 1), c.tau)
        self.seen["score"] = score.detach().abs().mean(1).numpy()
        self.seen["q"] = q_own.detach().mean(1).numpy()

    @torch.no_grad()
    def judge(self) -> NDArray[np.float64]:
        """Success of online and averaged actors, [2, seeds]."""
        both = [
            torch.cat([w, v])
            for w, v in zip(self.actor.weights, self.actor.slow_weights, strict=True)
        ]
        drives = TestDrives(self.c.scenario, 2 * self.c.seeds, self.c.coarse)
        return drives.success(lambda x: forward(both, x).tanh_().numpy()).reshape(2, -1)


# --- Training.


class QuickHits:
    """``CongestionTrigger._hits``, with two of the four separating axes looked at first: it takes
    most of the time otherwise.
    """

    def __init__(self, env: Any) -> None:
        self.env, self.of = env, (0, -1)
        self.cars: list[tuple[Rectangle, float]] = []

    def __call__(self, ego: Rectangle, ahead_s: float) -> bool:
        """Whether ``ego`` is within the margin of a car aside, in ``ahead_s``."""
        now = (id(self.env.road), int(self.env.steps))
        if now != self.of:
            aside = [c for c in self.env.traffic if c.lane.start[1] != 0.0]
            self.of, self.cars = now, [(c.footprint, c.speed) for c in aside]
        wider = ego._replace(width=ego.width + 2.0 * CongestionTrigger.MARGIN_M)
        cos, sin = abs(math.cos(ego.heading)), abs(math.sin(ego.heading))
        long, wide = wider.length * cos + wider.width * sin, wider.length * sin + wider.width * cos
        for shape, speed in self.cars:
            x = shape.x + speed * ahead_s
            beside = 2 * abs(ego.y - shape.y) <= shape.width + wide
            if not beside or 2 * abs(ego.x - x) > shape.length + long:
                continue
            if overlap(wider, shape._replace(x=x)):
                return True
        return False


class Seat:
    """One seed's environment and human."""

    def __init__(self, setting: Setting, seed: int) -> None:
        self.c, self.seed, self.episode = setting, seed, -1
        self.env = blind_environment(setting.scenario)
        expert = EXPERTS[setting.scenario](self.env)
        trigger = TRIGGERS[setting.scenario](expert)
        if setting.scenario == "congestion":
            trigger._hits = QuickHits(self.env)  # type: ignore[attr-defined]
        self.guide = HumanGuide(expert, trigger)
        self.guided = ALGORITHMS[setting.algorithm].guided
        self.noise = seeds.stream(seed, seeds.EXPLORATION)
        self.poor = seeds.stream(seed, seeds.GUIDANCE)
        self.human_steps = self.interventions = self.failures = 0
        self.start()

    def start(self) -> None:
        """Begin the next episode."""
        self.episode += 1
        self.env.reset(seed=seeds.episode_seed(self.seed, seeds.TRAINING, self.episode))
        self.guide.reset()

    def explore(self, action: float) -> float:
        """The action with this episode's noise."""
        c = self.c
        std = max(c.exploration_final, c.exploration * c.exploration_decay**self.episode)
        return float(np.clip(action + np.clip(self.noise.normal(0, std), -1, 1), -1, 1))

    def step(self, own: float) -> dict[str, float]:
        """One control period with the policy's (noisy) action ``own``."""
        watched = np.array([own], np.float32)
        help_ = self.guide.watch(None, watched) if self.guided else None  # type: ignore[arg-type]
        action = watched if help_ is None else self._spoil(help_.action)
        _, reward, terminal, truncated, info = self.env.step(action)
        first = help_ is not None and help_.first
        penalised = first and help_ is not None and help_.reason != "stuck"
        self.human_steps += help_ is not None
        self.interventions += first
        self.failures += info.get("outcome") not in (None, "goal")
        if penalised and self.c.penalty == "human":
            reward += Learner.PENALTY
        return {
            "action": float(action[0]),
            "reward": reward,
            "terminal": terminal,
            "stop": terminal or truncated,
            "human": help_ is not None,
            "first": penalised,
            "overruled": own,
            "handover": first,
        }

    def _spoil(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        draw, other = self.poor.random(), self.poor.uniform(-1, 1)
        if draw < self.c.bias:
            return np.array([BIASED_ACTION[self.c.scenario]], np.float32)
        return np.array([other], np.float32) if draw < self.c.random else action


def look(setting: Setting, seats: list[Seat]) -> NDArray[np.float32]:
    """What each seed sees now."""
    ego = np.array([ego_state(seat.env) for seat in seats])
    cars = np.array([car_states(seat.env) for seat in seats])
    return observe(setting.scenario, ego, cars, setting.coarse, SENSOR)


def train(c: Setting) -> list[dict[str, Any]]:
    """Train all seeds of a setting; one row of the table each."""
    seats = [Seat(c, seed) for seed in range(1, c.seeds + 1)]
    seen = look(c, seats)
    learner = Learner(c, seen.shape[1])
    replay, judged = learner.replay, []
    for step in range(c.steps):
        with torch.no_grad():
            sure = forward(learner.actor.weights, torch.from_numpy(seen)[:, None]).tanh_()[:, 0]
        own = [seat.explore(a) for seat, a in zip(seats, sure.tolist(), strict=True)]
        if step >= WARMUP:
            decay = np.array([[c.rate_decay**seat.episode] for seat in seats], np.float32)
            learner.update(torch.from_numpy(decay))
        rows = [seat.step(a) for seat, a in zip(seats, own, strict=True)]
        column = {name: [float(row[name]) for row in rows] for name in rows[0]}
        handover = column.pop("handover")
        if c.cut_at_handover and step:
            replay.columns["stop"][:, step - 1].clamp_(min=torch.tensor(handover))
        after = look(c, seats)
        replay.put(step, seen, after, **column)
        if c.penalty == "separate":
            wrong = {"action": own, "reward": Learner.PENALTY, "terminal": 1, "stop": 1}
            replay.put(c.steps + step, seen, after, mask=column["first"], **wrong)
        replay.used = step + 1
        for seat, row in zip(seats, rows, strict=True):
            if row["stop"]:
                seat.start()
        ended = np.array(column["stop"], bool)
        seen = np.where(ended[:, None], look(c, seats), after) if ended.any() else after
        if (step + 1) % EVERY == 0:
            judged.append(learner.judge())
    return [report(c, seat, np.array(judged)[:, :, i], learner) for i, seat in enumerate(seats)]


def report(c: Setting, seat: Seat, judged: NDArray, learner: Learner) -> dict[str, Any]:
    """A row of the table; ``judged`` is [validations, (online, averaged)]."""
    row: dict[str, Any] = {**asdict(c), "seed": seat.seed, "episodes": seat.episode}
    row["human_share"] = round(seat.human_steps / c.steps, 3)
    row |= {"interventions": seat.interventions, "failures": seat.failures}
    row |= {f"mean_{k}": round(float(v[seat.seed - 1]), 2) for k, v in learner.seen.items()}
    for column, name in enumerate(("online", "averaged")):
        success = (100 * judged[:, column]).round().astype(int)
        row |= {f"{name}_best": success.max(), f"{name}_last": success[-1]}
        row |= {f"{name}_{EVERY * (i + 1)}": value for i, value in enumerate(success)}
    return row


def columns() -> list[str]:
    """The table's header."""
    names = [f.name for f in fields(Setting) if f.name != "coarse"] + [
        "seed",
        "episodes",
        "human_share",
    ]
    names += ["interventions", "failures", "mean_score", "mean_q"]
    for actor in ("online", "averaged"):
        names += [f"{actor}_best", f"{actor}_last"]
        names += [f"{actor}_{at}" for at in range(EVERY, LONGEST + 1, EVERY)]
    return [*names, "coarse"]


def main() -> None:
    """Run a file of settings."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    known = {f.name for f in fields(Setting)}
    done = set()
    if TABLE.is_file():
        with TABLE.open() as file:
            done = {tuple(row[name] for name in sorted(known)) for row in csv.DictReader(file)}
    else:
        TABLE.write_text(",".join(columns()) + "\n")
    for entry in json.loads(Path(sys.argv[1]).read_text()):
        setting = Setting(**entry)
        if tuple(str(getattr(setting, name)) for name in sorted(known)) in done:
            continue
        began_s = time.perf_counter()
        rows = train(setting)
        with TABLE.open("a", newline="") as file:
            csv.DictWriter(file, columns()).writerows(rows)
        curve = [
            np.mean([r[f"online_{at}"] for r in rows]).round()
            for at in range(EVERY, setting.steps + 1, EVERY)
        ]
        spent_s = time.perf_counter() - began_s
        print(f"{spent_s:.0f} s", entry, [int(x) for x in curve], flush=True)


if __name__ == "__main__":
    main()
