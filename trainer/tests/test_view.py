"""The view of a training beside it, and of recorded sittings."""

import threading
from contextlib import nullcontext
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader

from bridge.rerun import HUMAN, POLICY
from trainer import view
from trainer.__main__ import main
from trainer.environments import make_environment
from trainer.human.guide import REASONS
from trainer.learner.config import LearnerConfig
from trainer.person.recording import Recorder, packed
from trainer.person.tests.people import recorded_step
from trainer.training.config import RunConfig
from trainer.training.metrics import read_metrics
from trainer.training.run import TrainingRun
from trainer.view import ShownStep

TINY = RunConfig(
    seed=3, episodes=1, evaluate_every_steps=1, evaluation_runs=1, threads=1,
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
    columns = {path: name for path, (_, name) in view.MEASURED.items()}
    for path, column in {"return/episode": "episode_return", **columns}.items():
        said = zip(ends, (row[column] for row in metrics), strict=True)
        expected = {int(end): float(value) for end, value in said if value != "nan"}
        assert dict(found.get(f"/{path}", [])) == pytest.approx(expected), path
    pictures = {"/frames/now", "/frames/before", "/road/ego/body", "/road/traffic/body",
                "/road/roads", "/status"}  # fmt: skip
    assert pictures <= found.keys()
    told, driver = dict(found["/driver"]), "policy"
    for step, acted in enumerate(run.learning.replay._human[: run.learning.added]):
        driver = told.get(step, driver)
        assert driver in (("collision", "stuck") if acted else ("policy",)), step
    assert {"policy", "collision"} <= set(told.values())
    assert {"policy": POLICY, **dict.fromkeys(REASONS, HUMAN)} == view.DRIVERS


def step(number=0, action: Any = 0.0, **changes):
    return ShownStep(number, action, action, 3.0, None)._replace(**changes)


def test_a_slow_view_holds_nobody_up():
    drawn, go_on = [], threading.Event()

    def draw(entry):
        go_on.wait(10.0)
        drawn.append(entry)

    background = view.Background(lambda: nullcontext(draw))
    entries: list[Any] = [step(number) for number in range(view.MOST_WAITING + 100)]
    for entry in entries:
        background.put(entry)
    go_on.set()
    background.close()
    assert drawn[: view.MOST_WAITING] == entries[: view.MOST_WAITING]
    assert len(drawn) - view.MOST_WAITING in (0, 1)  # One may have been in its hands already.


class PanicError(BaseException):
    """As pyo3's, of which rerun is made: no Exception."""


def test_a_view_that_fails_does_not_end_the_run(capsys):
    background = view.Background(lambda: nullcontext(Mock(side_effect=PanicError("disk full"))))
    for _ in range(3):
        background.put(step())
    background.close()
    (line,) = capsys.readouterr().err.splitlines()
    assert "disk full" in line


BRAKED = [0.5] * 5 + [-1.0] * 5 + [0.5] * 5


def drive(directory, seeds=(4, 9), steps=15, scenario="left_turn", policy: float | None = 0.5):
    """A recorded sitting: the policy wants half throttle, the person brakes from step 5 to 9."""
    env, recorder = make_environment(scenario), Recorder(directory)
    for episode, seed in enumerate(seeds):
        observation, _ = env.reset(seed=seed)
        for number, action in enumerate(BRAKED[:steps]):
            frames = observation
            observation, reward, *_ = env.step(np.array([action], np.float32))
            recorder.write(recorded_step(
                recorder.sitting, recorder.index, scenario=scenario, seed=seed, episode=episode,
                step=number, seen=packed(frames), seen_next=packed(observation),
                policy_action=policy, action=action, human=5 <= number < 10, first=number == 5,
                reward=float(reward), speed_mps=env.ego.speed,
                outcome="restarted" if number == steps - 1 else "",
            ))  # fmt: skip
    recorder.close()
    return recorder.path


def test_a_sitting_is_shown_whole(tmp_path):
    drive(tmp_path / "drives")
    out = tmp_path / "sitting.rrd"
    assert main(["view", str(tmp_path / "drives"), "--save", str(out)]) == 0
    found = values_in(out)
    assert [value for _, value in found["/action/applied"]] == 2 * BRAKED
    assert {value for _, value in found["/action/policy"]} == {0.5}
    assert found["/driver"] == [
        (0, "policy"), (5, "person"), (10, "policy"), (20, "person"), (25, "policy"),
    ]  # fmt: skip
    assert [step for step, _ in found["/return/episode"]] == [14, 29]
    assert {"/road/ego/body", "/road/roads", "/frames/now"} <= set(found)
    assert "/loss/critic" not in {path for path, rows in found.items() if rows}
