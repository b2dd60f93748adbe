"""Pedals, a driver that knows only one of them, whole episodes, and whether a human objects."""

import numpy as np

from bridge.report import GOAL
from trainer.drivers import EXPERTS, TRIGGERS

FULL, NOTHING, BRAKE = (np.array([pedal], np.float32) for pedal in (1.0, 0.0, -1.0))


class Brakes:
    resets = 0

    def reset(self):
        self.resets += 1

    def act(self, observation):
        return BRAKE


def drive(env, driver, seed=0):
    """An episode of a driver, or of one action throughout: its rewards, and the last info."""
    act = driver.act if hasattr(driver, "act") else lambda _: driver
    observation, info = env.reset(seed=seed)
    rewards, ended = [], False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        rewards.append(reward)
        assert terminated == (info.get("outcome") in ("goal", "collision", "off_road"))
        ended = terminated or truncated
    return rewards, info


def objections(env, driver, drives):
    """Drives with the seeds 0, 1, ...; how many arrived, and to how many of those it objected."""
    trigger = TRIGGERS[env.scenario](EXPERTS[env.scenario](env))
    arrived = objected = 0
    for seed in range(drives):
        observation, info = env.reset(seed=seed)
        driver.reset()
        trigger.reset()
        reasons = set()
        while "outcome" not in info:
            action = driver.act(observation)
            reasons.add(trigger.judge(action))
            observation, _, _, _, info = env.step(action)
        arrived += info["outcome"] == GOAL
        objected += info["outcome"] == GOAL and reasons != {None}
    return {"drives": drives, "arrived": arrived, "objected_of_these": objected}
