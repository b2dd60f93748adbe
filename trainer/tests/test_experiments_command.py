"""``python -m trainer experiment`` as a user meets it."""

import json
import re
from dataclasses import replace

import pytest

from trainer.commands import experiment
from trainer.experiments import timing
from trainer.experiments.catalogue import EXPERIMENTS, NAMES
from trainer.experiments.summary import CLAIMS, UNITS
from trainer.tests.experiments import TINY
from trainer.tests.test_commands import call


@pytest.fixture
def places(tmp_path):
    directories = {name: str(tmp_path / name) for name in ("results", "runs")}
    return [word for name, path in directories.items() for word in (f"--{name}", path)]


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("fig6",),
        ("fig7", "--seeds", "0"),
        ("fig7", "--jobs", "-1"),
        ("fig7", "--max-minutes", "0"),
        ("fig7", "--device", "abacus"),
        ("fig7", "--scenario", "roundabout"),
        ("status", "--scenario", "left_turn"),
        ("table2", "--scenario", "left_turn"),
        ("time", "--scenario", "congestion"),
        ("summary",),
        ("status", "summary"),
        ("fig7", "--seeds", "99999999"),
        ("fig7", "--humans", "nowhere"),
        ("fig7", "--draw-only"),  # from no results at all
    ],
    ids=" ".join,
)
def test_bad_input_gets_one_line_and_status_2(arguments, capsys, places):
    status, out, err = call(capsys, "experiment", *arguments, *places)
    assert (status, out, len(err.strip().splitlines())) == (2, "", 1)


def test_every_figure_and_table_of_the_paper_has_a_name():
    figures = {f"fig{number}" for number in range(7, 16)}
    assert figures | {"table1", "table2", "time", "ablation"} <= set(NAMES)
    assert set(NAMES) == {*EXPERIMENTS, "time"}


def test_everything_can_be_drawn_from_nothing(capsys, places, tmp_path):
    (tmp_path / "results").mkdir()
    places_of_tables = "".join(f"{place.begin}\n{place.end}\n" for place in (UNITS, CLAIMS))
    (tmp_path / "results" / "README.md").write_text(places_of_tables)
    status, out, _ = call(capsys, "experiment", "all", "--draw-only", *places)
    assert status == 0
    for name in NAMES:
        directory = tmp_path / "results" / "experiments" / name
        assert (directory / f"{name}.png").stat().st_size > 1000
        verdict = json.loads((directory / "verdict.json").read_text())
        assert {one["holds"] for one in verdict["claims"]} == {"undecided"}
        assert f"{name}: " in out
    assert (tmp_path / "results" / "README.md").read_text().count("[fig") == 9
    assert not (tmp_path / "runs").exists()


def test_status_counts_the_units_and_says_what_stands_in_the_way(capsys, places):
    status, out, err = call(capsys, "experiment", "status", "--seeds", "2", *places)
    assert status == 0
    rows = {line.split("│")[1].strip(): line for line in out.splitlines() if line.startswith("│")}
    assert set(rows) == {*NAMES, "all, each once"}
    counts = [int(word) for word in rows["table1"].replace("│", " ").split() if word.isdigit()]
    assert sum(counts) == 1 + 3 * 2
    assert "python -m trainer human --scenario left_turn" in err


def test_units_are_computed_in_processes_and_never_twice(capsys, places, tmp_path, monkeypatch):
    """Vanilla TD3 needs no human: of fig. 7 it is what can be computed here."""
    monkeypatch.setattr(experiment, "PLAN", TINY)
    command = ("experiment", "fig7", "--scenario", "left_turn", "--seeds", "1", "--jobs", "2")
    command = (*command, *places)
    status, out, err = call(capsys, *command)
    assert status == 0
    assert "left out: 3 units, since there is no human model" in err
    assert re.search(
        r"fig7: 1 of 8 units; claims: \d+ undecided: ", out
    )  # and none of them decided
    (result,) = (tmp_path / "results" / "units").rglob("tests.json")
    before = result.stat().st_mtime_ns
    status, out, _ = call(capsys, *command)
    assert (status, result.stat().st_mtime_ns) == (0, before)


def test_time_is_measured_once_in_turns(capsys, places, tmp_path, monkeypatch):
    plan = replace(TINY, timed_steps=20, turn_steps=5)
    monkeypatch.setattr(timing, "PAPER_S", {"ia_td3": 348.71, "phil_td3": 360.7, "per_td3": 329.39})
    monkeypatch.setattr(experiment, "PLAN", plan)
    monkeypatch.setattr(timing, "run_config", _guided_by_the_expert)
    for _ in range(2):
        assert call(capsys, "experiment", "time", *places)[0] == 0
        path = tmp_path / "results" / "experiments" / "time" / "measured.json"
        measured = json.loads(path.read_text())
    turns = measured["turns"]
    assert set(turns) == {"ia_td3", "phil_td3", "per_td3"}
    assert len({len(each) for each in turns.values()}) == 1
    assert all(steps >= 5 and seconds > 0.0 for each in turns.values() for steps, seconds in each)
    assert all(sum(steps for steps, _ in each) >= 20 for each in turns.values())
    assert measured["threads"] == 1
    monkeypatch.setattr(timing, "measure", lambda *_: pytest.fail("measured again"))
    assert call(capsys, "experiment", "time", *places)[0] == 0


def _guided_by_the_expert(unit, plan, humans, device):
    from trainer.experiments.units import run_config

    config = run_config(replace(unit, algorithm="per_td3"), plan, humans, device)
    return replace(config, algorithm=unit.algorithm)


def test_ray_that_is_not_installed_is_said_in_one_line(capsys, places, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    status, _, err = call(capsys, "experiment", "fig7", "--ray", "auto", *places)
    assert status == 2
    assert err.strip() == "error: --ray needs Ray: python -m pip install '.[ray]'"
