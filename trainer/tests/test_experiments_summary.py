"""Verdicts on disk, and the summary of them all."""

import json
from dataclasses import replace

import numpy as np
import pytest

from edge_runtime.errors import UserError
from trainer.experiments import unit_table
from trainer.experiments.gathered import Gathered
from trainer.experiments.statistics import Estimate, Holds
from trainer.experiments.summary import CLAIMS, claim_lines, count_lines, has_place, write_table
from trainer.experiments.units import Unit
from trainer.experiments.verdict import BAR, claim, markdown, verdict_of, write_verdict
from trainer.tests.experiments import store_in
from trainer.tests.synthetic import outcome


def test_a_verdict_is_written_for_programs_and_for_people(tmp_path):
    there, missing = (Unit("left_turn", name, "normal", 1) for name in ("phil_td3", "hi_td3"))
    made = Gathered([there, missing], {there: outcome(there)}, 3)
    difference = Estimate(8.0, 7.5, float("inf"), 3)
    one = claim("a | b", "7", "8", "yes", 1, "by hand", difference, rival="HI-TD3")
    write_verdict(verdict_of("fig7", "learning curves", [one], made, "fig7.png"), tmp_path)
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert verdict["claims"][0]["holds"] == "yes"
    assert verdict["missing"] == ["left_turn hi_td3 normal seed 1"]
    page = (tmp_path / "verdict.md").read_text()
    assert "| a \\| b | 7 | 8 | 8.000 [7.500, ∞] (HI-TD3) | 1 | yes | by hand |" in page
    assert "1 of 2 training runs and tests, 3 seeds." in page
    assert page.endswith("- left_turn hi_td3 normal seed 1\n")
    assert markdown(verdict_of("t", "t", [one], Gathered([], {}, 1), "t.png")).count("Missing") == 0


def test_a_table_stands_between_its_comments_and_can_be_refreshed(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text(f"# Results\n\n{CLAIMS.begin}\nan earlier table\n{CLAIMS.end}\n\nThe rest.\n")
    directory = tmp_path / "experiments" / "fig7"
    directory.mkdir(parents=True)
    claims = [claim(text, "7", "8", "no", 3, "by hand") for text in ("first", "second")]
    write_verdict(verdict_of("fig7", "t", claims, Gathered([], {}, 3), "fig7.png"), directory)
    for _ in range(2):
        write_table(readme, CLAIMS, claim_lines(tmp_path, ["fig7", "fig8"]))
    text = readme.read_text()
    assert text.startswith(f"# Results\n\n{CLAIMS.begin}\n\n| what |")
    assert text.endswith(f"\n\n{CLAIMS.end}\n\nThe rest.\n")
    assert "an earlier table" not in text
    link = "[fig7](experiments/fig7/verdict.md)"
    assert f"| {link} | first | 7 | 8 | – | 3 | no |\n|  | second | 7 | 8" in text
    assert "| fig8 | not run yet |" in text


def test_the_table_of_experiments_counts_their_claims_and_names_their_commands(tmp_path):
    answers: tuple[Holds, ...] = ("yes", "no", "no", "undecided")
    claims = [claim("text", "7", "8", answer, 3, "by hand") for answer in answers]
    claims.append(claim(f"scene: {BAR}, first", "7", "8", "no", 3, "by hand"))
    units = [Unit("left_turn", "phil_td3", "normal", seed) for seed in (1, 2)]
    made = Gathered(units, {units[0]: outcome(units[0])}, 3)
    for name in ("fig7", "remedy"):
        directory = tmp_path / "experiments" / name
        directory.mkdir(parents=True)
        write_verdict(verdict_of(name, "curves", claims, made, f"{name}.png"), directory)
    assert count_lines(tmp_path, ["fig7", "fig8", "remedy"])[2:] == [
        "| [fig7](experiments/fig7/verdict.md) | curves | 1 of 2 | 1 | 3 | 1 "
        "| `python -m trainer experiment fig7 --seeds 3` |",
        "| fig8 | not run yet | – | – | – | – | `python -m trainer experiment fig8` |",
        "| [remedy](experiments/remedy/verdict.md) | curves | 1 of 2 | 1 | 3 | 1 "
        "| `python -m trainer experiment remedy --seeds 3` |",
        "| all |  |  | 2 | 6 | 2 | `python -m trainer experiment all` |",
        "|  | what the paper says |  | 1 | 2 | 1 |  |",
        "|  | bars of this project |  | 0 | 2 | 0 |  |",
        "|  | experiments of our own |  | 1 | 2 | 1 |  |",
    ]


def test_a_table_needs_its_place_and_whole_verdicts(tmp_path):
    readme = tmp_path / "README.md"
    assert not has_place(readme, CLAIMS)
    readme.write_text("# Results\n")
    assert not has_place(readme, CLAIMS)
    readme.write_text(f"{CLAIMS.begin}\n")
    with pytest.raises(UserError, match="lacks the line"):
        write_table(readme, CLAIMS, [])
    verdict = tmp_path / "experiments" / "fig7" / "verdict.json"
    verdict.parent.mkdir(parents=True)
    verdict.write_text('{"claims": [{}]}')
    with pytest.raises(UserError, match="no verdict of this project"):
        claim_lines(tmp_path, ["fig7"])


def test_the_table_of_units_has_a_row_a_kind_with_each_seed(tmp_path, monkeypatch):
    one = Unit("left_turn", "phil_td3", "normal", 1)
    units = [one, replace(one, setting="tough"), replace(one, seed=2)]
    units += [replace(one, setting="network"), Unit("congestion", "human_model", "normal", 0)]
    made = Gathered(units, {unit: outcome(unit) for unit in units}, 3)
    monkeypatch.setattr(unit_table, "gather", lambda store, wanted, seeds: made)
    _, _, *rows = unit_table.unit_lines(store_in(tmp_path), 3)
    assert [row.split(" | ")[:2] for row in rows] == [
        ["| left turn, PHIL-TD3", "2"],
        ["| left turn, PHIL-TD3, tough", "1"],
        ["| left turn, PHIL-TD3, network (tested without it)", "1"],
        ["| congestion, human model", "1"],
    ]
    drives = [made.found[unit].tests["nominal"] for unit in (units[0], units[2])]
    shares = " ".join(f"{100 * each.reached.mean():.0f}" for each in drives)
    assert f" % ({shares}), " in rows[0]
    assert rows[0].endswith(" | 99 → 99, 99 → 99 % |")
    assert rows[-1].endswith(" | – |")


def test_the_table_of_units_shows_the_dense_scene_where_any_was_tested_in_it(tmp_path, monkeypatch):
    first, later = (
        Unit("left_turn", "phil_td3", "normal", 1),
        Unit("congestion", "ia_td3", "normal", 1),
    )
    tested = {
        first: outcome(first),
        later: outcome(later, conditions=("nominal", "noise", "variant", "dense")),
    }
    made = Gathered(tested, tested, 3)
    monkeypatch.setattr(unit_table, "gather", lambda store, wanted, seeds: made)
    header, _, before, now = unit_table.unit_lines(store_in(tmp_path), 3)
    place = header.split(" | ").index("dense")
    assert before.split(" | ")[place] == "–, – m"
    assert now.split(" | ")[place].endswith(" m")
    assert header.count("|") == before.count("|") == now.count("|")


def test_a_policy_that_unlearns_shows_it(tmp_path, monkeypatch):
    unit = Unit("congestion", "per_td3", "normal", 1)
    shares = np.full(100, np.nan)
    shares[9::10] = np.linspace(0.44, 0.0, 10)
    found = outcome(unit)
    found = replace(found, metrics={**found.metrics, "validation_success": shares})
    monkeypatch.setattr(unit_table, "gather", lambda *_: Gathered([unit], {unit: found}, 3))
    assert unit_table.unit_lines(store_in(tmp_path), 3)[-1].endswith(" | 44 → 0 % |")
