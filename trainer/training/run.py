"""One training run: algorithm 1 around an environment, a human and a learner."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bridge.episode import finite
from bridge.network import parse_spec
from edge_runtime.files import write_atomic, write_json
from edge_runtime.util import UserError
from trainer import util
from trainer.drivers import CHECKPOINT_FILE, is_expert, load_driver
from trainer.environments import check_foresight, expert_of, foresee, make_environment
from trainer.human.guide import (
    ASKED,
    STUCK,
    Asking,
    Attention,
    Guide,
    HumanGuide,
    Intervention,
    Trigger,
    steps_held,
)
from trainer.learner import equations
from trainer.learner.config import HUMANS_ACTION, find_algorithm
from trainer.learner.td3 import NETWORKS, TD3Learner
from trainer.training.config import BIASED, CONFIG_FILE, CONFIG_TOML, RunConfig
from trainer.training.delayed import DelayedPolicy
from trainer.training.learning import LearningThread
from trainer.training.metrics import (
    REPORT_FILE,
    EpisodeMetrics,
    MetricsWriter,
    Validation,
    read_metrics,
    totals,
)


@contextmanager
def divergence_said(episode: int) -> Iterator[None]:
    """Turn the FloatingPointError of learning that diverged into a UserError.

    The episode under way counts from 0; people count from 1.
    """
    try:
        yield
    except FloatingPointError as error:
        raise UserError(
            f"the training diverged in episode {episode + 1}: {error}; a smaller "
            "--set actor_learning_rate or critic_learning_rate may help"
        ) from None


def check_weights(learner: TD3Learner) -> None:
    """Raise FloatingPointError unless every weight is finite: no such checkpoint is kept."""
    for name in NETWORKS:
        for parameter in getattr(learner, name).parameters():
            if not parameter.isfinite().all():
                raise FloatingPointError("its weights are no longer finite")


@dataclass(frozen=True)
class Seen:
    """One control period, once it is stored; nothing in it changes afterwards."""

    observation: NDArray[Any]  # s
    policy_action: NDArray[np.float32]
    """With the exploration's noise, as the vehicle would have had it."""
    intervention: Intervention | None
    action: NDArray[np.float32]  # What was carried out
    speed_mps: float  # After the step


class TrainingRun:
    """Trains for some episodes; settings, metrics, checkpoint and best actor go to ``run_dir``."""

    learning_kind: ClassVar[type[LearningThread]] = LearningThread

    def __init__(self, config: RunConfig, run_dir: Path, resume: bool = False) -> None:
        self.config, self.run_dir = config, run_dir
        self.algorithm = find_algorithm(config.algorithm)
        self.env = make_environment(
            config.scenario, printed_reward=config.printed_reward, period_s=config.period_s
        )
        if self.algorithm.foresight:
            check_foresight(self.env)
        self._copied = self.env  # the bare environment: a person's run wraps `self.env` later
        action_size = self.env.action_space.shape[0]
        self.network = parse_spec(config.latency)
        seen = self.env.observation_space, self.env.layout
        switches = config.learner, self.algorithm
        self.learning = self.learning_kind(
            *switches, config.seed, action_size, config.device, *seen
        )
        self.validation = Validation(config, run_dir, self.learning, self.env)
        self.policy = DelayedPolicy(self.learning, self.env, self.network)
        self.exploration = util.random_stream(config.seed, util.Purpose.EXPLORATION)
        self.guidance = util.random_stream(config.seed, util.Purpose.GUIDANCE)
        self.gate: Asking | None = None  # Where the robot asks for help
        self.guide = self._make_guide()
        self.episode = self.steps = 0
        self.on_step: Callable[[Seen], None] | None = None
        """Called at the end of each control period, where the run is watched."""
        self.quitting = False  # The episode under way is to be the last of this call
        if resume:
            self._load()

    def train(
        self,
        on_episode: Callable[[EpisodeMetrics], None] = lambda metrics: None,
        deadline_s: float = math.inf,
    ) -> None:
        """Train until the configured end, or ``time.monotonic() > deadline_s``.

        Call it once: its end stops the learner's thread. A new run with
        ``resume`` goes on.
        """
        if not self.over:  # Else another revision has trained it.
            about = {**asdict(self.config), "source_revision": util.source_revision()}
            write_json(self.run_dir / CONFIG_FILE, about)
            write_atomic(self.run_dir / CONFIG_TOML, self.config.as_toml().encode())
        metrics_writer = MetricsWriter(self.run_dir, self.episode, self.env.control_period_s)
        try:
            while not self.over:
                metrics = self.advance()
                late = self._must_stop(deadline_s)
                self._validate(metrics, at_end=self.over or late)
                metrics_writer.add(metrics)
                # Read once, so that every end has its checkpoint. Quitting adds no validation that
                # is not due: a resumed run then has had the same ones.
                ending = self.over or late or self.quitting
                if ending or self.episode % self.config.checkpoint_every == 0:
                    self.save()
                on_episode(metrics)
                if ending:
                    break
        finally:
            metrics_writer.close()
            self.learning.close()
            self._copied.close()
            rows, kept = read_metrics(self.run_dir), self.validation.kept_episode
            so_far = totals(rows, self.env.control_period_s, kept)
            write_json(self.run_dir / REPORT_FILE, so_far)

    def advance(self) -> EpisodeMetrics:
        """Train one episode, without validation and checkpoint; UserError where it diverges."""
        with divergence_said(self.episode):
            metrics = self._episode()
            check_weights(self.learning.learner)
        self.episode += 1
        self.steps += metrics.steps
        return metrics

    @property
    def over(self) -> bool:
        """Whether the configured episodes or steps are driven."""
        return self.progress >= 1.0

    @property
    def progress(self) -> float:
        """Share of the run that is done, 0 to 1."""
        episodes = self.episode / self.config.episodes
        return max(episodes, self.steps / self.config.steps) if self.config.steps else episodes

    def quit(self) -> bool:
        """Ask for the end after the episode under way, with a checkpoint; True: it will come."""
        self.quitting = True
        return True

    def save(self) -> None:
        """Write the checkpoint."""
        util.save_torch(
            self.run_dir / CHECKPOINT_FILE,
            {
                **self.config.label(self.episode),
                **self._more_state(),
                "learning": self.learning.state_dict(),
                "steps": self.steps,
                "kept_actor": self.config.kept_actor,
                "exploration": self.exploration.bit_generator.state,
                "guidance": self.guidance.bit_generator.state,
                "doubts": list(self.gate.doubts) if self.gate else [],
                **self.validation.state_dict(),
            },
        )

    def _more_state(self) -> dict[str, Any]:
        """What a subclass adds to the checkpoint."""
        return {}

    def _load(self) -> None:
        path = self.run_dir / CHECKPOINT_FILE
        with util.fitting(f"{path} does not fit this run"):
            self._restore(util.load_torch(path))

    def _restore(self, state: dict[str, Any]) -> None:
        counts = state["episode"], state["steps"], state["learning"]["learner"]["updates"]
        if not all(type(count) is int and count >= 0 for count in counts):
            raise ValueError(f"counts of {counts}")
        self.episode, self.steps, _ = counts
        self.learning.load_state_dict(state["learning"])
        self.exploration.bit_generator.state = state["exploration"]
        self.guidance.bit_generator.state = state["guidance"]
        if self.gate:
            self.gate.doubts.extend(state["doubts"])
        self.validation.load_state_dict(state)

    def _must_stop(self, deadline_s: float) -> bool:
        """Whether the episode just driven is the last of this call."""
        return time.monotonic() > deadline_s

    def _make_guide(self) -> Guide | None:
        if not self.algorithm.guided:
            return None
        config, asks = self.config, self.algorithm.asks
        driver, _ = load_driver(config.human, self.env)
        trigger: Trigger = expert_of(
            self.env, config.human if is_expert(config.human) else "expert"
        )
        if asks:
            trigger = self.gate = Asking(trigger, asks)
        attention, period_s = None, self.env.control_period_s
        if config.late_to_s or config.missed_share:
            late_steps = config.late_from_s / period_s, config.late_to_s / period_s
            attention = Attention(late_steps, config.missed_share, self.guidance)
        return HumanGuide(driver, trigger, steps_held(period_s), attention)

    def _episode(self) -> EpisodeMetrics:
        config, metrics = self.config, EpisodeMetrics(self.episode)
        seed = util.episode_seed(config.seed, util.Purpose.TRAINING, self.episode)
        observation, info = self.env.reset(seed=seed)
        self.policy.start(observation, seed)
        self._drawn = np.zeros(self.env.action_space.shape)
        guided = self.guide is not None and config.guided(self.episode, self.steps)
        if self.guide is not None:
            self.guide.reset()
        ended = False
        while not ended:
            observation, ended, info = self._step(observation, guided, metrics)
        learned = self.learning.end_episode(self.progress)
        return replace(
            metrics,
            total_steps=self.steps + metrics.steps,
            updates=self.learning.learner.updates,
            episode_return=float(metrics.episode_return),
            distance_m=finite("distance_m", info["distance_m"]),
            outcome=info["outcome"],
            exploration_std=self._exploration_std(),
            **learned,
        )

    def _step(
        self, observation: NDArray[Any], guided: bool, metrics: EpisodeMetrics
    ) -> tuple[NDArray[Any], bool, dict[str, Any]]:
        """One control period: act, let the human take over and the car move; meanwhile, learn."""
        began_s = time.perf_counter()
        policy_action = self.policy.act(observation, self._explore)
        if guided and self.gate is not None:
            self.gate.doubts.append(self.learning.doubt(observation, policy_action))
        acted_s = time.perf_counter()
        if self.learning.added >= self.config.learner.warmup_steps:
            self.learning.begin(self._beta())
        begun_s = time.perf_counter()
        intervention = None
        if guided and self.guide is not None:
            intervention = self._spoil(self.guide.watch(observation, policy_action))
        human_action = None if intervention is None else intervention.action
        if intervention is not None:
            self.policy.yield_to_human()
        action = equations.masked_action(policy_action, human_action)
        foreseen = []
        if intervention is not None and self.algorithm.foresight:
            foreseen = foresee(self._copied, observation, policy_action, self.algorithm.foresight)
        next_observation, reward, terminated, truncated, info = self.env.step(action)
        moved_s = time.perf_counter()
        waited_s = self.learning.finish()
        self.policy.store(
            action,
            self._shape(reward, intervention),
            next_observation,
            terminated,
            intervention is not None,
            overruled=policy_action,
            penalised=self._penalises(intervention),
            foreseen=foreseen,
        )
        stored_s = time.perf_counter()
        metrics.steps += 1
        metrics.episode_return += reward
        metrics.human_steps += intervention is not None
        metrics.interventions += intervention is not None and intervention.first
        metrics.acting_s += acted_s - began_s
        metrics.environment_s += moved_s - begun_s
        metrics.storing_s += begun_s - acted_s + stored_s - moved_s - waited_s
        if self.on_step is not None:
            speed_mps = float(info["speed_mps"])
            self.on_step(Seen(observation, policy_action, intervention, action, speed_mps))
        return next_observation, terminated or truncated, info

    def _spoil(self, intervention: Intervention | None) -> Intervention | None:
        """Make a demonstration a wrong action, as often as the settings ask for."""
        config, share = self.config, self.config.poor_guidance_share
        if intervention is None or not share or self.guidance.random() >= share:
            return intervention
        shape = intervention.action.shape
        wrong = (
            np.full(shape, self.env.biased_action)
            if config.poor_guidance == BIASED
            else self.guidance.uniform(-1.0, 1.0, shape)
        )
        return replace(intervention, action=wrong.astype(np.float32))

    def _explore(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        action = self.learning.act(observation)
        if not np.isfinite(action).all():  # No car is to be driven by it.
            raise FloatingPointError("its actions are no longer finite")
        c = self.config.learner
        self._drawn = equations.correlated(self._drawn, c.exploration_correlation, self.exploration)
        noise = equations.exploration_noise(
            self._exploration_std(), c.exploration_bound, self._drawn
        )
        return np.clip(action + noise, -1.0, 1.0)

    def _exploration_std(self) -> float:
        c = self.config.learner
        left = max(0.0, 1.0 - self.progress / c.exploration_share)
        return c.exploration_final + (c.exploration_initial - c.exploration_final) * left

    def _penalises(self, intervention: Intervention | None) -> bool:
        """Whether an intervention begins that the policy is to be penalised for (eq. 17)."""
        row = self.algorithm
        if intervention is None or not intervention.first or not row.penalty:
            return False
        if intervention.reason == ASKED:  # That is no objection.
            return False
        return intervention.reason != STUCK or self.config.penalise_stuck or not row.rewarded

    def _shape(self, reward: float, intervention: Intervention | None) -> float:
        """Eq. 17 as it is printed, unless the overruled action has the penalty."""
        c = self.config.learner
        if not self.algorithm.rewarded:
            reward = 0.0
        if c.penalty_on != HUMANS_ACTION or not self._penalises(intervention):
            return reward
        return equations.shaped_reward(reward, c.intervention_penalty, True, False)

    def _beta(self) -> float:
        """Eq. 15's exponent: zero at the end of the run, or where its weights are not used."""
        c = self.config.learner
        return c.beta * (1.0 - self.progress) if c.importance_sampling else 0.0

    def _validate(self, metrics: EpisodeMetrics, at_end: bool) -> None:
        """Judge the policy where that is due, and keep it if it is the best one."""
        if self.config.evaluate_every_steps and (at_end or self._due(metrics.steps)):
            self.validation.judge(metrics, self.episode, self._due(metrics.steps))

    def _due(self, last_steps: int) -> bool:
        """Whether a run that is never stopped validates now, too, after an episode of so many."""
        every = self.config.evaluate_every_steps
        return self.over or self.steps // every > (self.steps - last_steps) // every
