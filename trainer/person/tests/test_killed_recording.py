"""A recorder killed at random moments: what it has kept, it has kept."""

from __future__ import annotations

import mmap
import os
import random
import signal
import struct
import time

import pytest

from trainer.person.recording import Recorder, read_steps
from trainer.person.tests.steps import recorded_step

COUNT = struct.Struct("<Q")
STEPS = [recorded_step(1, 0), recorded_step(1, 1)]


def record_for_ever(directory, kept: mmap.mmap) -> None:
    """What a drive does, as quickly as it can; ``kept`` counts what the recorder has taken."""
    recorder, step = Recorder(directory), STEPS[0]
    while True:
        for step in STEPS:
            recorder.write(step)
            COUNT.pack_into(kept, 0, recorder.index)


@pytest.mark.parametrize("seed", range(8))
def test_no_step_that_was_kept_is_lost(tmp_path, seed):
    kept = mmap.mmap(-1, COUNT.size)
    child = os.fork()
    if child == 0:
        try:
            record_for_ever(tmp_path, kept)
        finally:
            os._exit(1)
    deadline_s = time.monotonic() + 30.0
    while COUNT.unpack_from(kept)[0] == 0 and time.monotonic() < deadline_s:
        time.sleep(0.001)
    time.sleep(random.Random(seed).uniform(0.0, 0.05))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    (count,) = COUNT.unpack_from(kept)
    steps = list(read_steps(tmp_path / "sitting-0001.mcap"))
    assert count > 0
    assert len(steps) in (count, count + 1)
    assert steps == [STEPS[number % 2] for number in range(len(steps))]
