import json
import signal
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from bridge.network import parse_spec
from bridge.outcomes import GOAL
from bridge.report import write_figure
from edge_runtime.util import UserError
from hil_tests import envelope
from hil_tests.envelope import (
    AXES,
    BETWEEN,
    BREAKS,
    BURST_PERCENT,
    HOLDS,
    TRIES,
    Drivers,
    Search,
    SequentialTest,
    find_edges,
    network,
)  # fmt: skip
from hil_tests.tests.shared.commands import call, refusal

LIMITS = {"delay_ms": 300.0, "jitter_ms": 25.0, "tail_jitter_ms": 60.0, "loss_percent": 12.0,
          "burst_messages": 2.5, "outage_s": 0.5}  # fmt: skip


def decided(share, promise, rng):
    test, verdict = SequentialTest(promise), None
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
    search = Search(lucky(lambda at: at[name] / (steps * step)), 0.95)
    found = search.edge(lambda k: {name: k * step}, round(most / step))
    assert found["steps"] == (steps, steps + 1)
    sides = [search.tried[found[side]]["verdict"] for side in ("inside", "outside")]
    assert sides == [HOLDS, BREAKS]
    assert parse_spec(found["outside"]) == network({name: (steps + 1) * step})


@pytest.mark.parametrize(("jointly", "share"), [(sum, 0.25), (max, 1.0)])
def test_the_axes_are_searched_alone_and_together(jointly, share):
    def harm(at):
        return jointly(at[name] / limit for name, limit in LIMITS.items())

    edges = find_edges(Search(lucky(harm), 0.95))
    together = edges.pop("together")
    assert {name: edge["limit"] for name, edge in edges.items()} == LIMITS
    assert edges["loss_percent"]["outside"] == "loss=13%"
    assert together["limit"] == share  # At a quarter of its limit a burst is none.
    assert (together["breaks_at"] is None) == (jointly is max)


def test_what_fails_without_a_network_has_no_envelope():
    with pytest.raises(UserError):
        find_edges(Search(lambda spec, seeds: [seed % 5 > 0 for seed in seeds], 0.95))


class Drives:
    """Drives of `lucky`, in this process; ^C comes before the one after ``most``."""

    most, policy_id = 0, "id"

    def __init__(self, *task):
        self._left = Drives.most

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def drive(self, spec, seeds):
        self._left -= 1
        if self._left < 0:
            raise KeyboardInterrupt
        successes = lucky(lambda at: sum(at[name] / LIMITS[name] for name in at))(spec, seeds)
        return [SimpleNamespace(outcome=GOAL if each else "collision") for each in successes]


def test_what_was_found_before_an_interruption_is_kept_and_taken_up(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(envelope, "Drivers", Drives)
    out, other, figures = tmp_path / "found.json", tmp_path / "at_once.json", []
    monkeypatch.setattr(envelope, "write_figure", lambda *figure: figures.append(figure))
    Drives.most = 10**6
    assert call(capsys, "envelope", "--out", other, package="hil_tests")[0] == 0
    known = []
    Drives.most = 150
    while call(capsys, "envelope", "--out", out, package="hil_tests")[0] == 130:
        part = json.loads(out.read_text())
        assert not part["complete"]
        known.append(len(part["tried"]))
    assert len(known) > 1
    assert known == sorted(set(known))
    found, wanted = (json.loads(path.read_text()) for path in (out, other))
    assert {**found, "command": ""} == {**wanted, "command": ""}
    assert found["complete"]
    assert len(figures) == 1 + len(known) + 1
    write_figure(*figures[-1])
    with Image.open(out.with_suffix(".png")) as picture:
        assert picture.width > 1000
    Drives.most = 16  # A complete one is found anew.
    assert call(capsys, "envelope", "--out", out, package="hil_tests")[0] == 130


@pytest.mark.parametrize("spoilt", [{}, {"tried": {"none": {"verdict": "holds"}}}])
def test_an_unfinished_file_that_is_none_is_one_line_and_stays(
    monkeypatch, capsys, tmp_path, spoilt
):
    monkeypatch.setattr(envelope, "Drivers", Drives)
    out = tmp_path / "e.json"
    Drives.most = 16  # The perfect network and a part of the next
    assert call(capsys, "envelope", "--out", out, package="hil_tests")[0] == 130
    part = json.loads(out.read_text())
    del part["tried"]
    out.write_text(text := json.dumps(part | spoilt))
    assert refusal(capsys, "envelope", "--out", out, package="hil_tests")
    assert out.read_text() == text


def test_bursts_come_on_top_of_the_loss():
    way = network({"loss_percent": 10.0, "burst_messages": 3.0}).up
    assert way.bad_share == pytest.approx(BURST_PERCENT / 100)


def test_what_fails_without_a_network_leaves_no_file(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(envelope, "Drivers", Drives)
    monkeypatch.setattr(envelope, "GOAL", "never")
    Drives.most = 10**6
    refused = call(capsys, "envelope", "--out", tmp_path / "e.json", package="hil_tests")
    assert refused[0] == 2
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_does_not_reach_the_processes_not_even_while_they_load():
    drivers: Any = Drivers.__new__(Drivers)
    ProcessPoolExecutor.__init__(drivers, 1, get_context("spawn"))
    with drivers:
        blocked = drivers.submit(signal.pthread_sigmask, signal.SIG_BLOCK, []).result()
    assert signal.SIGINT in blocked
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
