"""A training run on a scripted road, with a scripted human and a learner that only listens."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces

from trainer.human.guide import Intervention
from trainer.learner.config import LearnerConfig
from trainer.learner.td3 import Losses
from trainer.training.config import RunConfig
from trainer.training.run import TrainingRun

POLICY, HUMAN = 0.25, -0.5
BATCH = 4
LEARNER = LearnerConfig(
    batch_size=BATCH, replay_capacity=100, warmup_steps=1, exploration_initial=0.0,
    exploration_final=0.0, intervention_penalty=-7.0,
)  # fmt: skip
CONFIG = RunConfig(episodes=1, evaluate_every_steps=0, checkpoint_every=1000, learner=LEARNER)


class ScriptedEnv:
    """Step n of an episode is rewarded with n and shows pictures of the grey value n."""

    scenario = "left_turn"
    config = SimpleNamespace(control_period_s=0.1)
    observation_space = spaces.Box(0, 255, (2, 45, 80), np.uint8)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    brake_action = np.array([0.0], np.float32)

    def __init__(self, length, outcome):
        self.length, self.outcome, self.steps = length, outcome, 0
        self.actions, self.braked, self.braking = [], [], False

    def press_brake(self, pressed):
        self.braking = pressed

    def reset(self, *, seed=None):
        self.steps = 0
        return self._observation(), {"distance_m": 0.0}

    def step(self, action):
        self.steps += 1
        self.actions.append(float(action[0]))
        self.braked.append(self.braking)
        accelerations = ("lateral_acceleration_mps2", "longitudinal_acceleration_mps2")
        info = {"distance_m": float(self.steps), **dict.fromkeys(accelerations, 0.0)}
        ended, timeout = self.steps == self.length, self.outcome == "timeout"
        if ended:
            info["outcome"] = self.outcome
        ends = ended and not timeout, ended and timeout
        return self._observation(), float(self.steps), *ends, info

    def _observation(self):
        return np.full((2, 45, 80), self.steps, np.uint8)


class ScriptedGuide:
    """Acts at the given steps of each episode, counted from one."""

    def __init__(self, run, human_steps, reason):
        self.run, self.human_steps, self.reason = run, human_steps, reason
        self.asked, self.resets = [], 0

    def reset(self):
        self.resets += 1

    def watch(self, observation, action):
        self.asked.append(self.run.episode)
        step = self.run.env.steps + 1
        if step not in self.human_steps:
            return None
        first = step - 1 not in self.human_steps
        return Intervention(np.array([HUMAN], np.float32), self.reason, first)


def scripted_run(run_dir, config, length=1, outcome="goal", human_steps=(), reason="collision"):
    """A run that also keeps what it ``stored``, the ``betas`` and the priorities it was given
    (``learned``) and wrote back (``written``); each of the last two as (indices, priorities).
    """
    run: Any = TrainingRun(config, run_dir)
    run.env = ScriptedEnv(length, outcome)
    run.guide = ScriptedGuide(run, human_steps, reason)
    for kept in ("stored", "betas", "learned", "written", "guidance_stored"):
        setattr(run, kept, [])
    replay, learner = run.learning.replay, run.learning.learner
    add, write = replay.add, replay.update_priorities

    def spy_add(action, reward, next_frames, terminal, human, **guidance):
        assert next_frames[1, 0, 0] == run.env.steps
        run.stored.append((float(action[0]), reward, terminal, human))
        run.guidance_stored.append((float(guidance["overruled"][0]), guidance["penalised"]))
        add(action, reward, next_frames, terminal, human, **guidance)

    def spy_write(indices, priorities):
        # The buffer itself writes one at a time.
        if len(indices) == BATCH:
            run.written.append((indices.tolist(), priorities.tolist()))
        write(indices, priorities)

    def update(batch, beta):
        priorities = 2.0 + len(run.betas) + np.arange(BATCH) / 8
        run.betas.append(beta)
        run.learned.append((batch.indices.tolist(), priorities.tolist()))
        return Losses(0.0, 0.0, 0.0, 0.0, priorities)

    replay.add, replay.update_priorities = spy_add, spy_write
    learner.act = lambda observation: np.array([POLICY], np.float32)
    learner.update = update
    return run
