import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from bridge.network import parse_spec
from bridge.outcomes import GOAL, TRUNCATED, UNKNOWN
from edge_runtime.cli import run_cli
from edge_runtime.util import UserError
from hil_tests import campaign
from hil_tests.__main__ import main
from hil_tests.envelope import Drivers
from hil_tests.processes import POLICY
from trainer.environments import make_environment
from trainer.evaluation import EpisodeResult, OnnxDriver, drive_episodes
from trainer.util import kept

DELAY = campaign.Axis("delay", "delay", "ms", (0, 50, 100, 150), "delay={}ms")
JITTER = campaign.Axis("jitter", "jitter", "ms", (0, 9), "delay=1ms,jitter={}ms", "delay=1ms")


@pytest.mark.parametrize(
    ("delay", "jitter", "limits"),
    [
        ((1.0, 1.0, 0.9, 0.9), (1.0, 1.0), (50, 9)),
        # What holds further out does not count: one may land between.
        ((1.0, 0.97, 1.0, 1.0), (1.0, 0.9), (0, 0)),
        # An axis whose own base fails takes nothing from the others.
        ((1.0, 1.0, 1.0, 0.9), (0.9, 1.0), (100, None)),
    ],
)
def test_the_budget_is_the_largest_value_up_to_which_all_hold(delay, jitter, limits):
    shares = zip((*DELAY.specs, *JITTER.specs), (*delay, *jitter), strict=True)
    rows = {spec: {"success": {"value": share}} for spec, share in shares}
    found = campaign.budget([DELAY, JITTER], rows, "a policy")
    assert tuple(found["limits"].values()) == limits
    assert f"{limits[0]} ms of delay" in found["sentence"]


def test_a_campaign_of_networks_is_the_drive_in_process(tmp_path, monkeypatch, capsys):
    few = campaign.Axis("delay", "delay", "ms", (0, 300), "delay={}ms")
    monkeypatch.setattr(campaign, "AXES", (few,))
    monkeypatch.chdir(tmp_path)  # The default policy is the repository's.
    out = tmp_path / "r.json"
    arguments = ["campaign", "--only", "latency", "--runs", "2", "--jobs", "1", "--out", str(out)]
    assert run_cli(main, arguments) == 0
    found = json.loads(out.read_text())["latency"]
    env, driver = make_environment("left_turn"), OnnxDriver(Path(kept(str(POLICY))))
    for spec, row in found["rows"].items():
        wanted = drive_episodes(env, driver, range(2), latency=parse_spec(spec))
        assert row["outcomes"] == Counter(each.outcome for each in wanted)
    assert (tmp_path / "r_success.png").stat().st_size > 4_000
    assert found["budget"]["sentence"] in capsys.readouterr().out
    assert found["budget"]["sentence"] in out.with_suffix(".md").read_text()


def test_a_step_limit_is_a_failure_where_another_drive_tells_and_silence_is_an_error():
    drivers: Any = Drivers.__new__(Drivers)

    def drive(ends):
        drivers.map = lambda *_, **__: [
            EpisodeResult(0, end, 0.0, 0.0, 0.0, None, None, 0) for end in ends
        ]
        return [each.outcome for each in drivers.drive(parse_spec("none"), [0])]

    for ends in ([TRUNCATED], [UNKNOWN, GOAL]):  # None, or not all, tell how they ended.
        drivers._ends = {TRUNCATED}
        with pytest.raises(UserError, match="whether it succeeded"):
            drive(ends)
    drivers._ends = {TRUNCATED}
    assert drive([TRUNCATED, GOAL]) == ["timeout", "goal"]
    assert drive([TRUNCATED, TRUNCATED]) == ["timeout"] * 2
