"""What is imported is asked for: another library may stop bringing it along."""

import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

from hil_tests.tests.test_import_arrows import ARROWS, imported, sources

PROJECT = Path(__file__).parents[2] / "pyproject.toml"
ELSEWHERE = {"ray", "pycdr2", "stable_baselines3", "pytest", "hypothesis", "cosmic_ray", "parso"}
"""Extras, and what the peers' and the mutation's environments have."""


def test_every_library_that_is_imported_is_a_dependency():
    lines = tomllib.loads(PROJECT.read_text())["project"]["dependencies"]
    asked_for = {re.split(r"[^\w.-]", line)[0].lower() for line in lines}
    modules = {name for part in ARROWS for path in sources(part) for name in imported(path)}
    foreign = modules - {*ARROWS, *ELSEWHERE} - sys.stdlib_module_names
    installed = packages_distributions()
    unasked = [
        module
        for module in foreign
        if asked_for.isdisjoint(name.lower() for name in installed.get(module, ()))
    ]
    assert sorted(unasked) == []
