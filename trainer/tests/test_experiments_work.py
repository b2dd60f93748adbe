"""One tiny unit from its first episode to its result, straight and with stops."""

import json
import re
import shutil
from dataclasses import replace

import pytest

from edge_runtime.errors import UserError
from trainer.conditions import CONDITIONS
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE
from trainer.experiments.gathered import gather
from trainer.experiments.plan import HUMAN_MODEL
from trainer.experiments.store import BEGUN, DONE
from trainer.experiments.units import Unit
from trainer.experiments.work import FINISHED, KEPT_TESTS, STOPPED, Task, compute
from trainer.human.model import HumanModel, HumanModelConfig
from trainer.tests.experiments import TINY, UNIT, Soon, store_in
from trainer.training.metrics import read_metrics
from trainer.training.run import TrainingRun


def ignore(episodes: int) -> None:
    pass


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    store = store_in(tmp_path_factory.mktemp("straight"))
    assert compute(Task(UNIT, store), ignore) == FINISHED
    return store


def kept(store, name):
    return (store.result_dir(UNIT) / name).read_bytes()


def test_a_unit_ends_as_a_small_result_and_an_actor(straight):
    assert straight.state(UNIT) == DONE
    assert not (straight.run_dir(UNIT) / CHECKPOINT_FILE).exists()
    assert (straight.run_dir(UNIT) / BEST_FILE).is_file()
    tests = json.loads(kept(straight, "tests.json"))
    assert list(tests) == list(CONDITIONS)
    for columns in tests.values():
        assert tuple(columns) == KEPT_TESTS
        assert columns["seed"] == [0, 1]
        assert {len(values) for values in columns.values()} == {TINY.test_runs}
    about = json.loads(kept(straight, "config.json"))
    assert about["id"] == straight.id(UNIT)
    assert about["run"]["learner"]["batch_size"] == TINY.learner["batch_size"]
    validated = [row for row in read_metrics(straight.result_dir(UNIT)) if row["validation_reward"]]
    assert about["tested_actor_of_episode"] in [int(row["episode"]) + 1 for row in validated]
    assert about["computed"]["processor"]
    # Neither a machine's path nor more digits than anyone needs.
    assert str(straight.runs.parent) not in kept(straight, "config.json").decode()
    numbers = re.findall(r"[\d.]+", kept(straight, "tests.json").decode())
    assert max(len(number.replace(".", "").lstrip("0")) for number in numbers) == 5


def test_a_result_is_gathered_as_it_was_stored(straight):
    gathered = gather(straight, [UNIT, replace(UNIT, seed=2)], 2)
    assert gathered.missing == [replace(UNIT, seed=2)]
    (outcome,) = gathered.of("left_turn", "per_td3")
    assert len(outcome.metrics["distance_m"]) == 3
    assert outcome.metrics["episode"][-1] == 2.0
    assert 0.0 <= outcome.measured("validation_success")[1].max() <= 1.0
    assert not gathered.complete("left_turn", ["per_td3"])


def _cut(text: str) -> str:
    return "\n".join(text.splitlines()[:-1]) + "\n"


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("metrics.csv", _cut, "2 of 3 episodes"),
        ("metrics.csv", lambda text: text[:-9], "row of another length"),
        ("metrics.csv", lambda text: text.replace("distance_m", "way_m"), "lacks distance_m"),
        ("metrics.csv", lambda text: text.replace(",", "\0,", 1), "cannot be read"),
        ("tests.json", lambda text: "3", "names no conditions"),
        ("tests.json", lambda text: "[" * 100_000, "is broken"),
        ("config.json", lambda text: "[" * 100_000, "is not JSON"),
        ("tests.json", lambda text: '["nominal", "noise", "variant"]', "names no conditions"),
        ("tests.json", lambda text: '{"nominal": 1, "noise": 2, "variant": 3}', "in place of"),
        ("tests.json", lambda text: text.replace('"seed": [0, 1]', '"seed": [0]'), "2 values of"),
        ("tests.json", lambda text: text.replace("time_s", "time"), "lacks time_s"),
        ("config.json", lambda text: "{}", "'test_runs' is missing"),
    ],
)
def test_a_damaged_result_is_refused_in_one_line(straight, tmp_path, name, damage, words):
    """Nothing is drawn or judged from a part of it."""
    damaged = replace(straight, results=tmp_path / "results")
    shutil.copytree(straight.result_dir(UNIT), damaged.result_dir(UNIT))
    path = damaged.result_dir(UNIT) / name
    path.write_text(damage(path.read_text()))
    with pytest.raises(UserError, match=words) as refused:
        gather(damaged, [UNIT], 1)
    assert "\n" not in str(refused.value)
    path.unlink()
    path.mkdir()
    with pytest.raises(UserError):
        gather(damaged, [UNIT], 1)


def test_a_finished_unit_is_not_computed_again(straight, monkeypatch):
    monkeypatch.setattr(TrainingRun, "train", lambda *_: pytest.fail("trained again"))
    elsewhere = replace(straight, runs=straight.runs / "of another machine")
    assert compute(Task(UNIT, elsewhere), ignore) == FINISHED


def test_stops_at_checkpoints_change_nothing(straight, tmp_path):
    """Neither what was learned, nor which actor was the best one and is tested."""
    store = store_in(tmp_path)
    soon = Task(UNIT, store, stop_at_s=1.0)
    assert compute(soon, ignore) == STOPPED, "time was over before it began"
    ends: list[str] = []
    seen: list[int] = []
    while not ends or ends[-1] == STOPPED:
        task = Task(UNIT, store, stop_at_s=Soon(1e18))
        ends.append(compute(task, seen.append))
        assert store.state(UNIT) == (BEGUN if ends[-1] == STOPPED else DONE)
    assert (ends, seen) == ([STOPPED, STOPPED, FINISHED], [1, 2, 3])
    for name in ("metrics.csv", "tests.json"):
        assert kept(store, name) == kept(straight, name)


def test_tests_that_came_later_are_driven_with_the_actor_that_was_kept(
    straight, tmp_path, monkeypatch
):
    store = replace(straight, results=tmp_path)
    monkeypatch.setattr(TrainingRun, "train", lambda *_: pytest.fail("trained again"))
    assert compute(Task(UNIT, store), ignore) == FINISHED
    assert kept(store, "tests.json") == kept(straight, "tests.json")


def test_the_human_model_is_tested_without_training(tmp_path):
    store = store_in(tmp_path)
    directory = store.humans / "left_turn"
    directory.mkdir(parents=True)
    HumanModel(HumanModelConfig(frames=2), seed=1).save(directory, {"scenario": "left_turn"})
    unit = Unit("left_turn", HUMAN_MODEL, "normal", 0)
    assert compute(Task(unit, store), ignore) == FINISHED
    (outcome,) = gather(store, [unit], 1).of("left_turn", HUMAN_MODEL)
    assert set(outcome.tests) == set(CONDITIONS)
    assert not outcome.metrics
