"""Pedals, and a driver who knows only one of them."""

import numpy as np

FULL, NOTHING, BRAKE = (np.array([pedal], np.float32) for pedal in (1.0, 0.0, -1.0))


class Brakes:
    resets = 0

    def reset(self):
        self.resets += 1

    def act(self, observation):
        return BRAKE
