"""Who may import whom: the table of the folders, held by reading every file."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

ARROWS = {
    "edge_runtime": set(),
    "bridge": {"edge_runtime"},
    "trainer": {"edge_runtime", "bridge"},
    "hil_tests": {"edge_runtime", "bridge", "trainer", "deploy"},
    "deploy": {"edge_runtime"},
}
EDGE_LIBRARIES = {
    "numpy", "onnxruntime", "zenoh", "msgspec", "cryptography", "tomli", "typing_extensions",
}  # fmt: skip
DOORS = {
    "can": ROOT / "edge_runtime/vehicles/hunter/bus.py",
    "pycdr2": ROOT / "edge_runtime/vehicles/ros2/node.py",
}
"""Where alone the edge runtime may load a library that only one kind of vehicle needs."""
ONLY_IN = {"torch": {"trainer"}, "highway_env": {"trainer"}, "onnx": {"trainer"}}
"""Heavy libraries and the only folders that may load them."""


def sources(folder: str) -> list[Path]:
    """The folder's files without its tests, which may use their neighbours' helpers."""
    return [p for p in (ROOT / folder).rglob("*.py") if not {"tests", "build"} & set(p.parts)]


def imported(path: Path) -> set[str]:
    """Top-level names of everything that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("folder", ARROWS)
def test_a_folder_imports_only_what_stands_below_it(folder):
    files = sources(folder)
    assert files
    for path in files:
        neighbours = imported(path) & set(ARROWS) - {folder}
        assert neighbours <= ARROWS[folder], path


def test_the_edge_runtime_uses_only_libraries_that_a_board_has():
    for path in sources("edge_runtime"):
        foreign = imported(path) - set(sys.stdlib_module_names) - {"edge_runtime"}
        behind_it = {library for library, door in DOORS.items() if path == door}
        assert foreign <= EDGE_LIBRARIES | behind_it, path


@pytest.mark.parametrize("library", DOORS)
def test_a_vehicles_library_is_loaded_only_with_the_vehicle(library):
    code = f"import sys, edge_runtime.run; assert {library!r} not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize(("library", "folders"), ONLY_IN.items())
def test_heavy_libraries_stay_where_they_belong(library, folders):
    for folder in set(ARROWS) - folders:
        for path in sources(folder):
            assert library not in imported(path), path


def test_the_check_can_fail(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    from trainer import x\n    import torch.nn\n")
    assert imported(bad) == {"trainer", "torch"}
