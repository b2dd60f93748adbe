"""One training run: algorithm 1 around an environment, a guide, a learner and a validator."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from bridge.environments import finite, say_once
from bridge.network import parse_spec
from bridge.outcomes import DISCARDED, GOAL, is_told, success_share
from bridge.report import EpisodeResult
from edge_runtime.files import write_json
from edge_runtime.util import UserError
from trainer import environments, evaluation, util
from trainer.environments import DelayedVehicle
from trainer.evaluation import BEST_FILE, CHECKPOINT_FILE, NO_NETWORK, TogetherDriver
from trainer.human.guide import (
    ASKED,
    STUCK,
    Asking,
    Attention,
    Guide,
    GuideGone,
    HumanGuide,
    Intervention,
    PoorHands,
    Record,
    steps_held,
)
from trainer.learner import equations
from trainer.learner.config import find_algorithm
from trainer.learner.networks import Actor
from trainer.learner.replay import Action, Observation, Transition
from trainer.person import PERSON
from trainer.scenarios import SCENARIOS
from trainer.training.config import CONFIG_FILE, RANDOM, TAKEOVERS, RunConfig
from trainer.training.demonstrations import (
    SCRIPTED,
    Episode,
    drive_demonstrations,
    read_demonstrations,
)
from trainer.training.learning import LearningThread, diverged
from trainer.training.metrics import EpisodeMetrics, MetricsWriter


def environment_of(config: RunConfig) -> Any:
    return environments.make_environment(
        config.scenario,
        printed_reward=config.printed_reward,
        period_s=config.period_s,
        success=config.success,
    )


Score = tuple[float, float]
"""Share of successes and mean return, which decides between equal shares."""


def score(drives: Sequence[EpisodeResult]) -> Score:
    success = float(np.mean([drive.outcome == GOAL for drive in drives]))
    return success, float(np.mean([drive.reward for drive in drives]))


class Trials:
    """Drives the validation's episodes with a policy alone, over the run's network.

    ``env`` is the run's own, reused because some simulators allow only one in a process.
    """

    def __init__(self, config: RunConfig, env: Any = None) -> None:
        self.config, self.network, self._env = config, parse_spec(config.latency), env
        count = config.evaluation_runs
        seeds = [
            util.episode_seed(config.seed, util.Purpose.VALIDATION, run)
            for run in range(count * (1 + config.confirmation_factor))
        ]
        self._seeds, self._confirming = seeds[:count], seeds[count:]

    @cached_property
    def envs(self) -> list[Any]:
        """Environments driven at once: one a seed for our scenarios, else a single one."""
        c = self.config
        if c.scenario in SCENARIOS:
            return [environment_of(c) for _ in self._seeds]
        return [self._env or environment_of(c)]

    def drive(self, driver: TogetherDriver, best: Score) -> list[EpisodeResult]:
        """Drive a validation; if its score is at least ``best``, also drive the second set."""
        drives = self._drive(driver, self._seeds)
        if self._confirming and score(drives) >= best:
            drives += self._drive(driver, self._confirming)
        return drives

    def _drive(self, driver: TogetherDriver, seeds: Sequence[int]) -> list[EpisodeResult]:
        if self.network == NO_NETWORK:
            return evaluation.drive_together(self.envs, driver.act_together, seeds)
        return evaluation.drive_episodes(self.envs[0], driver, seeds, latency=self.network)


class Validation(Trials):
    """Validates the present policy, and keeps the best actor so far.

    The best of many validations overestimates its actor. So an actor that does no worse than the
    kept one drives a second, larger set of episodes, and replaces the kept one if it does no worse
    there, either.
    """

    def __init__(
        self, config: RunConfig, run_dir: Path, learning: LearningThread, env: Any = None
    ) -> None:
        super().__init__(config, env)
        self.run_dir, self.learning = run_dir, learning
        self.best = self.confirmed = (-1.0, -math.inf)
        """The kept actor's scores in both sets."""
        self._best_actor: dict[str, Any] | None = None  # As in its file; None before the first one

    def after(self, metrics: EpisodeMetrics, episode: int, due: bool, at_end: bool) -> None:
        """Validate after ``episode`` episodes if ``due``.

        Stopping (``at_end``) adds no validation: it must not change which actor a run keeps.
        """
        if due:
            actor = getattr(self.learning.learner, self.config.kept_actor)
            driver = TogetherDriver(partial(self.learning.in_thread, actor.act))
            self.take(self.drive(driver, self.best), actor, metrics, episode)

    def take(
        self, results: Sequence[EpisodeResult], actor: Actor, metrics: EpisodeMetrics, episode: int
    ) -> None:
        """Write an actor's results to ``metrics``, and keep the actor if it is the best."""
        count = self.config.evaluation_runs
        results, confirming = results[:count], results[count:]
        validated = _, metrics.validation_reward = score(results)
        metrics.validation_success = success_share(result.outcome for result in results)
        metrics.validation_distance_m = float(np.mean([result.distance_m for result in results]))
        confirmed = validated
        if confirming:
            confirmed = _, metrics.confirmed_reward = score(confirming)
            metrics.confirmed_success = success_share(result.outcome for result in confirming)
        elif self.config.confirmation_factor:
            return
        if validated >= self.best and confirmed >= self.confirmed:
            self.best, self.confirmed = validated, confirmed
            state = {**self.config.label(episode), "actor": actor.state_dict()}
            self._best_actor = copy.deepcopy(state)
            util.save_torch(self.run_dir / BEST_FILE, state)

    def state_dict(self) -> dict[str, Any]:
        scores = {"best_validation": self.best, "best_confirmed": self.confirmed}
        return {**scores, "best_actor": self._best_actor}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``, and write its best actor's file again."""
        scores = (map(float, state[f"best_{name}"]) for name in ("validation", "confirmed"))
        self.best, self.confirmed = ((success, reward) for success, reward in scores)
        self._best_actor = state["best_actor"]
        if self._best_actor is not None:
            util.save_torch(self.run_dir / BEST_FILE, self._best_actor)


NOBODY = Guide()
UNPAID = "holds no rewards: each of its steps counts as 0 (cloning_only needs none)"


def make_guide(config: RunConfig, env: Any) -> Guide:
    """Make the human that a run's config describes."""
    row = find_algorithm(config.algorithm)
    random = util.random_stream(config.seed, util.Purpose.GUIDANCE)
    if not row.guided:
        return Guide()
    driver, _ = evaluation.load_driver(config.human, env)
    expert_name = config.human if evaluation.is_expert(config.human) else "expert"
    expert = environments.expert_of(env, expert_name)
    attention, hands, period_s = None, None, env.control_period_s
    if config.late_to_s or config.missed_share:
        late_steps = config.late_from_s / period_s, config.late_to_s / period_s
        attention = Attention(late_steps, config.missed_share, random)
    if config.poor_guidance_share:
        biased = None if config.poor_guidance == RANDOM else env.biased_action
        whole = config.poor_guidance == TAKEOVERS
        hands = PoorHands(config.poor_guidance_share, biased, random, whole)
    asking = Asking(row.asks) if row.asks else None
    return HumanGuide(driver, expert, steps_held(period_s), attention, asking, hands, random)


def demonstrations_of(config: RunConfig, env: Any) -> Iterator[Episode]:
    """Yield the episodes that fill a run's replay before its first step."""
    if scripted := SCRIPTED.fullmatch(config.demonstrations):
        human = "expert" if config.human == PERSON else config.human
        driver, _ = evaluation.load_driver(human, env)
        return drive_demonstrations(driver, env, config.seed, int(scripted[1]))
    return read_demonstrations(Path(config.demonstrations), env)


class TrainingRun:
    """Trains for some episodes; settings, metrics, checkpoint and best actor go to ``run_dir``."""

    def __init__(
        self,
        config: RunConfig,
        run_dir: Path,
        resume: bool = False,
        env: Any = None,
        guide: Guide | None = None,
        learning: LearningThread | None = None,
        validation: Validation | None = None,
    ) -> None:
        """Make the parts that are not given as the config describes them."""
        self.config, self.run_dir = config, run_dir
        self.algorithm = find_algorithm(config.algorithm)
        self.env = env or environment_of(config)  # Copied for look-ahead
        if self.algorithm.foresight:
            environments.check_foresight(self.env)
        network = parse_spec(config.latency)
        self.delayed = None if network == NO_NETWORK else DelayedVehicle(self.env, network)
        self.vehicle: Any = self.delayed or self.env  # The environment that the loop steps
        self.learning = learning or LearningThread(config, self.env)
        self.guide = guide or make_guide(config, self.env)
        self.validation = validation or Validation(config, run_dir, self.learning, self.env)
        self.recorders: list[Record] = []
        self.act = self.delayed.behind(self._explore) if self.delayed else self._explore
        self.exploration = util.random_stream(config.seed, util.Purpose.EXPLORATION)
        self.episode = self.steps = 0
        """Episodes driven, and environment steps in those that a person has not discarded."""
        self.quitting = False  # End ``train`` after the episode under way
        self.search_is_over = False
        """An episode without search or half a validation succeeded, or the first did not tell."""
        self._shown_steps = 0  # Human steps in demonstrations; the first episode's row counts them
        if resume:
            path = run_dir / CHECKPOINT_FILE
            with util.fitting(f"{path} does not fit this run"):
                self._restore(util.load_torch(path))
        elif config.demonstrations:
            paid = False
            for episode in demonstrations_of(config, self.env):
                for transition in episode:
                    self.learning.add(transition)
                    self._shown_steps += transition.human
                    paid |= transition.reward != 0.0
                self.learning.release()
            if not self.learning.replay.added:
                raise UserError(f"{config.demonstrations} shows no step")
            if not paid and self.algorithm.rewarded and self.algorithm.q_term:
                say_once(f"{config.demonstrations} {UNPAID}")

    def train(
        self,
        on_episode: Callable[[EpisodeMetrics], None] = lambda metrics: None,
        deadline_s: float = math.inf,
    ) -> None:
        """Train until the configured end, or ``time.monotonic() > deadline_s``; call it once."""
        if not self.over:  # A finished run keeps the revision that trained it.
            about = {**asdict(self.config), "source_revision": util.source_revision()}
            write_json(self.run_dir / CONFIG_FILE, about)
        metrics_writer = MetricsWriter(self.run_dir, self.episode, self.env.control_period_s)
        try:
            while not self.over:
                before = self.steps
                metrics = self.advance()
                at_end = self.over or self.guide.stop or time.monotonic() > deadline_s
                self.validation.after(metrics, self.episode, self._due(before), at_end)
                self.search_is_over |= metrics.validation_success >= 0.5
                metrics_writer.add(metrics)
                ending = at_end or self.quitting  # Read once: a signal may change it.
                if ending or self.episode % self.config.checkpoint_every == 0:
                    self.save()
                on_episode(metrics)
                if ending:
                    break
        except GuideGone:
            self.save()
        finally:
            metrics_writer.close()
            self.learning.close()

    def advance(self) -> EpisodeMetrics:
        """Train one episode, without validation and checkpoint; UserError where it diverges."""
        metrics = self._episode()
        self.learning.check_weights()
        succeeded = metrics.outcome == GOAL and not self._searching
        untold = self.episode == 0 and not is_told([metrics.outcome])
        self.search_is_over |= succeeded or untold
        self.episode += 1
        self.steps = metrics.total_steps
        if self.over:
            self.learning.end_run()
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

    def save(self) -> None:
        state = {
            **self.config.label(self.episode),
            **self.guide.state_dict(),
            "learning": self.learning.state_dict(),
            "steps": self.steps,
            "kept_actor": self.config.kept_actor,
            "exploration": self.exploration.bit_generator.state,
            "found": self.search_is_over,
            **self.validation.state_dict(),
        }
        util.save_torch(self.run_dir / CHECKPOINT_FILE, state)

    def _restore(self, state: dict[str, Any]) -> None:
        counts = [state["episode"], state["steps"], state["learning"]["learner"]["updates"]]
        self.episode, self.steps, _ = msgspec.convert(counts, list[Annotated[int, Meta(ge=0)]])
        self.learning.load_state_dict(state["learning"])
        self.exploration.bit_generator.state = state["exploration"]
        self.search_is_over = state["found"]
        self.guide.load_state_dict(state)
        self.validation.load_state_dict(state)

    def _episode(self) -> EpisodeMetrics:
        config = self.config
        metrics = EpisodeMetrics(self.episode, human_steps=self._shown_steps)
        self._shown_steps = 0
        seed = util.episode_seed(config.seed, util.Purpose.TRAINING, self.episode)
        observation, info = self.vehicle.reset(seed=seed)
        self._noise = np.zeros(self.env.action_space.shape)
        guide = self.guide if config.guided(self.episode) else NOBODY
        self.guide.reset()
        ended = False
        while not ended:
            observation, ended, info = self._step(observation, guide, metrics)
        outcome = self.guide.end_episode(info["outcome"])
        kept = outcome != DISCARDED
        learned = self.learning.end_episode(self.progress, kept)
        return replace(
            metrics,
            total_steps=self.steps + metrics.steps * kept,
            updates=self.learning.learner.updates,
            episode_return=float(metrics.episode_return),
            distance_m=finite("distance_m", info["distance_m"]),
            outcome=outcome,
            exploration_std=self._exploration_std(),
            **learned,
        )

    def _step(
        self, observation: Observation, guide: Guide, metrics: EpisodeMetrics
    ) -> tuple[Observation, bool, dict[str, Any]]:
        """Drive one control period (policy, human, environment) while the learner updates."""
        began_s = time.perf_counter()
        policy_action = self.act(observation)
        asks = self.algorithm.asks and guide is not NOBODY
        doubt = self.learning.doubt(observation, policy_action) if asks else 0.0
        acted_s = time.perf_counter()
        if self.learning.replay.added >= self.config.learner.warmup_steps:
            self.learning.begin(self._beta())
        begun_s = time.perf_counter()
        intervention = guide.watch(observation, policy_action, doubt)
        human_action = None if intervention is None else intervention.action
        action = equations.masked_action(policy_action, human_action)
        foreseen: list[Observation] = []
        if intervention is not None and self.delayed:
            self.delayed.release_brake()
        if intervention is not None and self.algorithm.foresight:
            foreseen = environments.foresee(
                self.env, observation, policy_action, self.algorithm.foresight
            )
        next_observation, reward, terminated, truncated, info = self.vehicle.step(action)
        moved_s = time.perf_counter()
        waited_s = self.learning.finish()
        transition = Transition(
            observation, action, reward, next_observation, terminated, truncated,
            intervention is not None, policy_action, self.penalises(intervention), tuple(foreseen),
        )  # fmt: skip
        self.learning.add(transition)
        stored_s = time.perf_counter()
        metrics.steps += 1
        metrics.episode_return += reward
        metrics.human_steps += intervention is not None
        metrics.interventions += intervention is not None and intervention.first
        metrics.acting_s += acted_s - began_s
        metrics.environment_s += moved_s - begun_s
        metrics.storing_s += begun_s - acted_s + stored_s - moved_s - waited_s
        for record in self.recorders:
            record(transition, intervention, info)
        return next_observation, terminated or truncated, info

    def penalises(self, intervention: Intervention | None) -> bool:
        """Return whether a penalised intervention begins (eq. 17).

        Help that the robot asked for is not penalised. Nor, if rewards count, is freeing a stuck
        car: it looks like one that rightly waits, and a penalty would teach never to wait.
        """
        row = self.algorithm
        if intervention is None or not intervention.first or not row.penalty:
            return False
        return intervention.reason != ASKED and (intervention.reason != STUCK or not row.rewarded)

    def _explore(self, observation: Observation) -> Action:
        action = self.learning.act(observation)
        if not np.isfinite(action).all():  # Never drive a car with them.
            raise diverged("actions")
        c, std = self.config.learner, self._exploration_std()
        bound = math.inf if self._searching else c.exploration_bound
        self._noise = equations.correlated(self._noise, c.exploration_correlation, self.exploration)
        noise = equations.exploration_noise(std, bound, self._noise)
        return np.clip(action + noise, -1.0, 1.0)

    @property
    def _searching(self) -> bool:
        """Whether this episode searches: every other one does, until ``search_is_over``."""
        searches = bool(self.config.learner.exploration_searching)
        return searches and not self.search_is_over and self.episode % 2 == 0

    def _exploration_std(self) -> float:
        c = self.config.learner
        if self._searching:
            return c.exploration_searching
        left = max(0.0, 1.0 - self.progress / c.exploration_share)
        return c.exploration_final + (c.exploration_initial - c.exploration_final) * left

    def _beta(self) -> float:
        """Return eq. 15's exponent, which falls to zero; zero if importance weights are off."""
        c = self.config.learner
        return c.beta * (1.0 - self.progress) if c.importance_sampling else 0.0

    def _due(self, steps_before: int) -> bool:
        """Return whether a validation is due, no matter where the run was stopped before."""
        every = self.config.evaluate_every_steps
        return bool(every) and (self.over or self.steps // every > steps_before // every)
