"""Ids of units: what decides a result changes them, and nothing else does."""

import subprocess
import sys
from dataclasses import replace

import pytest

from edge_runtime.errors import UserError
from trainer.drivers import make_environment
from trainer.experiments import units
from trainer.experiments.plan import FULL_PATH_M, HUMAN_MODEL
from trainer.experiments.units import Unit, deciding, digest, obstacle, run_config, unit_id
from trainer.human.crossing import PedalPlan
from trainer.human.expert import LeftTurnExpert
from trainer.human.guide import HumanGuide
from trainer.human.trigger import LeftTurnTrigger
from trainer.learner.algorithms import ALGORITHMS
from trainer.scenarios import idm
from trainer.scenarios.ego import EgoVehicle
from trainer.scenarios.traffic import TrafficVehicle
from trainer.tests.experiments import GUIDED, TINY, UNIT, store_in, write_human


@pytest.fixture
def humans(tmp_path):
    write_human(store_in(tmp_path))
    return tmp_path / "humans"


def test_a_digest_is_that_of_the_canonical_json():
    # printf '{"a":[1,2.5],"b":null}' | sha256sum
    assert digest({"b": None, "a": [1, 2.5]}) == digest({"a": [1, 2.5], "b": None})
    assert digest({"b": None, "a": [1, 2.5]}) == "f66b2c50ccae"


def test_an_id_is_the_same_in_another_process(humans):
    program = (
        "import sys; from pathlib import Path\n"
        "from trainer.experiments.units import unit_id\n"
        "from trainer.tests.experiments import GUIDED, TINY\n"
        "print(unit_id(GUIDED, TINY, Path(sys.argv[1])))"
    )
    told = subprocess.run(
        [sys.executable, "-c", program, str(humans)], capture_output=True, text=True, check=True
    )
    assert told.stdout.strip() == unit_id(GUIDED, TINY, humans)


@pytest.mark.parametrize(
    "other",
    [
        replace(GUIDED, seed=2),
        replace(GUIDED, algorithm="ia_td3"),
        replace(GUIDED, setting="tough"),
        replace(GUIDED, setting="remedy"),
        replace(GUIDED, algorithm=HUMAN_MODEL),
    ],
    ids=str,
)
def test_another_unit_has_another_id(humans, other):
    assert unit_id(other, TINY, humans) != unit_id(GUIDED, TINY, humans)


@pytest.mark.parametrize(
    "change",
    [
        {"episodes": {"left_turn": 4}},
        {"evaluate_every": 1},
        {"evaluation_runs": 9},
        {"test_runs": 3},
        {"learner": {**TINY.learner, "gamma": 0.9}},
    ],
    ids=str,
)
def test_another_plan_gives_other_ids(humans, change):
    plan = replace(TINY, **change)
    assert unit_id(GUIDED, plan, humans) != unit_id(GUIDED, TINY, humans)


def test_how_often_checkpoints_are_written_changes_no_id(humans):
    plan = replace(TINY, checkpoint_every=17, timed_steps=1, turn_steps=1)
    assert unit_id(GUIDED, plan, humans) == unit_id(GUIDED, TINY, humans)


def test_what_the_tests_are_counts_as_soon_as_it_is_another(humans, monkeypatch):
    """The tests of the first results are left out of the ids."""
    before = unit_id(GUIDED, TINY, humans)
    assert "left_turn_tests" not in deciding(GUIDED, TINY, humans)
    monkeypatch.setattr(units, "COMMAND_NOISE", 0.2)
    noisier = unit_id(GUIDED, TINY, humans)
    monkeypatch.setattr(units, "_numbers_of", lambda *place: {"cars": place})
    assert len({before, noisier, unit_id(GUIDED, TINY, humans)}) == 3


def test_device_and_threads_are_not_among_what_decides(humans):
    assert run_config(GUIDED, TINY, humans, "cuda").device == "cuda"
    assert not {"device", "threads", "checkpoint_every"} & set(
        deciding(GUIDED, TINY, humans)["run"]
    )


def test_when_the_human_takes_over_counts_only_where_one_guides(humans, monkeypatch):
    alone, seen = unit_id(UNIT, TINY, humans), {unit_id(GUIDED, TINY, humans)}
    for kind, name, value in (
        (LeftTurnTrigger, "HOLD_S", 0.4),
        (LeftTurnExpert, "GO", PedalPlan(then_mps=5.0)),
        (HumanGuide, "HOLD_STEPS", 7),
    ):
        monkeypatch.setattr(kind, name, value)
        seen.add(unit_id(GUIDED, TINY, humans))
    assert len(seen) == 4
    assert unit_id(UNIT, TINY, humans) == alone


def test_another_way_of_moving_or_another_code_gives_another_id(humans, monkeypatch):
    seen = {unit_id(UNIT, TINY, humans)}
    for place, name, value in (
        (EgoVehicle, "MAX_STEERING_RAD", 0.7),
        (TrafficVehicle, "TIME_WANTED", 0.9),
        (idm, "EXPONENT", 2.0),
        (units, "CODE", units.CODE + 1),
    ):
        monkeypatch.setattr(place, name, value)
        seen.add(unit_id(UNIT, TINY, humans))
    assert len(seen) == 5


def test_the_full_path_is_the_way_to_the_scenarios_goal():
    for scenario, full_m in FULL_PATH_M.items():
        assert make_environment(scenario).config.goal_m == full_m


def test_without_tdqa_phil_td3_is_ia_td3():
    """The ablation trains it once."""
    assert ALGORITHMS["ia_td3"] == replace(ALGORITHMS["phil_td3"], advantage_weight=0.0)


def test_another_switch_of_an_algorithm_gives_another_id(humans, monkeypatch):
    before = unit_id(GUIDED, TINY, humans)
    monkeypatch.setitem(ALGORITHMS, "phil_td3", replace(ALGORITHMS["phil_td3"], td_weight=2.0))
    assert unit_id(GUIDED, TINY, humans) != before


def test_the_human_counts_by_its_contents_and_only_where_it_guides(humans, tmp_path):
    elsewhere = store_in(tmp_path / "elsewhere")
    write_human(elsewhere)
    guided, alone = unit_id(GUIDED, TINY, humans), unit_id(UNIT, TINY, humans)
    assert unit_id(GUIDED, TINY, elsewhere.humans) == guided
    write_human(elsewhere, b"another one")
    assert unit_id(GUIDED, TINY, elsewhere.humans) != guided
    assert unit_id(UNIT, TINY, elsewhere.humans) == alone
    assert unit_id(UNIT, TINY, tmp_path / "nowhere") == alone


def test_a_field_that_came_later_keeps_the_ids_while_it_is_neutral(monkeypatch):
    monkeypatch.setattr(units, "NEUTRAL", {"later": 0.0})
    before = {"run": {"gamma": 0.9}}
    assert units.without_neutral({"run": {"gamma": 0.9, "later": 0.0}}) == before
    assert units.without_neutral({"run": {"gamma": 0.9, "later": 0.5}}) != before


def test_settings_change_one_thing_each(humans):
    normal = run_config(GUIDED, TINY, humans)
    tough = run_config(replace(GUIDED, setting="tough"), TINY, humans)
    remedy = run_config(replace(GUIDED, setting="remedy"), TINY, humans)
    assert tough == replace(normal, learner=replace(normal.learner, frames=1))
    assert remedy == replace(normal, learner=replace(normal.learner, saturation_weight=0.1))
    assert normal.learner.batch_size == TINY.learner["batch_size"]


def test_poor_guidance_is_one_third_and_leaves_other_ids_alone(humans):
    poor, before = replace(GUIDED, setting="poor"), unit_id(GUIDED, TINY, humans)
    config = run_config(poor, TINY, humans)
    assert config == replace(run_config(GUIDED, TINY, humans), poor_guidance_share=1 / 3)
    assert "poor_guidance_share" in deciding(poor, TINY, humans)["run"]
    # The field came later: while it says nothing, ids are those of the time without it.
    assert "poor_guidance_share" not in deciding(GUIDED, TINY, humans)["run"]
    assert unit_id(GUIDED, TINY, humans) == before


def test_the_printed_reward_is_a_setting_and_leaves_other_ids_alone(humans):
    config = run_config(replace(GUIDED, setting="printed_reward"), TINY, humans)
    assert config == replace(run_config(GUIDED, TINY, humans), printed_reward=True)
    assert "printed_reward" not in deciding(GUIDED, TINY, humans)["run"]


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        (Unit("moon", "phil_td3", "normal", 1), "no scenario moon"),
        (Unit("left_turn", "magic", "normal", 1), "no algorithm magic"),
        (Unit("left_turn", "phil_td3", "easy", 1), "no setting easy"),
        (GUIDED, "python -m trainer human --scenario left_turn"),
    ],
    ids=str,
)
def test_what_cannot_be_computed_is_said_in_one_line(tmp_path, unit, words):
    assert words in (obstacle(unit, tmp_path) or "")
    with pytest.raises(UserError, match=words):
        run_config(unit, TINY, tmp_path)
