"""How a refusal looks, and what a repair says."""

import pytest

from bridge.tests.harness import bridge_status


@pytest.fixture
def refusal(capsys):
    """Run ``python -m bridge`` with arguments that it refuses; return its only line."""

    def refused(*arguments):
        assert bridge_status([str(argument) for argument in arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return refused


@pytest.fixture
def repair(capsys):
    """Run ``python -m bridge repair``; return what it says."""

    def repaired(*arguments):
        capsys.readouterr()
        assert bridge_status(["repair", *map(str, arguments)]) == 0
        return capsys.readouterr().out

    return repaired
