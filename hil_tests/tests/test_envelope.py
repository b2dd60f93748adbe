import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.network import parse_spec
from bridge.outcomes import COLLISION, GOAL
from edge_runtime.util import UserError
from hil_tests.__main__ import main
from hil_tests.drivers import Drivers
from hil_tests.envelope import (
    AXES,
    BETWEEN,
    BREAKS,
    BURST_PERCENT,
    FRESH,
    HOLDS,
    TRIES,
    Search,
    SequentialTest,
    find_region,
    network,
)  # fmt: skip
from hil_tests.testing.commands import exit_status

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "results/envelope/left_turn.json"
LIMITS = {"delay_ms": 300.0, "jitter_ms": 25.0, "tail_jitter_ms": 60.0, "loss_percent": 12.0,
          "burst_messages": 2.5, "outage_s": 0.5}  # fmt: skip


def decided(share, promise, rng):
    test, verdict = SequentialTest(promise, 0.95), None
    while verdict is None:
        verdict = test.add(rng.random() < share)
    return verdict, test.drives


@pytest.mark.parametrize("promise", [0.9, 0.95])
def test_the_sequential_test_is_wrong_as_seldom_as_it_says_and_soon_decided(promise):
    rng, failing, error = np.random.default_rng(1), 1.0 - promise, 0.05 / TRIES
    for factor, right, most in (
        (1.0, BETWEEN, 2 * error),  # at the promise itself either side is an error
        (0.3, HOLDS, 0.08),  # some are given up, undecided
        (0.1, HOLDS, 0.01),
        (1.7, BREAKS, 0.08),
        (4.0, BREAKS, 0.01),
    ):
        found = [decided(1.0 - factor * failing, promise, rng) for _ in range(300)]
        wrong = sum(verdict != right for verdict, _ in found)
        assert wrong / 300 <= most + 3 * (most / 300) ** 0.5, (factor, wrong)
        assert np.mean([drives for _, drives in found]) < 35 / failing
        assert max(drives for _, drives in found) <= round(50 / failing)


def point_of(spec):
    """A network's point, as `network` makes one of it."""
    assert spec.up == spec.down
    way, jitter = spec.up, spec.up.jitter_ms
    bursts = bool(way.burst_messages)
    return {
        "delay_ms": way.delay_ms if way.delay_ms > 2 * jitter else 0.0,
        "jitter_ms": jitter * (way.tail == "normal"),
        "tail_jitter_ms": jitter * (way.tail == "pareto"),
        "loss_percent": way.clear_loss_percent if bursts else way.loss_percent,
        "burst_messages": way.burst_messages,
        "outage_s": way.outages[0].length_s if way.outages else 0.0,
    }


def lucky(harm, slack=1e-6):
    """Drives that fail once in a hundred, and every other time where ``harm(point)`` is over 1."""
    return lambda spec, seeds: [
        seed % 100 != 7 and (seed % 2 == 0 or harm(point_of(spec)) <= 1.0 + slack) for seed in seeds
    ]


@given(st.data())
@settings(max_examples=30)
def test_bisection_finds_a_planted_edge_at_the_resolution(data):
    name = data.draw(st.sampled_from([name for name in AXES if name != "burst_messages"]))
    most, step = AXES[name]
    steps = data.draw(st.integers(1, round(most / step) - 1))
    search = Search(lucky(lambda at: at[name] / (steps * step)), 0.95, 0.95)
    found = search.edge(lambda k: {name: k * step}, round(most / step))
    assert found["steps"] == (steps, steps + 1)
    sides = [search.tried[found[side]]["verdict"] for side in ("inside", "outside")]
    assert sides == [HOLDS, BREAKS]
    assert parse_spec(found["outside"]) == network({name: (steps + 1) * step})


def shares(at):
    return [at[name] / limit for name, limit in LIMITS.items()]


@pytest.mark.parametrize(
    ("harm", "joint", "box"),
    [
        (lambda at: sum(shares(at)), 1.0, 0.25),  # at a quarter of its limit a burst is none
        (lambda at: max(shares(at)), 1.0, 1.0),
        # Two at once harm more than each alone.
        (lambda at: sum(shares(at)) / (0.5 if sum(map(bool, shares(at))) > 1 else 1.0), 0.5, 0.1),
    ],
)
def test_the_region_is_as_large_as_the_mixtures_that_were_tried(harm, joint, box):
    found = find_region(Search(lucky(harm), 0.95, 0.95))
    told = {**LIMITS, "jitter_ms": 25.0}
    assert found["tail_jitter_ms"] == told.pop("tail_jitter_ms")
    assert (found["limits"], found["joint"], found["box"]) == (told, joint, box)
    assert {name: edge["limit"] for name, edge in found["edges"].items() if name in AXES} == LIMITS


def test_what_fails_without_a_network_has_no_envelope():
    with pytest.raises(UserError, match="not kept even on a perfect network"):
        find_region(Search(lambda spec, seeds: [seed % 5 > 0 for seed in seeds], 0.95, 0.95))


def test_bursts_come_on_top_of_the_loss():
    way = network({"loss_percent": 10.0, "burst_messages": 3.0}).up
    assert way.bad_share == pytest.approx(BURST_PERCENT / 100)
    longest = network({"outage_s": 4.0})  # Each must end, to be read back.
    assert parse_spec(str(longest)) == longest


def test_an_envelope_is_confirmed_by_seeds_that_the_search_has_not_seen(monkeypatch, tmp_path):
    kept, given_, out = json.loads(KEPT.read_text()), tmp_path / "given.json", tmp_path / "out.json"
    edge = kept["edges"]["loss_percent"]
    kept["edges"] = {"loss_percent": edge}
    given_.write_text(json.dumps(kept))

    def drive(drivers, spec, seeds):
        assert list(seeds) == list(range(FRESH, FRESH + 4))
        ends = GOAL if spec == parse_spec(edge["inside"]) else COLLISION
        return [SimpleNamespace(outcome=ends) for _ in seeds]

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(Drivers, "drive", drive)
    words = ["envelope", "--confirm", str(given_), "--runs", "4", "--jobs", "1", "--out"]
    assert exit_status(main, [*words, str(out)]) == 0
    found = json.loads(out.read_text())
    assert found["confirmed"] is True
    assert [(row["network"], row["share"]) for row in found["rows"]] == [
        (edge["inside"], 1.0), (edge["outside"], 0.0),
    ]  # fmt: skip
    given_.write_text(json.dumps({**kept, "policy_id": "another"}))
    assert exit_status(main, [*words, str(tmp_path / "none.json")]) == 2
    assert not (tmp_path / "none.json").exists()


@pytest.mark.parametrize(
    "damage",
    [
        *([], {}, {"edges": {}}, {"env": "planted:Env-v0"}, {"policy": "planted:Expert"}),
        {"edges": {"delay_ms": {"inside": "none", "outside": "x"}}},
    ],
)
def test_a_damaged_envelope_cannot_be_confirmed_and_is_one_line(tmp_path, capsys, damage):
    given_, out = tmp_path / "given.json", tmp_path / "out.json"
    given_.write_text(json.dumps({**json.loads(KEPT.read_text()), **damage} if damage else damage))
    assert exit_status(main, ["envelope", "--confirm", str(given_), "--out", str(out)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not out.exists()
