"""The store: whole results or none, and one process at a time."""

import json
import multiprocessing
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from edge_runtime.errors import UserError
from trainer.conditions import CONDITIONS
from trainer.experiments import store as store_module
from trainer.experiments.store import BEGUN, DONE, IMPOSSIBLE, MISSING, RUNNING
from trainer.experiments.work import BUSY, Task, compute
from trainer.tests.experiments import GUIDED, UNIT, store_in, write_human

FILES = {
    "config.json": b"{}\n",
    "metrics.csv": b"episode\n0\n",
    "tests.json": json.dumps({condition: {} for condition in CONDITIONS}).encode(),
}
SPAWN = multiprocessing.get_context("spawn")


def contents(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def test_a_unit_goes_from_missing_over_begun_to_done(tmp_path):
    store = store_in(tmp_path)
    assert store.state(UNIT) == MISSING
    with store.lock(UNIT):
        assert store.state(UNIT) == RUNNING  # elsewhere: without a working directory here
    assert store.state(UNIT) == MISSING
    store.run_dir(UNIT).mkdir(parents=True)
    assert store.state(UNIT) == MISSING
    (store.run_dir(UNIT) / "metrics.csv").write_text("episode\n0\n")
    assert store.state(UNIT) == BEGUN
    with store.lock(UNIT) as free:
        assert free
        assert store.state(UNIT) == RUNNING
    assert store.state(UNIT) == BEGUN
    store.put(UNIT, FILES)
    assert store.state(UNIT) == DONE
    assert contents(store.result_dir(UNIT)) == FILES


def test_a_guided_unit_without_a_human_is_impossible_until_there_is_one(tmp_path):
    store = store_in(tmp_path)
    assert store.state(GUIDED) == IMPOSSIBLE
    write_human(store)
    assert store.state(GUIDED) == MISSING


def test_a_result_is_found_by_another_store_on_the_same_directory(tmp_path):
    store_in(tmp_path).put(UNIT, FILES)
    moved = replace(store_in(tmp_path), runs=tmp_path / "other runs", humans=tmp_path / "others")
    assert moved.done(UNIT)
    assert not moved.done(replace(UNIT, seed=2))


def test_a_result_without_a_condition_that_came_later_is_replaced_as_a_whole(tmp_path):
    store = store_in(tmp_path)
    first, *_ = CONDITIONS
    store.put(UNIT, {**FILES, "tests.json": json.dumps({first: {}}).encode()})
    assert not store.done(UNIT)
    store.put(UNIT, FILES)
    assert store.done(UNIT)
    assert [p.name for p in store.result_dir(UNIT).parent.iterdir()] == [
        store.result_dir(UNIT).name
    ]


def test_a_result_from_before_the_dense_scene_stays_valid(tmp_path):
    store = store_in(tmp_path)
    tests = {condition: {} for condition in ("nominal", "noise", "variant")}
    store.put(UNIT, {**FILES, "tests.json": json.dumps(tests).encode()})
    assert store.done(UNIT)


def die_while_writing(store, after: int) -> None:
    """Put a result and die without a word before file number ``after``, or before the rename."""
    write, count = store_module.write_atomic, 0

    def write_or_die(path, data):
        nonlocal count
        if count == after:
            os._exit(9)
        count += 1
        write(path, data)

    store_module.write_atomic = write_or_die
    if after == len(FILES):
        type(store.results).rename = lambda self, target: os._exit(9)
    store.put(UNIT, FILES)


@pytest.mark.parametrize("after", [0, 2, 3])
def test_a_kill_in_mid_write_leaves_no_result_and_no_obstacle(tmp_path, after, monkeypatch):
    store = store_in(tmp_path)
    process = SPAWN.Process(target=die_while_writing, args=(store, after))
    process.start()
    process.join()
    assert process.exitcode == 9
    assert not store.done(UNIT)
    monkeypatch.setattr(store_module, "_ABANDONED_S", -1.0)
    store.put(UNIT, FILES)
    place = store.result_dir(UNIT)
    assert [p.name for p in place.parent.iterdir()] == [place.name]
    assert contents(place) == FILES


def test_a_broken_result_is_said_in_one_line(tmp_path):
    store = store_in(tmp_path)
    store.put(UNIT, {**FILES, "tests.json": b"{"})
    with pytest.raises(UserError, match=r"tests\.json is broken"):
        store.done(UNIT)


def hold(store, ready) -> None:
    with store.lock(UNIT) as free:
        ready.send(free)
        time.sleep(60.0)


def test_who_wants_to_work_outwaits_a_look(tmp_path):
    """``state`` takes the lock for a moment; who begins just then must not be sent away."""
    store = store_in(tmp_path)
    with ThreadPoolExecutor() as pool:
        with store.lock(UNIT):
            patient = pool.submit(_lock_once, store, 30.0)
            assert not pool.submit(_lock_once, store, 0.05).result()
        assert patient.result()


def _lock_once(store, patience_s):
    with store.lock(UNIT, patience_s) as free:
        return free


def test_a_lock_holds_others_off_and_falls_with_its_process(tmp_path):
    store = store_in(tmp_path)
    told, ready = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=hold, args=(store, ready))
    process.start()
    assert told.recv() is True
    with store.lock(UNIT) as free:
        assert not free
    assert store.holder(UNIT).startswith(f"process {process.pid} on ")
    assert compute(Task(UNIT, store), lambda episodes: None) == BUSY
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with store.lock(UNIT) as free:
        assert free
    with store.lock(UNIT) as free:
        assert free, "it is given back"
