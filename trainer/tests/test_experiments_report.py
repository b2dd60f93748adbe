"""Records out of the air, judged, drawn and reported; and the command around it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.cli import run_cli
from edge_runtime.util import UserError
from trainer.__main__ import main
from trainer.experiments import claims
from trainer.experiments.claims import (
    CLAIMS,
    HI,
    IA,
    PER,
    PHIL,
    Claim,
    ahead,
    first_reached,
    judge,
    judge_both,
    level,
    sooner,
    sooner_by,
)
from trainer.experiments.data import (
    ALONE,
    DISTANCE,
    SUCCESS,
    TRAINING,
    Estimate,
    Holds,
    Line,
    Scene,
    above,
    all_of,
    load,
    mean_estimate,
    within,
)
from trainer.experiments.plan import EXPERIMENTS, NORMAL, PAPER_TESTS, Unit, units_of
from trainer.experiments.report import write_report
from trainer.tests.experiments import UNIT, results_of, store_in, synthetic, write_human

SEEDS = 3
LEFT = Scene("left_turn", "nominal")


@pytest.fixture(scope="module")
def everything():
    return results_of(units_of(["all"], SEEDS), SEEDS)


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr(claims, "RESAMPLES", 200)


def finding(results, test, ours, others, bar=0.0):
    """Of success in the left turn."""
    claim = Claim("fig7", "", "", test, ["left_turn"], [ours], others, [SUCCESS], bar)
    return judge(results, claim, ALONE)


class TestStatistics:
    def test_an_interval_as_in_the_tables(self):
        found = mean_estimate([1.0, 2.0, 3.0])
        assert found[:3] == pytest.approx((2.0, 2.0 - 4.302653 / 3**0.5, 2.0 + 4.302653 / 3**0.5))
        assert mean_estimate([]).size == 0
        assert np.isinf(mean_estimate([1.0]).high)

    @given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=9), st.floats(-1e3, 1e3))
    def test_a_verdict_never_says_both(self, values, least):
        found = mean_estimate(values)
        assert (found.low <= found.value <= found.high) or len(set(values)) == 1
        opposite = {"yes": "no", "no": "yes", "undecided": "undecided"}
        assert above(found.times(-1.0), -least) == opposite[above(found, least)]

    @pytest.mark.parametrize(
        ("low", "high", "holds"),
        [(-0.5, 0.5, "yes"), (-0.5, 1.5, "undecided"), (1.5, 2.0, "no"), (-3.0, -1.5, "no")],
    )
    def test_one_level(self, low, high, holds):
        assert within(Estimate(0.5 * (low + high), low, high, 5), 1.0) == holds

    @pytest.mark.parametrize(
        ("answers", "holds"),
        [("yy", "yes"), ("yu", "undecided"), ("nu", "no"), ("", "undecided")],
    )
    def test_all_of_several(self, answers, holds):
        said: dict[str, Holds] = {"y": "yes", "n": "no", "u": "undecided"}
        assert all_of([said[answer] for answer in answers]) == holds


class TestData:
    def test_curves_lie_on_multiples_of_500_steps(self, everything):
        (result,) = everything.of("left_turn", PHIL)[:1]
        curve = result.curve(TRAINING, DISTANCE)
        assert len(curve) == 12
        steps, values = result.points(TRAINING, DISTANCE)
        assert curve[1] == pytest.approx(values[(steps > 500) & (steps <= 1000)].mean())
        assert result.end(TRAINING, DISTANCE) == pytest.approx(values[steps > 4500].mean())

    def test_distances_end_at_the_goal(self, everything):
        assert everything.pooled(LEFT, PHIL, DISTANCE).max() == 21.0

    def test_the_papers_drives_are_the_first_ones(self, everything):
        (result,) = everything.of("left_turn", Line("human_model"))
        own = everything.pooled(LEFT, Line("human_model"), DISTANCE, paper=True)
        assert own.tolist() == result.drives("nominal", DISTANCE)[:PAPER_TESTS].tolist()

    def test_time_is_compared_where_both_arrive(self, everything):
        found = everything.differences(LEFT, PHIL, IA, "time_s")
        one, other = everything.of("left_turn", PHIL)[0], everything.of("left_turn", IA)[0]
        both = one.reached("nominal") & other.reached("nominal")
        assert 0 < both.sum() < len(both)
        times = one.drives("nominal", "time_s") - other.drives("nominal", "time_s")
        assert found[1] == pytest.approx(times[both].mean())


class TestClaims:
    def test_who_is_ahead_and_who_is_not(self, everything):
        assert finding(everything, ahead, PHIL, [IA, HI, PER]).holds == "yes"
        found = finding(everything, ahead, PER, [HI])
        assert found.holds == "no"
        assert "vanilla TD3 over HI-TD3" in found.ours
        assert finding(everything, level, PHIL, [PHIL]).holds == "yes"
        assert finding(everything, level, PHIL, [PER]).holds == "no"
        assert finding(everything, ahead, PHIL, [None], bar=0.5).holds == "yes"

    def test_missing_trainings_leave_it_open(self):
        results = results_of([unit for unit in units_of(["fig7"], SEEDS) if unit != UNIT], SEEDS)
        for other, holds in ((PER, "undecided"), (IA, "yes")):
            assert finding(results, ahead, PHIL, [other]).holds == holds

    def test_how_much_sooner(self):
        """Straight lines, so that the steps can be worked out by hand: the other ends at 0.875."""
        units = [Unit("left_turn", name, NORMAL, 1) for name in ("phil_td3", "per_td3")]
        results = results_of(units, 1)
        for unit, end in zip(units, (2_000, 6_000), strict=True):
            columns = results.found[unit].record["validation"]
            columns["at_step"] = list(range(500, 6_001, 500))
            columns["success"] = [min(step / end, 1.0) for step in columns["at_step"]]
        own, other = (results.of("left_turn", line) for line in (PHIL, PER))
        for first, second in ((own, other), (own, own)):
            level_at = second[0].end(ALONE, SUCCESS)
            found, said = sooner_by(first, second, ALONE, SUCCESS)
            steps = (2_000 * level_at, (6_000 if second is other else 2_000) * level_at)
            assert found.value == pytest.approx(steps[1] / steps[0])
            assert said == f"{steps[0]:,.0f} against {steps[1]:,.0f} steps"
        found, said = sooner_by(other, own, ALONE, SUCCESS)
        assert found.value == pytest.approx(2_000 / 6_000)
        other[0].record["validation"]["success"] = [0.1] * 12
        assert sooner_by(other, own, ALONE, SUCCESS)[1] == "never against 2,000 steps"
        assert sooner_by(other, own, ALONE, SUCCESS, common=True)[1] == "500 against 500 steps"

    def test_it_takes_several_seeds_to_be_sooner(self, everything):
        assert finding(everything, sooner, PHIL, [PER]).holds == "yes"
        assert finding(everything, sooner, PHIL, [PER], bar=50.0).holds == "no"

    @given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12), st.floats(0.0, 1.0))
    def test_a_level_is_reached_where_the_curve_crosses_it(self, values, least):
        grid = 500.0 * np.arange(1, len(values) + 1, dtype=np.float64)
        curve = np.array(values, np.float64)
        steps = first_reached(grid, curve, least)
        if np.isinf(steps):
            assert curve.max() < least
        else:
            assert np.interp(steps, grid, curve) == pytest.approx(least, abs=1e-6) or steps == 500.0
            assert (curve[grid < steps] <= least).all()
            assert steps <= first_reached(grid, curve, min(least + 0.1, 1.0))

    def test_every_claim_is_judged(self, everything):
        for claim in CLAIMS:
            assert claim.source in EXPERIMENTS
            for found in filter(None, judge_both(everything, claim)):
                assert found.holds in ("yes", "no", "undecided")
                assert found.ours not in ("", "not measured")

    def test_nothing_is_said_of_nothing(self):
        results = results_of([], SEEDS)
        assert {judge_both(results, claim)[0].holds for claim in CLAIMS} == {"undecided"}


@pytest.fixture
def store(tmp_path):
    """Records of the first four lines of the left turn, as the runs would have written them."""
    store = store_in(tmp_path)
    write_human(store)
    for unit in units_of(["fig9", "fig7"], 2, "left_turn"):
        store.put(unit, {**synthetic(unit), "id": store.id(unit)})
    return store


def test_the_report_is_made_of_the_records_alone(store):
    page = write_report(store, 2).read_text()
    for name in re.findall(r"\((\w+\.png)\)", page):
        assert (store.results / name).stat().st_size > 1000
    rows = [line for line in page.splitlines() if line.startswith("| left turn: PHIL-TD3")]
    assert len(rows) == sum(claim.text.startswith("left turn: PHIL-TD3") for claim in CLAIMS)
    assert any("| yes |" in row for row in rows)
    anchors = {f"#{re.sub('[^a-z0-9 -]', '', line[3:].lower()).replace(' ', '-')}"
               for line in page.splitlines() if line.startswith("## ")}  # fmt: skip
    assert set(re.findall(r"\((#[^)]*)\)", page)) <= anchors
    assert "20.70±1.82" in page
    assert str(store.results.parent) not in page


def test_records_of_other_settings_are_left_out(store):
    unit = Unit("left_turn", "ia_td3", NORMAL, 2)
    store.put(unit, {**synthetic(unit), "id": "of another time"})
    results = load(store, 2)
    assert results.stale == [unit]
    assert not results.complete("left_turn", IA, DISTANCE)


def test_records_that_lack_something_are_refused(store):
    unit = Unit("left_turn", "ia_td3", NORMAL, 2)
    record = {**synthetic(unit), "id": store.id(unit)}
    del record["validation"]["success"]
    store.put(unit, record)
    with pytest.raises(UserError, match="lacks columns of validation"):
        load(store, 2)


class TestCommand:
    def said(self, capsys, *arguments):
        status = run_cli(main, ["experiment", *map(str, arguments)])
        return status, capsys.readouterr()

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["fig99"], "invalid choice"),
            (["fig7", "--seeds", "0"], "--seeds"),
            (["report", "status"], "stand alone"),
            (["table1", "--scenario", "congestion"], "nothing to compute"),
            (["report", "--results", "nowhere"], "no results"),
        ],
    )
    def test_bad_input_is_one_line(self, capsys, arguments, words):
        try:
            status, said = self.said(capsys, *arguments)
        except SystemExit as ending:
            status, said = ending.code, capsys.readouterr()
        assert status == 2
        assert words in said.err.splitlines()[-1]

    def test_status_counts_the_units(self, capsys, store):
        places = [
            word
            for name in ("results", "runs", "humans")
            for word in (f"--{name}", getattr(store, name))
        ]
        status, said = self.said(capsys, "status", "--seeds", 2, *places)
        assert status == 0
        # They are of another plan: done for it, and of other settings for the command's.
        last = said.out.splitlines()[-1]
        assert last.startswith("0 of ")
        assert "; 10 records of other settings" in last

    def test_without_its_human_a_unit_is_left_out(self, capsys, tmp_path):
        status, said = self.said(
            capsys, "table1", "--humans", tmp_path, "--results", tmp_path, "--runs", tmp_path
        )
        assert status == 0
        assert "no human model" in said.err
        assert "0 of 16 units were done" in said.out


def test_stopping_soon_leaves_it_to_the_same_command(tmp_path, capsys):
    store = store_in(tmp_path)
    write_human(store)
    arguments = ["experiment", "fig7", "--scenario", "left_turn", "--seeds", "1", "--quick",
                 "--max-minutes", "0.0001", "--humans", str(store.humans),
                 "--runs", str(store.runs)]  # fmt: skip
    assert main(arguments) == 0
    assert "the same command goes on" in capsys.readouterr().out
    assert not (store.runs / "quick/results/left_turn.jsonl").exists()


PAPER = Path(__file__).parents[2] / "results" / "paper"


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
def test_each_record_lies_in_its_scenarios_file_once(scenario):
    records = list(map(json.loads, (PAPER / f"{scenario}.jsonl").read_text().splitlines()))
    assert {record["unit"]["scenario"] for record in records} == {scenario}
    assert len({record["id"] for record in records}) == len(records)
