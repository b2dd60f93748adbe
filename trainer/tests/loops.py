"""The training loop on a scripted road, with a scripted human and a learner that only listens."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from trainer.human.guide import Guide, Intervention
from trainer.learner.config import LearnerConfig
from trainer.learner.replay import FRAMES_LAYOUT
from trainer.scenarios.left_turn import LeftTurnEnv
from trainer.training.config import RunConfig
from trainer.training.learning import LearningThread
from trainer.training.metrics import read_metrics
from trainer.training.run import TrainingRun, Validation

POLICY, HUMAN = 0.25, -0.5
BATCH = 4
LEARNER = LearnerConfig(
    batch_size=BATCH, replay_capacity=100, warmup_steps=1, exploration_initial=0.0,
    exploration_final=0.0, intervention_penalty=-7.0,
)  # fmt: skip
CONFIG = RunConfig(
    episodes=1,
    evaluate_every_steps=0,
    confirmation_factor=0,
    checkpoint_every=1000,
    learner=LEARNER,
)


def frames(step: int) -> np.ndarray:
    """Return the observation of a tick: the tick before and the tick, as grey values."""
    return np.stack([np.full((45, 80), max(n, 0), np.uint8) for n in (step - 1, step)])


def number(seen: np.ndarray) -> int:
    """Return the tick of an observation."""
    assert seen[1, 0, 0] - seen[0, 0, 0] in (0, 1)
    return int(seen[1, 0, 0])


class ScriptedEnv:
    """Step n of an episode is rewarded with n and shows pictures of the grey value n."""

    scenario = "left_turn"
    observation_space = spaces.Box(0, 255, (2, 45, 80), np.uint8)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    layout = FRAMES_LAYOUT
    rest_action, brake_action = np.array([[0.0], [-1.0]], np.float32)
    control_period_s = 0.1
    biased_action = LeftTurnEnv.biased_action

    def __init__(self, length: int = 1, outcome: str = "goal") -> None:
        self.length, self.outcome, self.steps = length, outcome, 0
        self.actions: list[float] = []
        self.braked: list[bool] = []
        self.braking = False

    def press_brake(self, pressed):
        self.braking = pressed

    def reset(self, *, seed=None):
        self.steps = 0
        return frames(0), {"distance_m": 0.0}

    def step(self, action):
        self.steps += 1
        self.actions.append(float(action[0]))
        self.braked.append(self.braking)
        info: dict[str, Any] = {"distance_m": float(self.steps), "speed_mps": 1.0}
        ended, timeout = self.steps == self.length, self.outcome == "timeout"
        if ended:
            info["outcome"] = self.outcome
        ends = ended and not timeout, ended and timeout
        return frames(self.steps), float(self.steps), *ends, info

    def close(self):
        """Nothing to close."""


class ScriptedGuide(Guide):
    """Acts at the given steps of each episode, counted from one."""

    def __init__(self, human_steps=(), reason: str = "collision") -> None:
        self.human_steps, self.reason = human_steps, reason

    def reset(self):
        self.step = 0

    def watch(self, observation, policy_action, doubt=0.0):
        self.step += 1
        if self.step not in self.human_steps:
            return None
        first = self.step - 1 not in self.human_steps
        return Intervention(np.array([HUMAN], np.float32), self.reason, first)


def scripted_run(run_dir, config=CONFIG, length=1, outcome="goal", human_steps=(),
                 reason="collision") -> Any:  # fmt: skip
    """A run that keeps what it ``stored``, and the (indices, priorities) that it was given
    (``learned``) and wrote back (``written``)."""
    env = ScriptedEnv(length, outcome)
    learning: Any = LearningThread(config, env)
    validation = Validation(config, run_dir, learning, env)
    guide = ScriptedGuide(human_steps, reason)
    run: Any = TrainingRun(config, run_dir, False, env, guide, learning, validation)
    run.stored, run.learned, run.written = [], [], []
    add, write = learning.replay.add, learning.replay.update_priorities

    def spy_add(transition):
        run.stored.append(transition)
        add(transition)

    def spy_write(indices, priorities):
        if len(indices) == BATCH:  # The buffer itself writes one at a time.
            run.written.append((indices.tolist(), priorities.tolist()))
        write(indices, priorities)

    def begin(batch, beta):
        priorities = 2.0 + len(run.learned) + np.arange(BATCH) / 8
        run.learned.append((batch.indices.tolist(), priorities.tolist()))
        return torch.tensor([0.0, 0.0, 0.0, 0.0, *priorities])

    learning.replay.add, learning.replay.update_priorities = spy_add, spy_write
    for actor in (learning.learner.actor, learning._acting):
        actor.act = lambda seen: np.full((len(seen), 1), POLICY, np.float32)
    learning.learner.begin = begin
    return run


def trained(directory, length=1, outcome="goal", human_steps=(), reason="collision", **changes):
    """A scripted run at its end, of a changed config, and what it ``told`` of its episodes."""
    learner = {name: changes.pop(name) for name in [*changes] if hasattr(LEARNER, name)}
    config = replace(CONFIG, **changes, learner=replace(LEARNER, **learner))
    run = scripted_run(directory, config, length, outcome, human_steps, reason)
    run.told = []
    run.save = lambda: None  # A checkpoint of 13 MB that nobody reads.
    run.train(run.told.append)
    return run


def rows_of(run: TrainingRun) -> list[dict[str, str]]:
    """Return the metrics of a run but for times, which are never the same."""
    return [
        {name: value for name, value in row.items() if not name.endswith("_s")}
        for row in read_metrics(run.run_dir)
    ]
