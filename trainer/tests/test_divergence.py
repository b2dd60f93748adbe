"""A training that diverges says so in one line, and spoils no checkpoint."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from edge_runtime.util import UserError
from trainer.drivers import CHECKPOINT_FILE
from trainer.learner.td3 import Losses
from trainer.tests.scripted import BATCH, CONFIG, scripted_run
from trainer.tests.test_commands import refusal

SAID = "the training diverged in episode 2: its"


def begun(tmp_path):
    """A run after its first episode, with a checkpoint."""
    run = scripted_run(tmp_path, replace(CONFIG, episodes=3), length=4)
    run.advance()
    run.save()
    return run, (tmp_path / CHECKPOINT_FILE).read_bytes()


def bad_update(run):
    run.learning.learner.update = lambda *_: Losses(0.0, 0.0, 0.0, 0.0, np.full(BATCH, np.nan))


def bad_action(run):
    run.learning.learner.act = lambda *_: np.array([np.nan], np.float32)


def bad_weights(run):
    with torch.no_grad():
        next(run.learning.learner.target_critics.parameters()).fill_(torch.inf)


@pytest.mark.parametrize("spoil", [bad_update, bad_action, bad_weights])
def test_it_ends_where_it_shows_and_the_checkpoint_stays(spoil, tmp_path):
    run, before = begun(tmp_path)
    spoil(run)
    with pytest.raises(UserError, match=SAID):
        run.train()
    assert all(np.isfinite(run.env.actions))
    assert (tmp_path / CHECKPOINT_FILE).read_bytes() == before


def test_the_command_ends_with_one_line(capsys, tmp_path, one_thread):
    settings = ("actor_learning_rate=1e30", "warmup_steps=10", "batch_size=4", "precision=float32")
    chosen = [part for setting in settings for part in ("--set", setting)]
    command = ["train", "--episodes", "1", "--out", str(tmp_path), *chosen]
    with np.errstate(all="raise"):
        err = refusal(capsys, *command)
    assert "the training diverged in episode 1" in err
    assert "a smaller --set actor_learning_rate" in err
