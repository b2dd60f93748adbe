"""Work that is ended by the clock, between two of its parts."""

import argparse
import json
import math
import time

from trainer.__main__ import main
from trainer.commands.time_limit import add_time_limit, deadline_s, until


def limit(*arguments: str) -> float:
    parser = argparse.ArgumentParser()
    add_time_limit(parser, "stop")
    return deadline_s(parser.parse_args(arguments))


def test_minutes_count_from_now_and_none_is_no_limit():
    before_s = time.monotonic()
    end_s = limit("--max-minutes", "2")
    assert before_s + 120.0 <= end_s <= time.monotonic() + 120.0
    assert limit() == math.inf


def test_nothing_is_begun_after_the_deadline():
    begun = []

    def parts():
        for part in range(3):
            begun.append(part)
            yield part

    assert list(until(math.inf, parts())) == [0, 1, 2]
    begun.clear()
    assert list(until(time.monotonic() - 1.0, parts())) == [0]
    assert begun == [0]


def test_a_human_model_whose_time_is_up_is_refined_in_proportion_and_kept(tmp_path, capsys):
    out = tmp_path / "human"
    arguments = ["human", "--out", str(out), "--max-minutes", "1e-6", "--updates-per-episode", "1"]
    assert main([*arguments, "--refining-updates", "100"]) == 0
    report = json.loads((out / "human.json").read_text())
    assert report["episodes"] == 1
    assert report["config"]["episodes"] == 50
    said = capsys.readouterr().err
    assert "the time is over after 1 of 50 episodes" in said
    assert "refining: 2/2" in said  # 100 steps are for 50 episodes
    assert (out / "human_model.pt").is_file()
