"""What is kept under ``results/paper`` lies where it says that it belongs."""

import json
from pathlib import Path

import pytest

PAPER = Path(__file__).parents[2] / "results" / "paper"


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
def test_each_record_lies_in_its_scenarios_file_once(scenario):
    records = list(map(json.loads, (PAPER / f"{scenario}.jsonl").read_text().splitlines()))
    assert {record["unit"]["scenario"] for record in records} == {scenario}
    assert len({record["id"] for record in records}) == len(records)
