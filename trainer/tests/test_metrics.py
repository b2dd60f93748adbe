import csv
import math
from pathlib import Path

import pytest

from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import refusal
from trainer.training.metrics import NAMES, EpisodeMetrics, MetricsWriter, read_metrics

OLDER = [name for name in NAMES if name != "validation_reward"]
HEAD = ",".join(NAMES) + "\r\n"


def write(run_dir, lines):
    (run_dir / "metrics.csv").write_text(HEAD + "\r\n".join(lines), newline="")


def row(episode, names=NAMES, **changes):
    whole = {"total_steps": "75", "updates": "75", "human_steps": "3", "interventions": "1"}
    known = {"episode": str(episode), "outcome": "goal", **whole}
    known |= dict.fromkeys(("steps", "total_takeovers", "total_failures"), "1")
    values = {**dict.fromkeys(names, "1.5"), **known, **changes}
    return ",".join(values[name] for name in names)


def test_what_goes_on_after_a_cut_begins_a_new_row_and_a_full_disk_is_one_line(tmp_path):
    write(tmp_path, [row(0), row(1), row(2)[:40]])
    writer = MetricsWriter(tmp_path, 2, period_s=0.2)
    outcome = "stuck\u2028on a kerb"  # A line's end to Python, not to csv
    told = EpisodeMetrics(2, distance_m=2.5, outcome=outcome, human_steps=5, interventions=2)
    writer.add(told)
    rows = read_metrics(tmp_path)
    assert [each["episode"] for each in rows] == ["0", "1", "2"]
    assert (rows[2]["distance_m"], rows[2]["outcome"]) == ("2.5", outcome)
    # The totals go on from the rows before: 3 human steps and a take-over in each.
    totals_so_far = told.total_human_s, told.total_takeovers, told.total_failures
    assert totals_so_far == (pytest.approx(2 * 3 * 0.2 + 5 * 0.2), 2 * 1 + 2, 1)
    with Path("/dev/full").open("w") as writer._file:
        writer._csv = csv.DictWriter(writer._file, NAMES)
        with pytest.raises(OSError, match="No space left on device"):
            writer.add(EpisodeMetrics(0))
        with pytest.raises(OSError, match="No space left on device"):
            writer.close()


@pytest.mark.parametrize("episodes", [(0, 1, 1), (0, 2), (0,)])
def test_rows_that_are_double_or_missing_are_noticed_when_a_run_goes_on(tmp_path, episodes):
    write(tmp_path, [*map(row, episodes), ""])
    before = (tmp_path / "metrics.csv").read_bytes()
    with pytest.raises(UserError, match=r"metrics\.csv"):
        MetricsWriter(tmp_path, 2)
    assert (tmp_path / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize(
    "content",
    [
        bytes(range(256)) * 9,
        ",".join(OLDER) + ",other\r\n" + row(0) + "\r\n",
        f"{HEAD}{row(0)},9\r\n",
        f"{HEAD}{row(0, human_steps='3.0')}\r\n",
    ],
)
def test_anything_else_is_refused_in_a_line_that_names_it(content, capsys, tmp_path):
    content, path = content.encode() if isinstance(content, str) else content, tmp_path
    (path / "metrics.csv").write_bytes(content)
    said = "metrics.csv is no metrics of a training, or damaged"
    assert said in refusal(capsys, "plot", str(path))
    assert (path / "metrics.csv").read_bytes() == content


def test_a_row_holds_the_totals_so_far(tmp_path):
    writer, found = MetricsWriter(tmp_path, period_s=0.1), []
    for episode, (outcome, success) in enumerate((
        ("collision", math.nan), ("goal", 0.5), ("timeout", 0.9), ("collision", 0.9), ("goal", 0.8)
    )):  # fmt: skip
        told = EpisodeMetrics(episode, outcome=outcome, human_steps=3, interventions=1)
        told.validation_success = success
        writer.add(told)
        found.append((told.total_human_s, told.total_takeovers, told.total_failures))
    assert found == [(0.3, 1, 1), (0.6, 2, 1), (0.9, 3, 2), (1.2, 4, 3), (1.5, 5, 3)]
    until = [(row["human_s_to_90"], row["human_s_to_98"]) for row in read_metrics(tmp_path)]
    assert until == [("nan", "nan")] * 2 + [("0.9", "nan")] * 3
    writer.close()
