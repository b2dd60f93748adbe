"""How a refusal looks."""

import pytest

from hil_tests.testing.drives import bridge_status


@pytest.fixture
def refusal(capsys):
    """Run ``python -m bridge`` with arguments that it refuses; return its only line."""

    def refused(*arguments):
        assert bridge_status([str(argument) for argument in arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return refused
