"""What a runtime without a vehicle loads of this package, and that the package stands alone."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path
from typing import List

import pytest

import edge_runtime
from edge_runtime.config import DEFAULT_BUS, HunterSettings, Ros2Settings
from edge_runtime.vehicles.hunter.bus import parse_bus
from edge_runtime.vehicles.hunter.protocol import PROFILES
from edge_runtime.vehicles.mapping import SPECS
from edge_runtime.vehicles.ros2.names import check_settings

ROOT = Path(edge_runtime.__file__).parent
# Only who asks for them loads them.
LAZY = {"commands", "files", "tls", "vehicles"}
_LOADED = """
import json, sys
{what}
files = [m.__file__ for n, m in sys.modules.items() if n.split(".")[0] == "edge_runtime"]
print(json.dumps(files))
"""


def loaded_by(what: str) -> List[Path]:
    done = subprocess.run(
        [sys.executable, "-c", _LOADED.format(what=what)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return [Path(name) for name in json.loads(done.stdout)]


@pytest.mark.parametrize(
    ("what", "most_lines"),
    [("import edge_runtime.run", 2900), ("import edge_runtime.__main__, edge_runtime.run", 3200)],
    ids=["the run itself", "with the command line"],
)
def test_run_without_a_vehicle_loads_no_more_than_it_needs(what, most_lines):
    loaded = loaded_by(what)
    assert not LAZY & {path.relative_to(ROOT).parts[0].replace(".py", "") for path in loaded}
    assert sum(len(path.read_text().splitlines()) for path in loaded) < most_lines


def test_a_vehicle_loads_no_other_one():
    making = """
from edge_runtime.config import Config
from edge_runtime.vehicles.registry import make_vehicle
make_vehicle("mock", Config(), "left_turn")
"""
    folders = {path.parent.name for path in loaded_by(making)}
    assert folders == {"edge_runtime", "vehicles"}


def test_the_defaults_of_a_vehicles_settings_are_valid():
    parse_bus(DEFAULT_BUS)
    check_settings(Ros2Settings())
    assert HunterSettings().model in SPECS
    assert HunterSettings().profile in PROFILES


def test_it_imports_none_of_our_other_packages():
    others = {path.parent.name for path in ROOT.parent.glob("*/__init__.py")} - {ROOT.name}
    assert {"bridge", "trainer", "deploy", "hil_tests"} <= others
    for path in ROOT.rglob("*.py"):
        if "tests" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in getattr(node, "names", []) if hasattr(alias, "name")]
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                assert not {name.split(".")[0] for name in names} & others, path
