import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import pytest

from edge_runtime.util import UserError
from hil_tests.processes import wait_until
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE
from trainer.evaluation import CONDITIONS
from trainer.experiments import guidance
from trainer.experiments import plan as planned
from trainer.experiments import run as running
from trainer.learner.config import ALGORITHMS, PRINTED_LEARNER
from trainer.tests.experiments import TINY, UNIT, Soon, store_in, without_times, write_human
from trainer.training.config import LATER
from trainer.training.metrics import METRICS_FILE
from trainer.training.run import TrainingRun

GUIDED = planned.Unit("left_turn", "phil_td3", planned.NORMAL, 1)
ROOT = Path(__file__).parents[2]


@pytest.fixture
def store(tmp_path):
    return store_in(tmp_path)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    store = store_in(tmp_path_factory.mktemp("straight"))
    assert running.compute(running.Task(UNIT, store)) == running.FINISHED
    return store


def test_a_unit_learns_where_its_task_says(tmp_path, monkeypatch):
    def begin(config, *where, **how):
        raise UserError(f"learns on {config.device}")

    monkeypatch.setattr(running, "TrainingRun", begin)
    for device in ("cpu", "cuda"):
        with pytest.raises(UserError, match=f"learns on {device}"):
            running.compute(running.Task(UNIT, store_in(tmp_path), device=device))


def test_a_unit_ends_as_a_record_and_an_actor(straight):
    (record,) = straight.records("left_turn").values()
    ends = record["training"]["end_step"]
    assert set(record["tests"]) == set(CONDITIONS)
    for columns in record["tests"].values():
        assert {len(values) for values in columns.values()} == {TINY.test_runs}
    assert record["totals"]["steps"] == ends[-1] >= TINY.steps["left_turn"]
    assert record["tested_actor_at_step"] in record["validation"]["at_step"]
    assert record["human"] is None
    assert not any(record["training"]["human_steps"] + record["training"]["takeovers"])
    assert record["computed"]["processor"]
    assert record["computed"]["gpu"] is None
    # It says what was trained: enough to train it again by hand.
    config = asdict(planned.run_config(UNIT, TINY, straight.humans))
    said = record["config"]
    said = {**config, **said, "learner": {**config["learner"], **said["learner"]}}
    assert said == json.loads(json.dumps(config))
    run_dir = straight.run_dir(UNIT)
    assert (run_dir / METRICS_FILE).is_file()
    assert (run_dir / BEST_FILE).is_file()
    assert not (run_dir / CHECKPOINT_FILE).exists()
    assert str(straight.runs.parent) not in straight.records_file("left_turn").read_text()


def test_a_killed_unit_goes_on_to_the_same_record(store, straight, tmp_path):
    """A process, killed at a checkpoint as by a power cut."""
    code = (
        "from pathlib import Path; from trainer.tests.experiments import *; "
        "from trainer.experiments import run as running; "
        f"running.compute(running.Task(UNIT, store_in(Path({str(tmp_path)!r}))))"
    )
    command = [sys.executable, "-c", code]
    process = subprocess.Popen(command, cwd=ROOT, start_new_session=True)
    checkpoint = store.run_dir(UNIT) / CHECKPOINT_FILE
    wait_until(checkpoint.exists, "a checkpoint", 120.0)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not store.records("left_turn")
    assert running.compute(running.Task(UNIT, store)) == running.FINISHED
    assert without_times(store, UNIT) == without_times(straight, UNIT)


def test_two_processes_share_one_file_of_records_and_a_failure_is_one_units(store, capfd):
    """Each of the others is computed once, and no record is lost."""
    store = replace(store, plan=replace(TINY, steps=dict.fromkeys(TINY.steps, 60)))
    write_human(store)
    bad, alone = GUIDED._replace(scenario="congestion"), GUIDED._replace(seed=0)
    write_human(store, bad.scenario).write_bytes(b"no human")
    floor = alone._replace(algorithm=planned.CONSTANT)
    units = [bad, GUIDED, floor, alone._replace(algorithm=planned.HUMAN_MODEL)]
    ends = running.run_units([running.Task(unit, store) for unit in units], 2)
    assert ends == {running.FINISHED: 3, running.FAILED: 1}
    assert list(store.records("left_turn")) == sorted(units[1:])
    assert set(store.find(units)[0]) == set(units[1:])
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "failed" in line]
    assert str(bad) in line
    record = store.records("left_turn")[floor]
    assert record["success_of"][f"{record['action']:g}"] == max(record["success_of"].values())


def test_a_unit_that_another_process_has_is_left_to_it(store, monkeypatch):
    monkeypatch.setattr(running, "PATIENCE_S", 0.0)
    with running.util.held(store.run_dir(UNIT)) as mine:
        assert (mine, running.compute(running.Task(UNIT, store))) == (True, running.BUSY)


def test_a_unit_is_not_trained_again_but_tests_that_change_are_driven_with_its_actor(
    straight, tmp_path, monkeypatch
):
    monkeypatch.setattr(TrainingRun, "train", lambda *_: pytest.fail("trained again"))
    assert running.compute(running.Task(UNIT, replace(straight, runs=tmp_path))) == running.FINISHED
    more = replace(straight, plan=replace(TINY, test_runs=5), results=tmp_path)
    assert running.compute(running.Task(UNIT, more)) == running.FINISHED
    ours, theirs = (each.find([UNIT])[0][UNIT] for each in (more, straight))
    assert ours["id"] != theirs["id"]
    assert ours["training"] == theirs["training"]
    assert {len(ours["tests"][condition]["outcome"]) for condition in CONDITIONS} == {5}


@pytest.mark.parametrize(
    ("place", "plan", "name"),
    [("paper", planned.PLAN, "all"), ("guidance", planned.GUIDANCE_PLAN, planned.GUIDANCE)],
)
def test_the_records_that_are_kept_are_of_todays_settings_and_each_is_there_once(
    tmp_path, place, plan, name
):
    results, humans = ROOT / "results" / place, ROOT / "results/humans/paper"
    store = running.Store(plan, results, tmp_path, humans)
    done, others = store.find(planned.units_of([name], 5, None))
    assert done
    assert not others
    for scenario in (path.stem for path in results.glob("*.jsonl")):  # In its scenario's file.
        found = store.records(scenario)
        assert {unit.scenario for unit in found} == {scenario}
        assert len(found) == len(store.records_file(scenario).read_text().splitlines())


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
        def id_of(unit=GUIDED, where=store, **changes):
            return replace(where, plan=replace(TINY, **changes)).id(unit)

        elsewhere, nowhere = store_in(tmp_path / "elsewhere"), store_in(tmp_path / "nowhere")
        human = write_human(store)
        write_human(elsewhere)
        assert id_of() == id_of(checkpoint_every=7) == id_of(where=elsewhere)
        assert id_of(UNIT) == id_of(UNIT, nowhere), "nobody guides it"
        ids = [
            id_of(), id_of(UNIT), id_of(GUIDED._replace(seed=2)),
            id_of(GUIDED._replace(setting="biased")), id_of(steps={"left_turn": 300}),
            id_of(evaluation_runs=3), id_of(test_runs=4), id_of(learner={"tau": 0.5}),
        ]  # fmt: skip
        with monkeypatch.context() as patch:
            row = replace(ALGORITHMS["phil_td3"], advantage_weight=2.0)
            patch.setitem(ALGORITHMS, "phil_td3", row)
            ids.append(id_of())
        with monkeypatch.context() as patch:
            patch.setattr(planned, "behaviour", lambda *_: "another scene")
            ids.append(id_of())
        human.unlink()
        write_human(store, seed=2)
        ids.append(id_of())
        assert len(set(ids)) == len(ids)
        # What came after the first records decides where it is used only.
        later = set(LATER)
        for setting, names in (("normal", set()), ("late", {"late_from_s", "late_to_s"})):
            found = planned.deciding(GUIDED._replace(setting=setting), TINY, store.humans)
            assert later & {*found["config"], *found["switches"]} == names
        # Tests do not name the training.
        plans = (replace(TINY, test_runs=number) for number in (2, 9))
        assert len({replace(store, plan=each).run_dir(UNIT) for each in plans}) == 1

    def test_a_scene_that_does_another_thing_is_another_scene(self):
        nominal = planned.behaviour("left_turn", "nominal")
        assert planned.behaviour("left_turn", "noise") == nominal
        assert planned.behaviour("left_turn", "variant") != nominal
        assert planned.behaviour("left_turn", "nominal", printed_reward=True) != nominal

    def test_the_order_of_values_does_not_matter(self):
        one, other = {"a": {"x": 1, "y": 2}, "b": 3}, {"b": 3, "a": {"y": 2, "x": 1}}
        assert planned.digest(one) == planned.digest(other)


class TestPlan:
    def test_every_experiment_is_computed_by_all(self):
        everything = planned.units_of(["all"], 2)
        assert len(set(everything)) == len(everything)
        for name in planned.EXPERIMENTS:
            assert set() < set(planned.units_of([name], 2)) <= set(everything)

    def test_work_goes_line_by_line_and_then_seed_by_seed(self):
        units = planned.units_of(["all"], 5)
        assert {unit.algorithm for unit in units[:4]} == {planned.HUMAN_MODEL, planned.CONSTANT}
        first = units[4:44]
        assert {unit.setting for unit in first} == {planned.NORMAL}
        assert [unit.seed for unit in first] == sorted(unit.seed for unit in first)
        assert units[44].setting == "biased"

    def test_the_settings_are_what_they_say(self, store):
        write_human(store)
        units = {setting: GUIDED._replace(setting=setting) for setting in planned.SETTINGS}
        of = {name: planned.run_config(units[name], planned.PLAN, store.humans) for name in units}
        papers = {setting for setting, *_ in planned.LINES}
        assert (papers | set(planned.HUMANS), len(papers & set(planned.HUMANS))) == (set(of), 0)
        assert of["one_frame"].learner.frames == 1
        assert of["printed"].learner == PRINTED_LEARNER
        assert (of["biased"].poor_guidance, of["random"].poor_guidance) == ("biased", "random")
        assert of["random"].poor_guidance_share == of["biased"].poor_guidance_share > 0.3
        assert {each.steps for each in of.values()} == {planned.PLAN.steps["left_turn"]}

    def test_the_table_of_guidance_has_every_row_with_every_human_and_none_of_the_papers(self):
        units = planned.units_of([planned.GUIDANCE], 5)
        assert len(set(units)) == len(units)
        lines = {(unit.algorithm, unit.setting) for unit in units if unit.trained}
        humans, rows = set(planned.HUMANS), set(planned.ROWS)
        assert lines == {*product(rows - {"per_td3"}, humans), ("per_td3", "good")}
        assert {unit.scenario for unit in units} == {*planned.SCENARIOS, *planned.FOREIGN}
        assert not set(units) & set(planned.units_of(["all"], 5))
        configs = {unit: planned.run_config(unit, planned.GUIDANCE_PLAN, Path("humans"))
                   for unit in units if unit.trained}  # fmt: skip
        for unit, config in configs.items():
            paths = {"model": f"humans/{unit.scenario}"}
            assert config.human == paths.get(unit.setting, unit.scripted_human)
            row = {**ALGORITHMS[unit.algorithm].settings, **planned.TUNED.get(unit.algorithm, {})}
            assert {name: getattr(config.learner, name) for name in row} == row


def test_a_foreign_task_is_learned_and_reported_beside_its_expert(tmp_path, one_thread):
    units = [planned.Unit("hill", name, "good", seed)
             for name, seed in (("expert", 0), ("pvp4real_td3", 1))]  # fmt: skip
    store = store_in(tmp_path, planned.QUICK_GUIDANCE)
    for unit in units:
        assert running.compute(running.Task(unit, store)) == running.FINISHED
    expert, learned = (store.find(units)[0][unit] for unit in units)
    assert set(expert["tests"]["nominal"]["outcome"]) == {"goal"}
    assert learned["totals"]["human_s"] == pytest.approx(
        sum(learned["training"]["human_steps"]) / 30
    )
    page = guidance.write_guidance(store, 1).read_text()
    assert (store.results / "guidance.png").stat().st_size > 1000
    (row,) = [line for line in page.splitlines() if line.startswith("| PVP4Real-TD3 | hill | 1 |")]
    assert f"| {learned['totals']['human_s']:.0f} |" in row


UNITS = [UNIT._replace(seed=seed) for seed in (1, 2, 3)]


def test_a_parcel_goes_on_elsewhere_and_brings_back_the_same_record(store, straight):
    """Wherever it is stopped, and also before its time began."""
    assert running.compute(running.Task(UNIT, store, stop_at_s=1.0)) == running.STOPPED
    assert running.compute(running.Task(UNIT, store, stop_at_s=Soon(1e18))) == running.STOPPED
    task = running.Task(UNIT, store, stop_at_s=Soon(1e18))
    assert running.keep(task, *running.compute_parcel(running.pack(task))) == running.STOPPED
    task = running.Task(UNIT, store)
    assert "checkpoint.pt" in running.pack(task)[2]
    assert running.keep(task, *running.compute_parcel(running.pack(task))) == running.FINISHED
    assert without_times(store, UNIT) == without_times(straight, UNIT)


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
    ends = running.run_on_ray([running.Task(unit, store) for unit in UNITS], cluster.address)
    assert ends == {running.FAILED: 1, running.FINISHED: 2}
    assert list(store.find(UNITS)[0]) == UNITS[1:]
