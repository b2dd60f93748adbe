"""The view of a training beside it, and of recorded sittings."""

import threading
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
import rerun as rr
import torch
from rerun.chunk import RrdReader

from bridge.rerun import HUMAN, POLICY
from trainer import view
from trainer.human.guide import REASONS
from trainer.learner.config import LearnerConfig
from trainer.training.config import RunConfig
from trainer.training.metrics import read_metrics
from trainer.training.run import TrainingRun

TINY = RunConfig(
    seed=3, episodes=1, evaluate_every_steps=1, evaluation_runs=1, confirmation_factor=1, threads=1,
    learner=LearnerConfig(batch_size=4, replay_capacity=2000, warmup_steps=60),
)  # fmt: skip


def values_in(rrd):
    """What was logged, by entity: a list of (step or None, value)."""
    found: dict[str, list[tuple[int | None, object]]] = {}
    for chunk in RrdReader(str(rrd)).stream().to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        steps = columns.get("step", [None] * chunk.num_rows)
        for name in columns.keys() - {"step", "rerun.controls.RowId"}:
            rows = found.setdefault(chunk.entity_path, [])
            if name in ("Scalars:scalars", "StateChange:state"):
                values = (one[0] if len(one) == 1 else tuple(one) for one in columns[name])
                rows += zip(steps, values, strict=True)
    return {path: sorted(rows, key=lambda row: row[0] or 0) for path, rows in found.items()}


def train(directory, rrd=None):
    directory.mkdir()
    run: Any = TrainingRun(TINY, directory)
    with view.watched(run, str(rrd)) if rrd else nullcontext() as on_episode:
        run.train(*filter(None, [on_episode]))
    return run


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A small run with the view, and what the view holds."""
    folder = tmp_path_factory.mktemp("shown")
    torch.set_num_threads(1)
    return train(folder / "run", folder / "run.rrd"), values_in(folder / "run.rrd")


def test_a_run_that_is_watched_learns_the_same(shown, tmp_path, one_thread):
    weights = [run.learning.learner.actor.state_dict() for run in (shown[0], train(tmp_path / "1"))]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_the_view_holds_the_run(shown):
    run, found = shown
    metrics, steps = read_metrics(run.run_dir), list(range(run.learning.added))
    for path in ("/action/applied", "/speed/ego"):
        assert [step for step, _ in found[path]] == steps
    ends = np.cumsum([int(row["steps"]) for row in metrics]) - 1
    columns = [(plot, column) for plot, (_, shown) in view.EPISODES.items() for column in shown]
    for plot, column in columns:
        said = zip(ends, (row[column] for row in metrics), strict=True)
        expected = {int(end): float(value) for end, value in said if value != "nan"}
        assert dict(found.get(f"/{plot}/{column}", [])) == pytest.approx(expected), column
    pictures = {"/frames/now", "/frames/before", "/road/ego/body", "/road/traffic/body",
                "/road/roads", "/status"}  # fmt: skip
    assert pictures <= found.keys()
    told, driver = dict(found["/driver"]), "policy"
    for step, acted in enumerate(run.learning.replay._human[: run.learning.added]):
        driver = told.get(step, driver)
        assert driver in (("collision", "stuck") if acted else ("policy",)), step
    assert {"policy", "collision"} <= set(told.values())
    assert {"policy": POLICY, **dict.fromkeys(REASONS, HUMAN)} == view.DRIVERS


class PanicError(BaseException):
    """As pyo3's, of which rerun is made: no Exception."""


@pytest.mark.parametrize("ends", [None, PanicError("disk full")])
def test_a_view_that_is_slow_or_fails_holds_nobody_up(ends, monkeypatch, capsys):
    drawn: list[int] = []
    go_on, run = threading.Event(), Mock(steps=0, recorders=[])

    def draw(log, number):
        go_on.wait(10.0)
        drawn.append(number)
        if ends:
            raise ends

    monkeypatch.setattr(view, "open_sink", lambda *_: nullcontext(MagicMock()))
    monkeypatch.setattr(view.TrainingLog, "draw_episode", draw)
    with view.watched(run, "sink") as shown:
        on_episode: Any = shown
        for number in range(view.MOST_WAITING + 100):
            on_episode(number)
        go_on.set()
    assert run.recorders == []
    assert drawn[: view.MOST_WAITING] == ([0] if ends else list(range(view.MOST_WAITING)))
    assert len(drawn) <= view.MOST_WAITING + 1  # One may have been in its hands already.
    assert capsys.readouterr().err == ("disk full; the run is unharmed\n" if ends else "")


def test_numbers_and_the_picture_of_any_environment_are_drawn():
    recording, action = MagicMock(), np.ones(2, np.float32)
    seen: Any = SimpleNamespace(overruled=action, action=action)
    picture = np.zeros((8, 8, 3), np.uint8)
    near = {"near": np.arange(40.0)}
    view.TrainingLog(recording).draw_step(0, seen, "slow", 3.0, near, picture=picture)
    shown = dict(call.args for call in recording.log.call_args_list)
    assert isinstance(shown["road/picture"], rr.Image)
    rows = (shown[path].as_component_batches() for path in ("action/applied", "observation/near"))
    assert [len(row[0].as_arrow_array().to_pylist()) for row in rows] == [2, 16]
