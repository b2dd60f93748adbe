"""Pedals, and whole episodes."""

import numpy as np

FULL, NOTHING, BRAKE = (np.array([pedal], np.float32) for pedal in (1.0, 0.0, -1.0))


def episode(env, driver, seed=None):
    """The action, reward and info of each step with a driver, a function of the picture or one
    action throughout; without a seed it begins where the car is."""
    act = getattr(driver, "act", driver if callable(driver) else lambda _: driver)
    observation = env.frames if seed is None else env.reset(seed=seed)[0]
    ended = False
    while not ended:
        action = act(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        assert terminated == (info.get("outcome") in ("goal", "collision", "off_road"))
        ended = terminated or truncated
        yield action, reward, info


def drive(env, driver, seed=0):
    """The rewards of an episode, and its last info."""
    _, rewards, infos = zip(*episode(env, driver, seed), strict=True)
    return list(rewards), infos[-1]
