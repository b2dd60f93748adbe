"""The rig's own simulator: states at the control rate, and whatever else a row puts between."""

from __future__ import annotations

import threading
import time

import numpy as np

from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE, State, encode
from hil_tests.faults.probe import Probe

SESSION = "campaign"


def make_state(step: int, seed: int = 0, **changes: object) -> State:
    """A valid state with a picture of noise below half brightness."""
    generator = np.random.default_rng((seed, step))
    fields: dict = {
        "session": SESSION,
        "episode": 0,
        "step": step,
        "sim_time_s": round(step * CONTROL_PERIOD_S, 6),
        "sent_ns": time.time_ns(),
        "frames": generator.integers(0, 120, FRAMES_SHAPE, dtype=np.uint8).tobytes(),
        "speed_mps": 3.0,
        "final": False,
    }
    return State(**{**fields, **changes})


class Sender:
    """Sends step after step at absolute ticks until it is stopped."""

    def __init__(self, probe: Probe) -> None:
        self.step = 0
        self.running = threading.Event()
        self.running.set()
        self._probe = probe
        self._stopping = threading.Event()
        self.lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, state: State) -> None:
        """Send one acceptable state and remember it as such. Hold ``lock`` to keep the order."""
        payload = encode(state)
        self._probe.note_state(payload, time.monotonic())
        self._probe.put("state", payload)

    def send_next(self) -> None:
        """Send the next step now."""
        with self.lock:
            self.step += 1
            self.send(make_state(self.step))

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopping.wait(max(0.0, next_s - time.monotonic())):
            next_s = max(next_s + CONTROL_PERIOD_S, time.monotonic())
            if self.running.is_set():
                self.send_next()
