import json
import os
import re
import signal
import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from bridge.outcomes import COLLISION, GOAL
from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import call, refusal
from trainer import experiments as plan
from trainer import util
from trainer.environments import CONDITIONS, make_environment
from trainer.evaluation import BEST_FILE, CHECKPOINT_FILE
from trainer.experiments import GUIDANCE, PAPER, Line, Unit, compute, records, report
from trainer.experiments.compute import FAILED, FINISHED, STOPPED, Job
from trainer.experiments.records import RECORD_FILE, Store
from trainer.human import MODEL_FILE, HumanModelConfig
from trainer.human.model import HumanModel
from trainer.learner.networks import sees_picture

ROOT = Path(__file__).parents[2]
TINY = replace(
    PAPER.quick(),
    steps=dict.fromkeys(PAPER.steps, 290),
    learner={"batch_size": 4, "warmup_steps": 240},
)
UNIT = Unit("left_turn", "per_td3", "normal", 1)  # No human guides it
GUIDED = UNIT._replace(algorithm="phil_td3")


def store_in(directory, study=TINY):
    return Store(study, directory / "results", directory / "runs", directory / "humans")


@pytest.fixture
def store(tmp_path):
    return store_in(tmp_path)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """A unit that was never interrupted."""
    store = store_in(tmp_path_factory.mktemp("straight"))
    assert compute.compute(Job(UNIT, store)) == FINISHED
    return store


def write_human(store, scenario="left_turn", seed=1):
    """An untrained one."""
    directory = store.humans / scenario
    directory.mkdir(parents=True, exist_ok=True)
    HumanModel(HumanModelConfig(), seed).save(directory, {"scenario": scenario})
    return directory / MODEL_FILE


def record_of(store, unit=UNIT):
    """What must be the same in a unit's record however often it was stopped."""
    record = json.loads((store.run_dir(unit) / RECORD_FILE).read_text())
    record["units"] = {name: it for name, it in record["units"].items() if name != "training_s"}
    return record


def validated(*shares):
    """The column of a validation every ninth episode: these successes, then the last one on."""
    column = [None] * 100
    column[8::9] = [*shares, *[shares[-1]] * 11][:11]
    return {"validation_success": column}


MEASURED = ("drives", *records.SCORES, *records.ARRIVED_ONLY, "paper_success",
            "paper_distance_m", "paper_distance_sd_m")  # fmt: skip


def made_up(unit, digest):
    """The record of a unit of a hundred episodes that all arrive."""
    count, each = len(unit.conditions), [1.0] * 100
    own = {"digest": digest, "bfloat16": unit.seed > 1, "gpu": None, "action": 0.1,
           "searched": 39, "search_success": 0.3}  # fmt: skip
    record: dict[str, Any] = {
        "tests": {"condition": [*unit.conditions], **dict.fromkeys(MEASURED, [1.0] * count)}
    }
    if unit.trained:
        own |= {"period_s": 0.1, "updates": 6000, "training_s": 300 + unit.seed}
        record["episodes"] = {
            "end_step": [*range(60, 6_060, 60)], "return": each, "distance_m": each,
            "outcome": [GOAL] * 100, "human_steps": [3] * 100, "takeovers": [1] * 100,
            **validated(1.0), "validation_distance_m": each, "validation_reward": each,
        }  # fmt: skip
    return {**record, "units": {name: [value] for name, value in own.items()}}


def leave(store, units, **columns):
    """Write the made-up records of these units, with columns of some tables changed."""
    for unit in units:
        record = made_up(unit, store.study.digest(unit))
        for table, values in columns.items():
            record[table].update(values(unit) if callable(values) else values)
        store.run_dir(unit).mkdir(parents=True, exist_ok=True)
        (store.run_dir(unit) / RECORD_FILE).write_text(json.dumps(record))
    return store.load(units, 5)


class TestUnit:
    def test_it_ends_as_a_record_and_an_actor(self, straight):
        (unit,) = straight.load([UNIT], 1).numbers.to_dict("records")
        rows = {name: pd.read_csv(straight.results / f"{name}.csv.xz")
                for name in ("units", "episodes", "tests")}  # fmt: skip
        assert set(rows["tests"].condition) == set(CONDITIONS)
        assert set(rows["tests"].drives) == {TINY.test_runs}
        assert rows["episodes"].end_step.iloc[-1] == unit["steps"] >= TINY.steps["left_turn"]
        validated = rows["episodes"].dropna(subset="validation_success")
        assert unit["tested_actor_at_step"] in set(validated.end_step)
        assert (unit["human_steps"], unit["takeovers"]) == (0, 0)
        assert json.loads(unit["config"]) == TINY.config(UNIT)
        assert {path.name for path in straight.run_dir(UNIT).iterdir()} >= {BEST_FILE, RECORD_FILE}
        assert not (straight.run_dir(UNIT) / CHECKPOINT_FILE).exists()
        assert str(straight.runs) not in (straight.run_dir(UNIT) / RECORD_FILE).read_text()

    def test_a_process_that_dies_fails_its_own_unit(self, store, monkeypatch, capsys):
        monkeypatch.setattr(util, "begin_process", os._exit)
        jobs = [Job(UNIT, store, stop_at_s) for stop_at_s in (1e10, 1e11)]
        assert sorted(compute.run_here(jobs, 1), key=repr) == [(job, FAILED) for job in jobs]
        assert capsys.readouterr().err.count("goes on") == 2

    def test_one_that_is_out_of_time_goes_on_to_the_same_record(self, store, straight):
        """Stopped before its time began, and in the midst of it."""
        for left_s, end in ((-1.0, STOPPED), (0.1, STOPPED), (1e9, FINISHED)):
            assert compute.compute(Job(UNIT, store, time.time() + left_s)) == end
        assert record_of(store) == record_of(straight)

    def test_a_foreign_task_is_learned_and_reported_beside_its_expert(self, tmp_path, one_thread):
        store = store_in(tmp_path, replace(GUIDANCE.quick(), learner=TINY.learner))
        units = [Unit("hill", name, "good", seed) for name, seed in (("expert", 0), ("ia_td3", 1))]
        for unit in units:
            assert compute.compute(Job(unit, store)) == FINISHED
        found = store.load(units, 1)
        expert, learned = (found.of("hill", Line(unit.algorithm, "good")).iloc[0] for unit in units)
        assert expert["success nominal"] == 1.0
        assert learned.human_s == pytest.approx(learned.human_steps / 30)
        page = report.write_page(store, found).read_text()
        assert (store.results / "guidance.png").stat().st_size > 1000
        assert "| IA-TD3 | hill | 1 |" in page


def test_a_failure_is_one_units_and_one_line(store, capfd):
    write_human(store)
    bad = GUIDED._replace(scenario="congestion")
    write_human(store, bad.scenario).write_bytes(b"no human")
    units = [bad, UNIT._replace(algorithm=plan.HUMAN_MODEL, seed=0)]
    jobs = [Job(unit, store) for unit in units]
    assert [compute._end(job, partial(compute.compute, job)) for job in jobs] == [FAILED, FINISHED]
    found = store.load(units, 1)
    assert found.found == units[1:]
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "failed" in line]
    assert str(bad) in line


@pytest.fixture(scope="module")
def cluster():
    """A head without a processor of its own and two nodes of one each."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    yield cluster
    ray.shutdown()
    cluster.shutdown()


@pytest.mark.ray
def test_a_cluster_computes_all_units_but_the_one_that_fails(store, cluster):
    units = [UNIT._replace(seed=seed) for seed in (1, 2, 3)]
    store.run_dir(units[0]).mkdir(parents=True)
    (store.run_dir(units[0]) / CHECKPOINT_FILE).write_bytes(b"no checkpoint")
    jobs = [Job(unit, store) for unit in units]
    ends = {job.unit.seed: end for job, end in compute.run_on_ray(jobs, cluster.address)}
    assert ends == {1: FAILED, 2: FINISHED, 3: FINISHED}
    assert store.load(units, 3).found == units[1:]


class TestTables:
    UNITS = (UNIT, GUIDED, UNIT._replace(seed=2))

    def test_records_join_those_that_are_there_and_come_back_as_they_were(self, store):
        first, second = (leave(store, units) for units in (self.UNITS[:1], self.UNITS))
        assert (*first.found, *second.found) == (UNIT, *self.UNITS)
        own = made_up(GUIDED, "")
        rows = second.tables["episodes"].loc[[tuple(GUIDED)]]
        for column, values in own["episodes"].items():
            assert rows[column].dropna().tolist() == [each for each in values if each is not None]

    def test_a_kill_while_tables_are_written_loses_nothing(self, store, monkeypatch):
        leave(store, self.UNITS[:1])
        write = records.write_atomic
        with monkeypatch.context() as patch:
            patch.setattr(records, "write_atomic", lambda path, data: (
                write(path, data) if "episodes" in path.name else signal.raise_signal(signal.SIGINT)
            ))  # fmt: skip
            with pytest.raises(KeyboardInterrupt):
                leave(store, self.UNITS)
        found = store.load(self.UNITS, 2)
        assert tuple(found.found) == self.UNITS
        rows = found.tables["episodes"].reset_index()
        assert not rows.duplicated([*records.KEY, "end_step"]).any()

    @pytest.mark.parametrize("damage", [b"", b"no table", b"\xfd7zXZ\x00"])
    def test_damage_is_refused_in_one_line(self, store, damage):
        leave(store, self.UNITS)
        path = store.results / "tests.csv.xz"
        path.write_bytes(damage)
        with pytest.raises(UserError, match=re.escape(str(path))) as refused:
            store.load(self.UNITS, 1)
        assert "\n" not in str(refused.value)

    @pytest.mark.parametrize("study", plan.STUDIES.values(), ids=plan.STUDIES)
    def test_what_is_kept_is_current_and_without_gaps(self, study, tmp_path):
        store = Store(study, ROOT / "results" / study.name, tmp_path, ROOT / "results/humans/paper")
        wanted, found = study.units(5), store.load(study.units(5), 5)
        assert len(set(wanted)) == {"paper": 274, "guidance": 702}[study.name]
        units, missing = found.found, set(wanted) - set(found.found)
        # Still being computed
        assert {unit.setting for unit in missing} <= {"sixteen_updates"}
        assert found.stale == []
        assert len(store._tables()["units"]) == len(units)
        assert set(found.tables["episodes"].index) == {tuple(u) for u in units if u.trained}
        assert len(found.tables["tests"]) == sum(len(unit.conditions) for unit in units)


def test_a_tasks_defaults_are_those_of_its_environment():
    for name, task in plan.TASKS.items():
        with closing(make_environment(task["environment"])) as env:
            numbers = not sees_picture(env.observation_space)
            assert task.get("numbers_period_s") == (env.control_period_s if numbers else None), name


GOOD_UNITS = [Unit(*each) for each in product(
    ("left_turn", "congestion"), ("phil_td3", "hi_td3"), ["good"], range(1, 6)
)]  # fmt: skip


class TestNumbers:
    def test_what_it_took_is_counted_until_the_validation_that_shows_it(self, store):
        found = leave(
            replace(store, study=PAPER), [GUIDED],
            episodes={**validated(0.4, 0.8, *[1.0] * 7, 0.9, 0.8),
                      "outcome": [COLLISION] * 5 + [GOAL] * 95},
        )  # fmt: skip
        (row,) = found.numbers.to_dict("records")
        assert (row["steps_to_90%"], row["episodes_to_90%"], row["failures_to_90%"]) == (
            1620,
            27,
            5,
        )
        assert row["human_s_to_98%"] == pytest.approx(8.1)
        assert (row["steps"], row["human_steps"], row["failures"]) == (6000, 300, 5)
        assert row["unlearned"] == pytest.approx(0.1)  # the mean of 1.0, 0.9 and 0.8

    def test_tests_are_summed_up_by_what_arrives_and_distances_end_at_the_goal(self):
        drives = pd.DataFrame({
            "condition": "noise", "outcome": [GOAL] * 50 + [COLLISION] * 50,
            "distance_m": [21.4] * 50 + [1.0] * 50, "reward": 1.0,
            "time_s": [4.0] * 50 + [1.0] * 50, report.LATERAL: None, report.LONGITUDINAL: 0.5,
        })  # fmt: skip
        (row,) = records.summarise_tests("left_turn", drives).to_dict("records")
        assert (row["success"], row["paper_success"], row["distance_m"]) == (0.5, 1.0, 11.0)
        assert (row["paper_distance_m"], row["paper_distance_sd_m"]) == (21.0, 0.0)
        assert row["time_s"] == 4.0
        assert np.isnan(row[report.LATERAL])

    @pytest.mark.parametrize(
        ("cheaper", "behind", "default"),
        [(9, 0, "HI-TD3"), (8, 0, "PHIL-TD3"), (10, 1, "PHIL-TD3")],
    )
    def test_a_row_becomes_the_default_that_costs_less_and_is_nowhere_behind(
        self, store, monkeypatch, cheaper, behind, default
    ):
        ours = [unit for unit in GOOD_UNITS if unit.algorithm == "hi_td3"]

        def steps(unit):
            cost = [2 if unit in ours[:cheaper] else 3] * 100
            return {"human_steps": cost, **validated(0.0, 1.0)}

        def tests(unit):
            fails = unit in ours and behind and unit.scenario == "congestion"
            return {"success": [1.0, 1.0, 0.0 if fails else 1.0, 1.0]}

        monkeypatch.setattr(plan, "RIVALS", ("hi_td3",))
        found = leave(store, GOOD_UNITS, episodes=steps, tests=tests)
        assert report.default(found) == default
        assert report.less_in(report.pairs(found, Line("hi_td3", "good"))) == f"{cheaper} of 10"

    def test_a_row_forgives_a_human_beside_whom_it_still_succeeds(self, store):
        units = [Unit("left_turn", *each, 1) for each in product(
            ("phil_td3", "hi_td3"), ("good", "slower")
        )]  # fmt: skip
        found = leave(store, units, episodes=validated(1.0), tests=lambda unit: {
            "success": [0.6 if unit[1:3] == ("hi_td3", "slower") else 0.9] * 4
        })  # fmt: skip
        assert report.forgives(found) == (["PHIL-TD3"], ["HI-TD3 (slower 60.0)"])
        assert report.late(found)[:2] == ["IA-TD3", "vanilla TD3"]


class TestCommand:
    def test_a_page_is_made_of_the_tables_alone(self, tmp_path, capsys, monkeypatch):
        store = store_in(tmp_path, PAPER)
        write_human(store)
        leave(store, PAPER.units(2, "left_turn", ["fig9", "fig7", "floor"]))
        drawn = {name: report.FIGURES["paper"][name] for name in ("fig7", "fig10")}
        monkeypatch.setitem(report.FIGURES, "paper", drawn)
        places = ("--results", store.results, "--runs", tmp_path, "--humans", store.humans)
        assert call(capsys, "experiment", "report", "--seeds", 2, *places)[0] == 0
        page = (store.results / "README.md").read_text()
        assert all((store.results / f"{name}.png").stat().st_size > 1000 for name in drawn)
        assert all((store.results / name).exists() for name in re.findall(r"\((\w+\.png)\)", page))
        assert str(tmp_path) not in page

    def test_what_is_missing_is_computed_and_reported(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setitem(report.FIGURES, "paper", {})
        more = ("--quick", "--scenario", "left_turn", "--runs", tmp_path)
        status, out, _ = call(capsys, "experiment", "floor", *more)
        results = tmp_path / "quick/results"
        assert (status, out.splitlines()[-1]) == (0, f"wrote {results / 'README.md'}")
        assert "constant actions in the left turn is" in (results / "README.md").read_text()
        assert "1 of 1 units were there already" in call(capsys, "experiment", "floor", *more)[1]

    @pytest.mark.parametrize("settings", [["late"], ["four_updates", "sixteen_updates"]])
    def test_one_row_in_some_settings_can_be_chosen(self, capsys, settings):
        chosen = ("--algorithm", "phil_td3", "--setting", *settings)
        said = call(capsys, "experiment", "guidance", "status", *chosen)[1].splitlines()
        assert {line.split()[0] for line in said[:-1]} == {*settings}
        refusal(capsys, "experiment", "guidance", "--setting", "printed")

    @pytest.mark.parametrize("names", ["status report", "guidance fig7"])
    def test_names_that_do_not_go_together_are_refused(self, capsys, names):
        refusal(capsys, "experiment", *names.split())
