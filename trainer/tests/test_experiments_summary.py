"""Verdicts on disk, and the summary of them all."""

import json

import pytest

from edge_runtime.errors import UserError
from trainer.experiments.gathered import Gathered
from trainer.experiments.summary import BEGIN, END, write_summary
from trainer.experiments.units import Unit
from trainer.experiments.verdict import claim, markdown, verdict_of, write_verdict
from trainer.tests.synthetic import outcome


def test_a_verdict_is_written_for_programs_and_for_people(tmp_path):
    there, missing = (Unit("left_turn", name, "normal", 1) for name in ("phil_td3", "hi_td3"))
    made = Gathered([there, missing], {there: outcome(there)}, 3)
    one = claim("a | b", "7", "8", "yes", 1, "by hand")
    write_verdict(verdict_of("fig7", "learning curves", [one], made, "fig7.png"), tmp_path)
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert verdict["claims"][0]["holds"] == "yes"
    assert verdict["missing"] == ["left_turn hi_td3 normal seed 1"]
    page = (tmp_path / "verdict.md").read_text()
    assert "| a \\| b | 7 | 8 | 1 | yes | by hand |" in page
    assert "1 of 2 training runs and tests, 3 seeds." in page
    assert page.endswith("- left_turn hi_td3 normal seed 1\n")
    assert markdown(verdict_of("t", "t", [one], Gathered([], {}, 1), "t.png")).count("Missing") == 0


def test_the_summary_stands_between_its_comments_and_can_be_refreshed(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text(f"# Results\n\n{BEGIN}\nan earlier table\n{END}\n\nThe rest.\n")
    directory = tmp_path / "experiments" / "fig7"
    directory.mkdir(parents=True)
    claims = [claim(text, "7", "8", "no", 3, "by hand") for text in ("first", "second")]
    write_verdict(verdict_of("fig7", "t", claims, Gathered([], {}, 3), "fig7.png"), directory)
    for _ in range(2):
        assert write_summary(tmp_path, ["fig7", "fig8"])
    text = readme.read_text()
    assert text.startswith(f"# Results\n\n{BEGIN}\n\n| what |")
    assert text.endswith(f"\n\n{END}\n\nThe rest.\n")
    assert "an earlier table" not in text
    command = "`python -m trainer experiment fig7 --seeds 3`"
    link = "[fig7](experiments/fig7/verdict.md)"
    assert f"| {link} | first | 7 | 8 | 3 | no | {command} |\n|  | second | 7 | 8" in text
    assert "| fig8 | not run yet |" in text


def test_the_summary_needs_its_place_and_whole_verdicts(tmp_path):
    readme = tmp_path / "README.md"
    assert not write_summary(tmp_path, ["fig7"])
    readme.write_text("# Results\n")
    assert not write_summary(tmp_path, ["fig7"])
    readme.write_text(f"{BEGIN}\n")
    with pytest.raises(UserError, match="lacks the line"):
        write_summary(tmp_path, ["fig7"])
    readme.write_text(f"{BEGIN}\n{END}\n")
    verdict = tmp_path / "experiments" / "fig7" / "verdict.json"
    verdict.parent.mkdir(parents=True)
    verdict.write_text('{"claims": [{}]}')
    with pytest.raises(UserError, match="no verdict of this project"):
        write_summary(tmp_path, ["fig7"])
