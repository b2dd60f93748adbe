"""How a refusal looks."""

from functools import partial

import pytest

from hil_tests.testing import commands


@pytest.fixture
def refusal(capsys):
    """Run ``python -m bridge`` with arguments that it refuses; return its only line."""
    return partial(commands.refusal, capsys, package="bridge")
