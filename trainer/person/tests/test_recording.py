import mmap
import os
import random
import resource
import signal
import struct
import time
from contextlib import suppress
from itertools import count
from typing import cast

import msgspec
import pytest
from msgspec import structs

from bridge.tests.recordings import flip_chunk
from edge_runtime.util import UserError
from hil_tests.processes import wait_until
from trainer.person import recording
from trainer.person.recording import Recorder, read_steps
from trainer.person.tests.people import record, recorded_step


def test_a_file_cut_anywhere_holds_every_step_before_the_cut(tmp_path):
    recorder, ends = Recorder(tmp_path / "whole"), []
    for index in range(6):
        recorder.write(recorded_step(1, index))
        ends.append(recorder.path.stat().st_size)
    recorder.close()
    data, cut = recorder.path.read_bytes(), tmp_path / "cut.mcap"
    for length in [*range(9, len(data), 311), *ends, len(data) - 1]:
        cut.write_bytes(data[:length])
        indices = [step.index for step in read_steps(cut)]
        flushed = sum(end <= length for end in ends)
        # The cut may lie in what follows a step's chunk: then that step is whole, too.
        assert indices in (list(range(flushed)), list(range(flushed + 1)))


@pytest.mark.parametrize("damaged", range(3))
def test_a_flipped_bit_costs_the_episode_it_is_in_and_is_said(tmp_path, capsys, damaged):
    steps = [
        recorded_step(1, 3 * episode + step, step=step, terminated=step == 2)
        for episode in range(3)
        for step in range(3)
    ]
    path = record(tmp_path, steps)
    flip_chunk(path, 3 + damaged)
    assert [step.index for step in read_steps(path)] == [0, 1, 2, 6, 7, 8]
    assert "1 damaged place" in capsys.readouterr().err


def test_steps_of_another_version_are_refused_and_not_taken_for_a_torn_end(tmp_path):
    class Older(msgspec.Struct):
        time_ns: int = 1

    path = record(tmp_path, [cast(recording.RecordedStep, Older())])
    with pytest.raises(UserError, match="recorded by another version: Object missing"):
        list(read_steps(path))


def test_what_was_kept_before_the_disk_was_full_stays(tmp_path):
    recorder, step = Recorder(tmp_path), recorded_step(1, 0)
    recorder.write(step)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (recorder.path.stat().st_size + 500, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            recorder.write(recorded_step(1, 1))
        with suppress(OSError):
            recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(read_steps(recorder.path)) == [step]


@pytest.mark.parametrize(("position", "left"), [((1, 0), 5), ((1, 2), 3), ((2, 0), 2), ((3, 0), 0)])
def test_only_what_came_after_the_checkpoint(tmp_path, position, left):
    for sitting, steps in ((1, 3), (2, 2)):
        record(tmp_path, [recorded_step(sitting, index) for index in range(steps)])
    (tmp_path / "sitting-0003.mcap").touch()  # A power cut just after its beginning.
    assert len(recording.find_recordings([tmp_path])) == 2
    assert len(list(recording.steps_since(tmp_path, position))) == left


COUNT = struct.Struct("<Q")
STEP = recorded_step(1, 0)


@pytest.mark.parametrize("seed", range(2))
def test_no_step_that_was_kept_is_lost(tmp_path, seed):
    """Killed while it records as quickly as it can; ``kept`` counts what the recorder took."""
    kept = mmap.mmap(-1, COUNT.size)
    child = os.fork()
    if child == 0:
        try:
            recorder = Recorder(tmp_path)
            for number in count():
                recorder.write(structs.replace(STEP, index=number, step=number))
                COUNT.pack_into(kept, 0, recorder.index)
        finally:
            os._exit(1)
    wait_until(lambda: COUNT.unpack_from(kept)[0] > 0, "a step")
    time.sleep(random.Random(seed).uniform(0.0, 0.05))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    (taken,) = COUNT.unpack_from(kept)
    steps = [step.step for step in read_steps(tmp_path / "sitting-0001.mcap")]
    assert steps in (list(range(taken)), list(range(taken + 1)))
