"""``trainer train --rerun``: opens the view around a run. The only door to rerun in the trainer."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun
from trainer.viewer.background import Background
from trainer.viewer.blueprint import APPLICATION, make_blueprint
from trainer.viewer.training_log import TrainingLog
from trainer.viewer.watcher import Watcher
from viewing.sinks import Sink, check_sink, open_sink, read_sink

OnEpisode = Callable[[EpisodeMetrics], None]


def check_word(word: str) -> Sink:
    """The sink that ``--rerun`` names; UserError where nothing could be shown there."""
    sink = read_sink(word)
    check_sink(sink)
    return sink


@contextmanager
def watched(run: TrainingRun, sink: Sink) -> Iterator[OnEpisode]:
    """Show a run for as long as it lasts; what it yields is to be called after each episode."""
    with open_sink(sink, APPLICATION, make_blueprint(None)) as recording:
        background = Background(TrainingLog(recording).draw)
        watcher = Watcher(run, background.put)
        run.on_step = watcher.on_step
        try:
            yield watcher.on_episode
        finally:
            run.on_step = None
            background.close()
            if background.dropped:
                print(f"{background.dropped} entries came faster than drawn", file=sys.stderr)
