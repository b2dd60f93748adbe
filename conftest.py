"""For all tests: no plug-in that happens to be installed here."""

from importlib.metadata import Distribution
from pathlib import Path

import pytest

discover = Distribution.discover
pytest.register_assert_rewrite("hil_tests.testing")
pytest_plugins = ["hil_tests.testing.fixtures"]


@pytest.fixture(autouse=True)
def no_foreign_plugins(monkeypatch, tmp_path_factory):
    """Of other packages' vehicles, scenarios and algorithms only what a test itself brings."""
    base = tmp_path_factory.getbasetemp()

    def is_met(package):
        foreign = any(point.group.startswith("phil.") for point in package.entry_points)
        brought = Path(str(package.locate_file(""))).resolve().is_relative_to(base)
        return not foreign or brought or package.metadata["Name"] == "phil-hil"

    monkeypatch.setattr(Distribution, "discover", lambda **how: filter(is_met, discover(**how)))
