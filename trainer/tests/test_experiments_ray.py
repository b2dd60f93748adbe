"""Units on a Ray cluster of several nodes, all on this machine; ``make test-ray``."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest

from trainer.experiments import ray_runner
from trainer.experiments.ray_runner import compute_parcel, keep, pack, run_on_ray
from trainer.experiments.runner import FAILED
from trainer.experiments.store import DONE
from trainer.experiments.work import FINISHED, STOPPED, Task, compute
from trainer.tests.experiments import TINY, UNIT, Soon, store_in

UNITS = [replace(UNIT, seed=seed) for seed in (1, 2, 3)]


def in_this_process(store, units):
    for unit in units:
        assert compute(Task(unit, store), lambda episodes: None) == FINISHED
    return store


def same_results(store, other, units):
    for unit in units:
        for name in ("metrics.csv", "tests.json"):
            ours, theirs = (s.result_dir(unit) / name for s in (store, other))
            assert ours.read_bytes() == theirs.read_bytes()


def test_a_parcel_brings_back_what_this_process_would_have_made(tmp_path):
    store = store_in(tmp_path / "ours")
    assert keep(store, UNIT, compute_parcel(pack(Task(UNIT, store)))) == FINISHED
    assert store.state(UNIT) == DONE
    same_results(store, in_this_process(store_in(tmp_path / "theirs"), [UNIT]), [UNIT])


def test_a_parcel_that_stops_goes_on_elsewhere_from_its_checkpoint(tmp_path):
    store = store_in(tmp_path / "ours")
    answer = compute_parcel(pack(Task(UNIT, store, stop_at_s=Soon(1e18))))
    assert keep(store, UNIT, answer) == STOPPED
    assert len((store.run_dir(UNIT) / "metrics.csv").read_text().splitlines()) == 2
    assert "checkpoint.pt" in pack(Task(UNIT, store)).working
    assert keep(store, UNIT, compute_parcel(pack(Task(UNIT, store)))) == FINISHED
    same_results(store, in_this_process(store_in(tmp_path / "theirs"), [UNIT]), [UNIT])


def test_a_failure_without_a_word_is_one_units_failure(tmp_path, capsys):
    class TaskError(Exception):
        cause = MemoryError()

    def get(_reference):
        raise TaskError

    ray = SimpleNamespace(get=get, exceptions=SimpleNamespace(RayError=TaskError))
    assert ray_runner._receive(ray, Task(UNIT, store_in(tmp_path)), None) == FAILED
    assert f"failed: {UNIT}: MemoryError\n" in capsys.readouterr().err


def test_what_was_finished_elsewhere_is_not_sent(tmp_path, monkeypatch):
    ray = SimpleNamespace(is_initialized=lambda: True)  # and nothing to send with
    monkeypatch.setattr(ray_runner, "import_ray", lambda: ray)
    store = in_this_process(store_in(tmp_path), [UNIT])
    assert run_on_ray([Task(UNIT, store)], "local").count(FINISHED) == 1


@pytest.fixture(scope="module")
def cluster():
    """A head without a processor of its own and two nodes of one each."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    yield cluster
    cluster.shutdown()


@pytest.mark.ray
def test_a_cluster_gives_the_results_of_this_process(cluster, tmp_path):
    store = store_in(tmp_path / "ours")
    tally = run_on_ray([Task(unit, store) for unit in UNITS], cluster.address)
    assert (tally.count(FINISHED), tally.total) == (3, 3)
    assert {store.state(unit) for unit in UNITS} == {DONE}
    same_results(store, in_this_process(store_in(tmp_path / "theirs"), UNITS), UNITS)


@pytest.mark.ray
def test_a_unit_that_fails_on_a_node_takes_no_other_with_it(cluster, tmp_path, capsys):
    store = store_in(tmp_path)
    tasks = [Task(UNITS[0], store), Task(UNITS[1], store)]
    run_dir = store.run_dir(UNITS[0])
    run_dir.mkdir(parents=True)
    (run_dir / "checkpoint.pt").write_bytes(b"no checkpoint")
    tally = run_on_ray(tasks, cluster.address)
    assert (tally.count(FAILED), tally.count(FINISHED)) == (1, 1)
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("failed")]
    assert len(lines) == 1
    assert "seed 1: UserError: " in lines[0]


@pytest.mark.ray
def test_a_node_that_dies_costs_nothing_but_time(cluster, tmp_path):
    """Ray begins its unit again on a node that lives."""
    store = store_in(tmp_path, replace(TINY, episodes={"left_turn": 40}))
    doomed = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    timer = threading.Timer(8.0, cluster.remove_node, (doomed,), {"allow_graceful": False})
    timer.start()
    tally = run_on_ray([Task(unit, store) for unit in UNITS], cluster.address)
    assert not timer.is_alive(), "the node outlived the work"
    timer.join()
    assert tally.count(FINISHED) == 3
