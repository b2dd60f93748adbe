"""What a runtime without a vehicle loads of this package, and that the package stands alone."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import edge_runtime

ROOT = Path(edge_runtime.__file__).parent
MOST_LINES = 3000
# Only who asks for them loads them.
LAZY = {"commands", "files", "link_probe", "realtime", "tls", "vehicles"}
_LOADED = """
import json, sys
import edge_runtime.run
files = [m.__file__ for n, m in sys.modules.items() if n.split(".")[0] == "edge_runtime"]
print(json.dumps(files))
"""


def test_run_without_a_vehicle_loads_no_more_than_it_needs():
    done = subprocess.run(
        [sys.executable, "-c", _LOADED], capture_output=True, text=True, check=True
    )
    loaded = [Path(name) for name in json.loads(done.stdout)]
    assert not LAZY & {path.relative_to(ROOT).parts[0].replace(".py", "") for path in loaded}
    assert sum(len(path.read_text().splitlines()) for path in loaded) < MOST_LINES


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
