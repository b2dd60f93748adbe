"""Held by reading every file: who may import whom, that what is imported is asked for, and that
nothing from outside, a message or a file, is ever run as code.
"""

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
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
    "can": ROOT / "edge_runtime/vehicles/hunter/__init__.py",
    "pycdr2": ROOT / "edge_runtime/vehicles/ros2/node.py",
}
"""Where alone the edge runtime may load a library that only one kind of vehicle needs."""
UNSAFE = re.compile(
    r"""^(import|from)\ .*\b(pickle|cPickle|_pickle|marshal|shelve|dill|cloudpickle|joblib)\b
    | ^(eval|exec|compile|__import__)\(
    | ^torch\.load\((?!.*weights_only=True)
    | ^yaml\.(load|load_all|unsafe_load|full_load)\((?!.*Loader=(\w+\.)?C?SafeLoader)
    | \ballow_pickle=(?!False)
    | \.(read|to)_pickle\(
    | \bshell=(?!False)""",
    re.VERBOSE | re.DOTALL,
)
"""Imports and calls, as Python writes them, that run what they read."""
ELSEWHERE = {"ray", "pycdr2", "stable_baselines3", "pytest", "hypothesis", "cosmic_ray", "parso"}
"""Extras, and what the peers' and the mutation's environments have."""
ONLY_IN = {"torch": {"trainer"}, "highway_env": {"trainer"}, "onnx": {"trainer"}}
"""Heavy libraries and the only folders that may load them."""


def sources(folder: str) -> list[Path]:
    """The folder's files without its tests, which may use their neighbours' helpers."""
    return [p for p in (ROOT / folder).rglob("*.py") if not {"tests", "build"} & set(p.parts)]


@cache
def tree_of(path: Path) -> ast.AST:
    return ast.parse(path.read_text())


@cache
def imported(path: Path) -> frozenset[str]:
    """Top-level names of everything that a file imports, wherever in it."""
    names: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return frozenset(names)


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


def test_every_library_that_is_imported_is_a_dependency():
    lines = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
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


def faults(tree: ast.AST) -> list[str]:
    kinds = (ast.Import, ast.ImportFrom, ast.Call)
    lines = [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, kinds)]
    return [line for line in lines if UNSAFE.search(line)]


@pytest.mark.parametrize("folder", ARROWS)
def test_nothing_shipped_runs_what_it_reads(folder):
    for path in sources(folder):
        assert faults(tree_of(path)) == [], path


@pytest.mark.parametrize(
    "line",
    [
        "import pickle", "from marshal import loads", "import cloudpickle as c", "eval(text)",
        "exec(open(p).read())", "torch.load(p)", "torch.load(p, weights_only=False)",
        "torch.load(p, weights_only=flag)", "np.load(p, allow_pickle=True)",
        "numpy.load(p, allow_pickle=flag)", "yaml.load(text)",
        "yaml.load(text, Loader=yaml.FullLoader)", "pandas.read_pickle(p)",
        "subprocess.run(text, shell=True)",
    ],
)  # fmt: skip
def test_the_check_sees_it(line):
    assert faults(ast.parse(f"def f():\n    {line}\n"))


@pytest.mark.parametrize(
    "line",
    [
        "model.eval()", "re.compile(text)", "torch.compile(model)",
        "torch.load(p, weights_only=True)", "np.load(p)",
        "yaml.load(text, Loader=yaml.SafeLoader)", "subprocess.run([name])",
    ],
)  # fmt: skip
def test_the_check_lets_the_harmless_pass(line):
    assert not faults(ast.parse(line))
