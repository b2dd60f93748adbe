"""The measurement of training time: kept, found again, and refused where it is another's."""

import json
from dataclasses import replace

import pytest

from edge_runtime.errors import UserError
from trainer.experiments import timing
from trainer.tests.experiments import TINY, store_in, write_human


@pytest.fixture
def humans(tmp_path):
    store = store_in(tmp_path)
    write_human(store)
    return store.humans


@pytest.fixture
def measured(tmp_path, humans, monkeypatch):
    """A directory with a measurement; the turns themselves are out of the air."""
    turns = {name: [(100, 3.0)] for name in timing.PAPER_S}
    found = {"turns": turns, "units": timing._ids(TINY, humans)}
    monkeypatch.setattr(timing, "measure", lambda *_: found)
    directory = tmp_path / "time"
    assert timing.load_or_measure(directory, TINY, humans, "cpu", draw_only=True) is None
    assert timing.load_or_measure(directory, TINY, humans, "cpu", draw_only=False) == turns
    return directory


def load(directory, plan, humans):
    return timing.load_or_measure(directory, plan, humans, "cpu", draw_only=True)


def test_a_measurement_is_found_again_and_one_of_other_settings_is_refused(measured, humans):
    assert load(measured, TINY, humans)
    other = replace(TINY, learner={**TINY.learner, "gamma": 0.5})
    with pytest.raises(UserError, match="other settings; remove it"):
        load(measured, other, humans)


def test_the_first_measurement_does_not_say_and_is_taken(measured, humans):
    path = measured / timing.MEASURED_FILE
    path.write_text(json.dumps({"turns": json.loads(path.read_text())["turns"]}))
    assert load(measured, TINY, humans)


def test_without_the_human_model_it_can_still_be_drawn(measured, humans, tmp_path):
    assert load(measured, TINY, tmp_path / "nowhere")


@pytest.mark.parametrize(
    "text", ["", "[" * 9999, "[]", "3", '{"turns": {}}', '{"turns": {"phil_td3": 1}}']
)
def test_what_is_no_measurement_is_refused(measured, humans, text):
    (measured / timing.MEASURED_FILE).write_text(text)
    with pytest.raises(UserError, match=r"no measurement of this project|is not JSON"):
        load(measured, TINY, humans)
