"""Controllers, and states answered at made-up times, for the tests."""

from __future__ import annotations

import numpy as np

from edge_runtime.controller import Controller, Received
from edge_runtime.limiter import limit_rows
from edge_runtime.tests.harness import make_state
from edge_runtime.tests.policies import PEDAL

GOOD = np.array([0.5], np.float32)
QUICK_NS = 1_000_000


def make(needs_rearm=False, actions=(PEDAL,), **options):
    return Controller(limit_rows(actions, {}), needs_rearm, **options)


def answer(controller, step, now_s, output=GOOD, **changes):
    controller.begin(Received(make_state(step, **changes), now_s, 0), now_s)
    return controller.finish(output, QUICK_NS, now_s + 0.001)


def stop(controller):
    answer(controller, 0, 0.0)
    controller.tick(0.3)
    return controller
