from pathlib import Path

import pytest

from deploy.bundle import build_edge_wheel
from deploy.tests.boards import Board, Workshop


@pytest.fixture(scope="session")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    """Bundles of the real edge runtime for this computer."""
    folder = tmp_path_factory.mktemp("workshop")
    return Workshop(folder, build_edge_wheel(folder / "wheel"))


@pytest.fixture
def board(tmp_path: Path, workshop: Workshop):
    """An empty board; whatever runs on it ends with the test."""
    board = Board(tmp_path / "board", workshop)
    yield board
    if (board.root / "trusted.pub").exists():
        done = board.run("uninstall")
        assert done.returncode == 0, done.stderr
