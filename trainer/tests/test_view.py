"""The view of test episodes."""

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from trainer import view
from trainer.evaluation import evaluate


def steps_in(rrd):
    """The steps at which each entity was drawn."""
    found: dict[str, list[int]] = {}
    for chunk in RrdReader(str(rrd)).stream().to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        found.setdefault(chunk.entity_path, []).extend(columns.get("step", []))
    return found


def test_the_view_holds_every_step_of_the_episodes(tmp_path):
    found = evaluate("constant:1", "left_turn", runs=2, rerun=str(tmp_path / "drive.rrd"))
    drawn = steps_in(tmp_path / "drive.rrd")
    steps = list(range(sum(episode.steps for episode in found.episodes)))
    pictures = ("/frames/now", "/frames/before", "/road/ego/body", "/road/traffic/body")
    plots = ("/action/policy", "/action/applied", "/speed/ego", "/reward/step", "/status")
    for path in (*pictures, *plots):
        assert sorted(drawn[path]) == steps, path
    assert "/road/roads" in drawn


@pytest.mark.parametrize("draws", [True, False])
def test_numbers_and_the_picture_of_any_environment_are_drawn(draws, monkeypatch):
    recording, action = MagicMock(), np.ones(2, np.float32)
    seen: Any = SimpleNamespace(
        overruled=action, action=action, reward=1.0,
        observation=np.zeros((), [("near", np.float32, 40)]),
    )  # fmt: skip
    picture = MagicMock(return_value=np.zeros((8, 8, 3), np.uint8))
    env = SimpleNamespace(scene=lambda: None, render=picture if draws else None)
    monkeypatch.setattr(view, "open_sink", lambda *_: nullcontext(recording))
    with view.drives_watched(env, "sink") as record:
        record(seen, None, {"speed_mps": 3.0, "episode": 0})
    shown = dict(call.args for call in recording.log.call_args_list)
    assert isinstance(shown.get("road/picture"), rr.Image) == draws
    rows = (shown[path].as_component_batches() for path in ("action/applied", "observation/near"))
    assert [len(row[0].as_arrow_array().to_pylist()) for row in rows] == [2, 16]
