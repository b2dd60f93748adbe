"""How a refusal looks, and a drive that several tests look at."""

from functools import partial

import pytest

from bridge.tests.recordings import record_drive
from hil_tests.tests.shared import commands
from hil_tests.tests.shared.drives import SLOW_TOY, make_policy, read


@pytest.fixture
def refusal(capsys):
    """Run ``python -m bridge`` with arguments that it refuses; return its only line."""
    return partial(commands.refusal, capsys, package="bridge")


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """A drive of the real processes: recorded, viewed into a file, and its report."""
    folder = tmp_path_factory.mktemp("drive")
    shown = folder / "drive.rrd"
    recording = record_drive(folder, SLOW_TOY, make_policy(folder), view=shown)
    return recording, shown, read(folder / "report.json")
