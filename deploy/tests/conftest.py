from pathlib import Path

import pytest

from deploy.bundle import TARGETS
from deploy.tests.boards import HERE, Board, Workshop


@pytest.fixture(scope="session")
def workshop(tmp_path_factory: pytest.TempPathFactory):
    """Bundles of the real edge runtime for this computer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TARGETS, "here", HERE)
        yield Workshop(tmp_path_factory.mktemp("workshop"))


@pytest.fixture
def board(tmp_path: Path, workshop: Workshop):
    """An empty board; whatever runs on it ends with the test."""
    board = Board(tmp_path / "board", workshop)
    yield board
    if (board.root / "trusted.pub").exists():
        done = board.run("uninstall")
        assert done.returncode == 0, done.stderr
