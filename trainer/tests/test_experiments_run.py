"""Units from their first step to their record: killed, resumed, side by side, and their ids."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.util import UserError
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE
from trainer.evaluate import CONDITIONS
from trainer.experiments import plan as planned
from trainer.experiments import run as running
from trainer.experiments.plan import (
    CONSTANT,
    EXPERIMENTS,
    HUMAN_MODEL,
    LINES,
    NORMAL,
    SETTINGS,
    Unit,
    run_config,
    training_id,
    unit_id,
    units_of,
)
from trainer.experiments.run import (
    BUSY,
    FAILED,
    FINISHED,
    STOPPED,
    Task,
    compute,
    compute_parcel,
    keep,
    pack,
    run_on_ray,
    run_units,
)
from trainer.learner.config import ALGORITHMS, PRINTED_LEARNER
from trainer.tests.experiments import TINY, UNIT, Soon, store_in, without_times, write_human
from trainer.training.metrics import METRICS_FILE
from trainer.training.run import TrainingRun

GUIDED = Unit("left_turn", "phil_td3", NORMAL, 1)
ROOT = Path(__file__).parents[2]


@pytest.fixture
def store(tmp_path):
    return store_in(tmp_path)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """A unit that was never stopped."""
    store = store_in(tmp_path_factory.mktemp("straight"))
    assert compute(Task(UNIT, store)) == FINISHED
    return store


def test_a_unit_ends_as_a_record_and_an_actor(straight):
    record = straight.find([UNIT])[0][UNIT]
    assert set(record["tests"]) == set(CONDITIONS)
    for columns in record["tests"].values():
        assert {len(values) for values in columns.values()} == {TINY.test_runs}
    assert record["training"]["end_step"][-1] >= TINY.steps["left_turn"]
    assert record["totals"]["steps"] == record["training"]["end_step"][-1]
    assert record["tested_actor_at_step"] in record["validation"]["at_step"]
    assert record["human"] is None
    assert record["computed"]["processor"]
    run_dir = straight.run_dir(UNIT)
    assert (run_dir / BEST_FILE).is_file()
    assert not (run_dir / CHECKPOINT_FILE).exists()
    text = straight.records_file("left_turn").read_text()
    assert len(text.splitlines()) == 1
    assert str(straight.runs.parent) not in text


def test_stops_at_checkpoints_change_nothing(store, straight):
    assert compute(Task(UNIT, store, stop_at_s=1.0)) == STOPPED, "time was over before it began"
    ends = [compute(Task(UNIT, store, stop_at_s=Soon(1e18))) for _ in range(2)]
    assert ends == [STOPPED, STOPPED]
    assert compute(Task(UNIT, store)) == FINISHED
    assert without_times(store, UNIT) == without_times(straight, UNIT)


def test_a_killed_command_goes_on_to_the_same_record(store, straight, tmp_path):
    """The whole command, killed at a checkpoint as a power cut would."""
    code = (
        "from pathlib import Path; from trainer.tests.experiments import *; "
        "from trainer.experiments.run import *; "
        f"run_units([Task(UNIT, store_in(Path({str(tmp_path)!r})))], 1)"
    )
    command = [sys.executable, "-c", code]
    process = subprocess.Popen(command, cwd=ROOT, start_new_session=True)
    checkpoint = store.run_dir(UNIT) / CHECKPOINT_FILE
    until_s = time.monotonic() + 120.0
    while not checkpoint.exists() and time.monotonic() < until_s:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not store.records("left_turn")
    assert compute(Task(UNIT, store)) == FINISHED
    assert without_times(store, UNIT) == without_times(straight, UNIT)


def test_two_processes_share_one_file_of_records(store):
    """Each of three units is computed once, and no record is lost."""
    write_human(store)
    units = [UNIT, GUIDED, Unit("left_turn", HUMAN_MODEL, NORMAL, 0)]
    ends = run_units([Task(unit, store) for unit in units], 2)
    assert ends == {FINISHED: 3}
    assert list(store.records("left_turn")) == sorted(units)
    assert set(store.find(units)[0]) == set(units)


def test_a_unit_that_another_process_has_is_left_to_it(store, monkeypatch):
    monkeypatch.setattr(running, "PATIENCE_S", 0.0)
    with store.lock(UNIT) as mine:
        assert mine
        assert compute(Task(UNIT, store)) == BUSY


def test_a_unit_that_is_done_is_not_trained_again(straight, tmp_path, monkeypatch):
    monkeypatch.setattr(TrainingRun, "train", lambda *_: pytest.fail("trained again"))
    assert compute(Task(UNIT, replace(straight, runs=tmp_path))) == FINISHED


def test_tests_that_change_are_driven_with_the_actor_that_was_kept(straight, tmp_path, monkeypatch):
    monkeypatch.setattr(TrainingRun, "train", lambda *_: pytest.fail("trained again"))
    more = replace(straight, plan=replace(TINY, test_runs=5), results=tmp_path)
    assert compute(Task(UNIT, more)) == FINISHED
    ours, theirs = (each.find([UNIT])[0][UNIT] for each in (more, straight))
    assert ours["id"] != theirs["id"]
    assert ours["training"] == theirs["training"]
    for condition in CONDITIONS:
        assert len(ours["tests"][condition]["outcome"]) == 5


def test_a_failure_is_one_units_failure(store, capfd):
    write_human(store).write_bytes(b"no human")
    ends = run_units([Task(GUIDED, store)], 1)
    assert ends == {FAILED: 1}
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "failed" in line]
    assert str(GUIDED) in line


def test_the_floor_is_searched_and_driven(store):
    unit = Unit("left_turn", CONSTANT, NORMAL, 0)
    assert compute(Task(unit, store)) == FINISHED
    record = store.records("left_turn")[unit]
    assert record["success_of"][f"{record['action']:g}"] == max(record["success_of"].values())


@pytest.mark.parametrize("damage", ["{", "{}", '{"id": "a", "unit": {}, "tests": {}}', "3"])
def test_damaged_records_are_refused_in_one_line(straight, tmp_path, damage):
    store = replace(straight, results=tmp_path)
    whole = straight.records_file("left_turn").read_text()
    store.records_file("left_turn").write_text(f"{whole}{damage}\n")
    with pytest.raises(UserError, match="line 2") as refused:
        store.records("left_turn")
    assert "\n" not in str(refused.value)


class TestIds:
    def test_what_decides_changes_the_id_and_nothing_else_does(self, store, tmp_path, monkeypatch):
        elsewhere = store_in(tmp_path / "elsewhere")
        human = write_human(store)
        write_human(elsewhere)
        first = unit_id(GUIDED, TINY, store.humans)
        assert first == unit_id(GUIDED, replace(TINY, checkpoint_every=7), store.humans)
        assert first == unit_id(GUIDED, TINY, elsewhere.humans)
        unguided = unit_id(UNIT, TINY, store.humans)
        assert unguided == unit_id(UNIT, TINY, tmp_path / "nowhere"), "nobody guides it"
        plans: list[dict] = [
            {"steps": {"left_turn": 300}},
            {"evaluation_runs": 3},
            {"test_runs": 4},
            {"learner": {"tau": 0.5}},
        ]
        others = (GUIDED._replace(seed=2), GUIDED._replace(setting="biased"))
        ids = [first, unguided, *(unit_id(other, TINY, store.humans) for other in others)]
        ids += [unit_id(GUIDED, replace(TINY, **change), store.humans) for change in plans]
        with monkeypatch.context() as patch:
            row = replace(ALGORITHMS["phil_td3"], advantage_weight=2.0)
            patch.setitem(ALGORITHMS, "phil_td3", row)
            ids.append(unit_id(GUIDED, TINY, store.humans))
        with monkeypatch.context() as patch:
            patch.setattr(planned, "behaviour", lambda *_: "another scene")
            ids.append(unit_id(GUIDED, TINY, store.humans))
        human.unlink()
        write_human(store, seed=2)
        ids.append(unit_id(GUIDED, TINY, store.humans))
        assert len(set(ids)) == len(ids)

    def test_tests_do_not_name_the_training(self, tmp_path):
        more = replace(TINY, test_runs=9)
        assert training_id(UNIT, TINY, tmp_path) == training_id(UNIT, more, tmp_path)

    def test_a_scene_that_does_another_thing_is_another_scene(self):
        nominal = planned.behaviour("left_turn", "nominal")
        assert planned.behaviour("left_turn", "noise") == nominal
        assert planned.behaviour("left_turn", "variant") != nominal
        assert planned.behaviour("left_turn", "nominal", printed_reward=True) != nominal

    @given(st.permutations(["a", "b", "c"]))
    def test_the_order_of_values_does_not_matter(self, names):
        values = {name: {"x": 1, "y": name} for name in names}
        assert planned.digest(values) == planned.digest(dict(sorted(values.items())))


class TestPlan:
    def test_every_experiment_is_computed_by_all(self):
        everything = units_of(["all"], 2)
        assert len(set(everything)) == len(everything)
        for name in EXPERIMENTS:
            units = units_of([name], 2)
            assert units, name
            assert set(units) <= set(everything)

    def test_work_goes_by_priority_and_then_seed_by_seed(self):
        units = units_of(["all"], 5)
        assert {unit.algorithm for unit in units[:4]} == {HUMAN_MODEL, CONSTANT}
        first = units[4:44]
        assert {unit.setting for unit in first} == {NORMAL}
        assert [unit.seed for unit in first] == sorted(unit.seed for unit in first)
        assert units[44].setting == "biased"

    def test_the_settings_are_what_they_say(self, store):
        write_human(store)

        def config(setting):
            return run_config(GUIDED._replace(setting=setting), planned.PLAN, store.humans)

        assert {setting for _, setting, _ in LINES} == set(SETTINGS)
        assert config("one_frame").learner.frames == 1
        assert config("printed").learner == PRINTED_LEARNER
        assert config("biased").poor_guidance == "biased"
        assert config("random").poor_guidance == "random"
        assert config("random").poor_guidance_share == config("biased").poor_guidance_share > 0.3
        steps = {config(setting).steps for setting in SETTINGS}
        assert steps == {planned.PLAN.steps["left_turn"]}


def test_the_record_says_what_was_trained(straight):
    """Enough to train it again by hand."""
    record = json.loads(straight.records_file("left_turn").read_text())
    config = run_config(UNIT, TINY, straight.humans).as_dict()
    assert {**config, **record["config"]} == json.loads(json.dumps(config))
    assert (straight.run_dir(UNIT) / METRICS_FILE).is_file()


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
def test_a_cluster_computes_all_units_but_the_one_that_fails(store, cluster):
    run_dir = store.run_dir(UNITS[0])
    run_dir.mkdir(parents=True)
    (run_dir / "checkpoint.pt").write_bytes(b"no checkpoint")
    ends = run_on_ray([Task(unit, store) for unit in UNITS], cluster.address)
    assert ends == {FAILED: 1, FINISHED: 2}
    assert list(store.find(UNITS)[0]) == UNITS[1:]
