"""Units sent to a node and back; on a cluster of several nodes by ``make test-ray``."""

from dataclasses import replace

import pytest

from trainer.experiments.run import (
    FAILED,
    FINISHED,
    STOPPED,
    Task,
    compute,
    compute_parcel,
    keep,
    pack,
    run_on_ray,
)
from trainer.tests.experiments import UNIT, Soon, store_in, without_times

UNITS = [UNIT._replace(seed=seed) for seed in (1, 2, 3)]


def test_a_parcel_goes_on_elsewhere_and_brings_back_the_same_record(tmp_path):
    store, other = store_in(tmp_path / "ours"), store_in(tmp_path / "theirs")
    task = Task(UNIT, store, stop_at_s=Soon(1e18))
    assert keep(task, *compute_parcel(pack(task))) == STOPPED
    task = replace(task, stop_at_s=float("inf"))
    assert "checkpoint.pt" in pack(task)[2]
    assert keep(task, *compute_parcel(pack(task))) == FINISHED
    assert compute(Task(UNIT, other)) == FINISHED
    assert without_times(store, UNIT) == without_times(other, UNIT)


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
def test_a_cluster_computes_all_units_but_the_one_that_fails(cluster, tmp_path):
    store = store_in(tmp_path)
    run_dir = store.run_dir(UNITS[0])
    run_dir.mkdir(parents=True)
    (run_dir / "checkpoint.pt").write_bytes(b"no checkpoint")
    ends = run_on_ray([Task(unit, store) for unit in UNITS], cluster.address)
    assert ends == {FAILED: 1, FINISHED: 2}
    assert list(store.find(UNITS)[0]) == UNITS[1:]
