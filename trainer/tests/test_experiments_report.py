import re
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.statistics import Estimate, mean_estimate
from hil_tests.testing.commands import call
from trainer.experiments import claims, data, report
from trainer.experiments.guidance import (
    best_by_rule,
    forgiven,
    learns,
    outcomes,
    place_columns,
    typical_curves,
)
from trainer.experiments.plan import EXPERIMENTS, NORMAL, PAPER_TESTS, Unit, units_of
from trainer.experiments.report import _cost, write_report
from trainer.tests.experiments import UNIT, results_of, store_in, synthetic, write_human

SEEDS = 3
CONSTANT = data.Line("constant")
LEFT = data.Scene("left_turn", "nominal")


@pytest.fixture(scope="module")
def everything():
    return results_of(units_of(["all"], SEEDS), SEEDS)


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr(claims, "RESAMPLES", 200)


def finding(results, test, ours, others, bar=0.0):
    """Of success in the left turn."""
    claim = claims.Claim("fig7", "", "", test, ["left_turn"], [ours], others, [data.SUCCESS], bar)
    return claims.judge(results, claim, data.ALONE)


class TestStatistics:
    def test_an_interval_as_in_the_tables(self):
        found, half = mean_estimate([1.0, 2.0, 3.0]), 4.302653 / 3**0.5
        assert found[:3] == pytest.approx((2.0, 2.0 - half, 2.0 + half))
        assert mean_estimate([]).size == 0
        assert np.isinf(mean_estimate([1.0]).high)

    @given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=9), st.floats(-1e3, 1e3))
    def test_a_verdict_never_says_both(self, values, least):
        found = mean_estimate(values)
        assert (found.low <= found.value <= found.high) or len(set(values)) == 1
        opposite = {"yes": "no", "no": "yes", "undecided": "undecided"}
        assert data.above(found.times(-1.0), -least) == opposite[data.above(found, least)]

    def test_one_level_and_all_of_several(self):
        spans = [(-0.5, 0.5), (-0.5, 1.5), (1.5, 2.0), (-3.0, -1.5)]
        found = [data.within(Estimate(0.5 * sum(ends), *ends, 5), 1.0) for ends in spans]
        assert found == ["yes", "undecided", "no", "no"]
        answers: list[list[data.Holds]]
        answers = [["yes", "yes"], ["yes", "undecided"], ["no", "undecided"], []]
        assert list(map(data.enough_of, answers)) == ["yes", "undecided", "no", "undecided"]


class TestData:
    def test_curves_lie_on_multiples_of_500_steps(self, everything):
        result = everything.of("left_turn", claims.PHIL)[0]
        curve, (steps, values) = (
            found(data.TRAINING, data.DISTANCE) for found in (result.curve, result.points)
        )
        assert len(curve) == 12
        assert curve[1] == pytest.approx(values[(steps > 500) & (steps <= 1000)].mean())
        end = result.end(data.TRAINING, data.DISTANCE)
        assert end == pytest.approx(values[steps > 4500].mean())

    def test_typical_curves_are_the_medians_of_the_seeds_that_a_human_guided(self, everything):
        curves = typical_curves(everything, NORMAL)
        assert set(curves) == {"left_turn", "congestion"}
        assert not {"constant", "human_model"} & set(curves["left_turn"])
        curve = curves["left_turn"]["phil_td3"]
        found = everything.of("left_turn", claims.PHIL)
        given, alone = zip(*curve["points"], strict=True)
        assert (curve["seeds"], len(given)) == (SEEDS, 12)
        assert given[-1] == pytest.approx(np.median([one.costs.human_s for one in found]), abs=0.1)
        ends = [one.curve(data.ALONE, data.SUCCESS)[-1] for one in found]
        assert alone[-1] == pytest.approx(np.median(ends), abs=1e-3)

    def test_a_row_of_the_fair_table_is_placed_beside_phil_td3_seed_by_seed(self):
        rows = "phil_td3", "hi_td3"
        units = [Unit("left_turn", row, "good", seed) for row in rows for seed in (1, 2, 3)]
        results = results_of(units, SEEDS)
        phil, hi = (results.of("left_turn", data.Line(row, "good")) for row in rows)
        over, seconds, less = (cell(hi) for cell in place_columns(results).values())
        points = [100.0 * (b.mean("nominal", "success") - a.mean("nominal", "success"))
                  for a, b in zip(phil, hi, strict=True)]  # fmt: skip
        assert over == mean_estimate(points).text(1)
        # HI-TD3 never gets to 90 %, PHIL-TD3 in each of its seeds.
        assert not any(one.until(0.9) for one in hi)
        assert (seconds, less) == ("∞ [∞, ∞]", "0 of 3")
        itself = [cell(phil) for cell in place_columns(results).values()]
        assert itself == ["0.0 [0.0, 0.0]", "0 [0, 0]", "0 of 3"]
        alone = place_columns(results_of(units[3:], SEEDS)).values()
        assert [cell(hi) for cell in alone] == ["–", "–", "0 of 0"]
        for one in phil:
            one.record["validation"]["success"] = [0.0] * 12
        assert [cell(hi) for cell in place_columns(results).values()][1:] == ["–", "0 of 3"]

    @pytest.mark.parametrize(
        ("cheaper", "behind", "default"),
        [(10, 0, "hi_td3"), (9, 0, "hi_td3"), (8, 0, "phil_td3"), (10, 1, "phil_td3")],
    )
    def test_a_row_becomes_the_default_that_costs_less_and_is_nowhere_behind(
        self, cheaper, behind, default
    ):
        scenes = "left_turn", "congestion"
        rows = "phil_td3", "hi_td3"
        units = [
            Unit(*each) for row in rows for each in product(scenes, [row], ["good"], range(1, 6))
        ]
        results = results_of(units, 5)
        for place, unit in enumerate(units):
            record = results.found[unit].record
            record["validation"]["success"] = [0.0] + [1.0] * 11  # both reach it at once
            ours = unit.algorithm == "hi_td3"
            steps = 2 if ours and place - 10 < cheaper else 3  # the human's, in each episode
            record["training"]["human_steps"] = [steps] * len(record["training"]["human_steps"])
            for condition in ("nominal", "noise", "variant"):
                fails = ours and behind and (condition, unit.scenario) == ("variant", "congestion")
                record["tests"][condition]["outcome"] = ["collision" if fails else "goal"] * 60
        assert best_by_rule(results, ["hi_td3"]) == default

    def test_a_row_forgives_a_human_beside_whom_it_still_succeeds(self):
        rows, humans = ("phil_td3", "hi_td3"), ("good", "slower")
        units = [Unit("left_turn", *each, 1) for each in product(rows, humans)]
        results = results_of(units, 1)
        for unit, record in ((unit, results.found[unit].record) for unit in units):
            fails = unit.algorithm == "hi_td3" and unit.setting == "slower"
            failed = [6, 24][fails]  # of 60
            outcomes_ = ["collision"] * failed + ["goal"] * (60 - failed)
            record["tests"]["nominal"]["outcome"] = outcomes_
            record["validation"]["success"] = [1.0] * 12
        said = forgiven(results)
        assert said.endswith(": PHIL-TD3. Less beside some: HI-TD3 (slower 60.0).")
        assert [learns(results, row) for row in ("phil_td3", "ppl_td3")] == [True, False]

    def test_a_row_is_held_against_the_human_that_guided_it(self):
        units = [Unit("left_turn", *each) for each in (
            ("phil_td3", "slower", 1), ("phil_td3", "late", 1),
            ("expert", "slower", 0), ("expert", "good", 0),
        )]  # fmt: skip
        results = results_of(units, 1)
        rewards = dict(zip(units, (5.0, 5.0, 3.0, 9.0), strict=True))
        for unit, reward in rewards.items():
            results.found[unit].record["tests"]["nominal"]["reward"] = [reward] * 60
        (cell,) = [cell for title, cell in outcomes(results).items() if "return" in title]
        assert [cell([results.found[unit]]) for unit in units] == ["2.00", "-4.00", "-6.00", "0.00"]

    def test_distances_end_at_the_goal_and_the_papers_drives_are_the_first(self, everything):
        assert everything.pooled(LEFT, claims.PHIL, data.DISTANCE).max() == 21.0
        (result,) = everything.of("left_turn", data.Line("human_model"))
        own = everything.pooled(LEFT, data.Line("human_model"), data.DISTANCE, paper=True)
        assert own.tolist() == result.drives("nominal", data.DISTANCE)[:PAPER_TESTS].tolist()

    def test_time_is_compared_where_both_arrive(self, everything):
        found = everything.differences(LEFT, claims.PHIL, claims.IA, "time_s")
        one, other = (everything.of("left_turn", each)[0] for each in (claims.PHIL, claims.IA))
        both = one.reached("nominal") & other.reached("nominal")
        assert 0 < both.sum() < len(both)
        times = one.drives("nominal", "time_s") - other.drives("nominal", "time_s")
        assert found[1] == pytest.approx(times[both].mean())


class TestClaims:
    @pytest.mark.parametrize(
        ("test", "ours", "others", "bar", "holds"),
        [
            (claims.ahead, claims.PHIL, [claims.IA, claims.HI, claims.PER], 0.0, "yes"),
            (claims.ahead, claims.PER, [claims.HI], 0.0, "no"),
            (claims.level, claims.PHIL, [claims.PHIL], 0.0, "yes"),
            (claims.level, claims.PHIL, [claims.PER], 0.0, "no"),
            (claims.ahead, claims.PHIL, [None], 0.5, "yes"),
            (claims.sooner, claims.PHIL, [claims.PER], 0.0, "yes"),
        ],
    )
    def test_who_is_ahead_or_sooner_and_who_is_not(
        self, everything, test, ours, others, bar, holds
    ):
        found = finding(everything, test, ours, others, bar)
        assert found.holds == holds
        assert ("vanilla TD3 minus HI-TD3" in found.text) == (ours is claims.PER)

    def test_missing_trainings_leave_it_open(self):
        results = results_of([unit for unit in units_of(["fig7"], SEEDS) if unit != UNIT], SEEDS)
        for other, holds in ((claims.PER, "undecided"), (claims.IA, "yes")):
            assert finding(results, claims.ahead, claims.PHIL, [other]).holds == holds

    def test_how_much_sooner(self):
        """Straight lines, so that the steps can be worked out by hand: the other ends at 0.875."""

        def sooner_by(ours, theirs, **how):
            found, said = claims.sooner_by(ours, theirs, data.ALONE, data.SUCCESS, **how)
            return found.value, said

        units = [Unit("left_turn", name, NORMAL, 1) for name in ("phil_td3", "per_td3")]
        results = results_of(units, 1)
        for unit, end in zip(units, (2_000, 6_000), strict=True):
            columns = results.found[unit].record["validation"]
            columns["at_step"] = list(range(500, 6_001, 500))
            columns["success"] = [min(step / end, 1.0) for step in columns["at_step"]]
        own, other = (results.of("left_turn", line) for line in (claims.PHIL, claims.PER))
        least = other[0].end(data.ALONE, data.SUCCESS)
        said = f"{2_000 * least:,.0f} against {6_000 * least:,.0f} steps"
        assert sooner_by(other, own)[0] == pytest.approx(2_000 / 6_000)
        assert sooner_by(own, own) == (pytest.approx(1.0), "2,000 against 2,000 steps")
        assert sooner_by(own, other) == (pytest.approx(3.0), said)
        other[0].record["validation"]["success"] = [0.1] * 12
        ratio, said = sooner_by(other, own)
        assert (np.isnan(ratio), said) == (True, "over 6,000 against 2,000 steps")
        both = sooner_by(other, own, common=True)[1]
        assert both == "within 500 against within 500 steps"
        assert sooner_by(own, own, level=0.5) == (1.0, "1,000 against 1,000 steps")

    @pytest.mark.parametrize(
        ("own", "other", "bar", "holds"),
        [
            (0, 2_000, 1.0, "yes"),  # There at 500 or before: 4 times as soon, if not more
            (0, 2_000, 50.0, "undecided"),
            (2_000, 4_000, 50.0, "no"),
            (0, 0, 1.0, "undecided"),
            (7_000, 2_000, 1.0, "no"),  # Never: in less than a third of the time at best
        ],
    )
    def test_what_happens_before_the_first_look_or_after_the_last_has_bounds(
        self, own, other, bar, holds
    ):
        units = [
            Unit("left_turn", name, NORMAL, s) for name in ("phil_td3", "per_td3") for s in (1, 2)
        ]
        results = results_of(units, 2)
        for line, when in ((claims.PHIL, own), (claims.PER, other)):
            for result in results.of("left_turn", line):
                columns = result.record["validation"]
                columns["at_step"] = list(range(500, 6_001, 500))
                columns["success"] = [0.2 + 0.8 * (step >= when) for step in columns["at_step"]]
        assert finding(results, claims.sooner, claims.PHIL, [claims.PER], bar).holds == holds

    @given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12), st.floats(0.0, 1.0))
    def test_a_level_is_reached_where_the_curve_crosses_it(self, values, least):
        grid = 500.0 * np.arange(1, len(values) + 1, dtype=np.float64)
        curve = np.array(values, np.float64)
        low, high = claims.first_reached(grid, curve, least)
        if np.isinf(high):
            assert (low, curve.max() < least) == (grid[-1], True)
        elif low == 0.0:
            assert (high, curve[0] >= least - 1e-9) == (500.0, True)
        else:
            assert low == high
            assert np.interp(low, grid, curve) == pytest.approx(least, abs=1e-6)
            assert (curve[grid < low] <= least).all()
            assert high <= claims.first_reached(grid, curve, min(least + 0.1, 1.0)).high

    def test_every_claim_is_judged_and_nothing_is_said_of_nothing(self, everything):
        results = results_of([], SEEDS)
        for claim in (*claims.CLAIMS, *claims.AS_PRINTED, *claims.GOALS):
            assert claim.source in EXPERIMENTS
            for found in filter(None, claims.judge_both(everything, claim)):
                assert found.holds in ("yes", "no", "undecided")
                assert found.text not in ("", "not measured")
            nothing = claims.judge_both(results, claim)[0]
            assert (nothing.text, nothing.holds) == ("not measured", "undecided")

    @pytest.mark.parametrize(("enough", "holds"), [(0, "no"), (1, "yes"), (2, "yes"), (3, "no")])
    def test_a_claim_holds_where_enough_of_its_comparisons_do(self, everything, enough, holds):
        claim = claims.Claim(
            "fig9", "", "", claims.ahead, [LEFT], [claims.HI], [claims.PHIL, claims.PER, CONSTANT],
            [data.SUCCESS], enough=enough,
        )  # fmt: skip
        found = claims.judge(everything, claim, data.ALONE)
        assert (found.holds, found.text[:13]) == (holds, "2 of 3 hold; ")
        assert ("minus PHIL-TD3" in found.text) == (holds == "no")

    @given(st.lists(st.sampled_from(["yes", "no", "undecided"]), max_size=6), st.integers(1, 6))
    def test_what_is_missing_can_only_decide_what_was_undecided(self, answers, count):
        before = data.enough_of([*answers, "undecided"], count)
        after = {data.enough_of([*answers, answer], count) for answer in ("yes", "no")}
        assert before == "undecided" or after == {before}


@pytest.fixture
def store(tmp_path):
    """Records of the first four lines of the left turn, as the runs would have written them."""
    store = store_in(tmp_path)
    write_human(store)
    for unit in units_of(["fig9", "fig7"], 2, "left_turn"):
        store.put(unit, {**synthetic(unit), "id": store.id(unit)})
    return store


def test_the_page_says_when_a_policy_was_learned_and_how_much_it_lost_again():
    unit = Unit("left_turn", "phil_td3", NORMAL, 1)
    results = results_of([unit], 1)
    record = results.found[unit].record
    success = [0.4, 0.8, 1.0, *[1.0] * 6, 1.0, 0.9, 0.8]
    record["validation"].update(at_step=list(range(500, 6_001, 500)), success=success)
    outcomes = ["collision"] * 7 + ["goal"] * 3
    record["training"].update(
        human_steps=[1200, 34, *[0] * 8], takeovers=[50, 6, *[0] * 8], outcome=outcomes,
        end_step=[600 * number for number in range(1, 11)],
    )  # fmt: skip
    (row,) = [line for line in _cost(results) if line.startswith("| PHIL-TD3 |")]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    # The policy alone is above 98 % in the validation after 1,500 steps: the human has given both
    # of the first two episodes by then, all that there is.
    until = ["1,500 [1,500, 1,500]", *["123 [123, 123]"] * 2]
    costs = ["10.0", "10.0", "1,234", "56", "7", "6,000"]
    assert cells[1:] == ["left turn", "1", *until, *costs]


def test_a_seed_that_never_learned_costs_more_than_any_other():
    units = [Unit("left_turn", "phil_td3", NORMAL, seed) for seed in (1, 2, 3)]
    results = results_of(units, 3)
    for unit in units:
        columns = results.found[unit].record["validation"]
        columns["success"] = [float(unit.seed < 3 and n >= unit.seed) for n in range(12)]
    found = results.of("left_turn", claims.PHIL)
    assert report.until(0.9, "steps")(found) == "1,520 [1,020, ∞] (2 of 3)"
    assert report.until(0.9, "steps")(found[1:]) == "∞ [1,520, ∞] (1 of 2)"
    assert report.until(0.9, "steps")(found[:2]) == "1,520 [1,020, 1,520]"
    assert report.until(0.9, "steps")(found[2:]) == "never"
    assert report.spread([-0.3, -3.0, np.inf]) == "0 [-3, ∞]"


def test_the_page_says_in_what_and_where_the_trainings_were_computed():
    units = [Unit("left_turn", "phil_td3", NORMAL, seed) for seed in (1, 2, 3)]
    results = results_of(units, 3)
    _, second, third = (results.found[unit].record["computed"] for unit in units)
    second.update(bfloat16=True)
    third.update(bfloat16=True, gpu="H100")
    said = report.computed_in(results, [claims.PHIL])
    assert said == "1 float32, 1 bfloat16, 1 bfloat16 on a GPU"


def test_the_report_is_made_of_the_records_alone(store, monkeypatch):
    write = report.write_figure

    def write_one(figure, path):  # All are drawn; to lay one out as pixels takes most of a second.
        return write(figure, path) if path.name == "fig7.png" else path.write_bytes(bytes(1001))

    monkeypatch.setattr(report, "write_figure", write_one)
    page = write_report(store, 2).read_text()
    for name in re.findall(r"\((\w+\.png)\)", page):
        assert (store.results / name).stat().st_size > 1000
    rows = [line for line in page.splitlines() if line.startswith("| left turn: PHIL-TD3")]
    assert len(rows) == sum(claim.text.startswith("left turn: PHIL-TD3") for claim in claims.CLAIMS)
    assert any("| yes |" in row for row in rows)
    anchors = {f"#{re.sub('[^a-z0-9 -]', '', line[3:].lower()).replace(' ', '-')}"
               for line in page.splitlines() if line.startswith("## ")}  # fmt: skip
    assert set(re.findall(r"\((#[^)]*)\)", page)) <= anchors
    assert "20.70±1.82" in page
    assert "| `return_steps` | 8 | 1 |" in page
    assert str(store.results.parent) not in page


def test_records_of_other_settings_are_left_out(store):
    unit = Unit("left_turn", "ia_td3", NORMAL, 2)
    store.put(unit, {**synthetic(unit), "id": "of another time"})
    results = data.load(store, 2)
    assert results.stale == [unit]
    assert not results.complete("left_turn", claims.IA, data.DISTANCE)


def said(capsys, *arguments):
    return call(capsys, "experiment", *map(str, arguments))


def test_status_counts_the_units(capsys, store):
    places = ("--results", store.results, "--runs", store.runs, "--humans", store.humans)
    status, out, _ = said(capsys, "status", "--seeds", 2, *places)
    assert status == 0
    # They are of another plan: done for it, and of other settings for the command's.
    last = out.splitlines()[-1]
    assert last.startswith("0 of ")
    assert "; 10 records of other settings" in last
    status, out, _ = said(capsys, "status", "guidance", *places)
    assert (status, "0 of 482 units done" in out, "pvp_td3" in out) == (0, True, True)
    status, out, _ = said(capsys, "status", "guidance", "--scenario", "hill", *places)
    assert (status, "0 of 34 units done" in out, "left_turn" in out) == (0, True, False)


def test_without_its_human_a_unit_is_left_out(capsys, tmp_path):
    places = ("--humans", tmp_path, "--results", tmp_path, "--runs", tmp_path)
    status, out, err = said(capsys, "table1", *places)
    assert status == 0
    assert "no human model" in err
    assert "0 of 16 units were there already" in out


def test_an_experiment_ends_with_its_data_figures_and_verdicts(tmp_path, capsys):
    more = ("--quick", "--scenario", "left_turn", "--runs", tmp_path)
    status, out, _ = said(capsys, "floor", *more)
    results = tmp_path / "quick/results"
    assert (status, out.splitlines()[-1]) == (0, f"wrote {results / 'README.md'}")
    assert len((results / "left_turn.jsonl").read_text().splitlines()) == 1
    page = (results / "README.md").read_text()
    assert "constant actions in the left turn is" in page
    assert "| [fig7](#fig7" in page
    assert (results / "fig7.png").stat().st_size > 1000


def test_stopping_soon_leaves_it_to_the_same_command(tmp_path, capsys):
    store = store_in(tmp_path)
    write_human(store)
    more = ("--quick", "--max-minutes", 0.0001, "--humans", store.humans, "--runs", store.runs)
    status, out, _ = said(capsys, "fig7", "--scenario", "left_turn", "--seeds", 1, *more)
    assert status == 0
    assert "the same command goes on" in out
    assert not (store.runs / "quick/results/left_turn.jsonl").exists()
