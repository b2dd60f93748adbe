"""What goes onto the board: a wheel that stands alone and loads no more than it needs."""

from __future__ import annotations

import ast
import json
import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import List

import pytest

import edge_runtime
from edge_runtime.__main__ import script
from edge_runtime.config import DEFAULT_BUS, HunterSettings, Ros2Settings
from edge_runtime.tests.harness import EdgeProcess, Simulator, make_state
from edge_runtime.transport import free_endpoint
from edge_runtime.vehicles.hunter import parse_bus
from edge_runtime.vehicles.hunter.protocol import PROFILES
from edge_runtime.vehicles.mapping import SPECS
from edge_runtime.vehicles.ros2 import check_settings

ROOT = Path(edge_runtime.__file__).parent
LOCK = ROOT.parent / "requirements" / "edge-py38.txt"
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
    [("import edge_runtime.run", 2880), ("import edge_runtime.__main__, edge_runtime.run", 3150)],
    ids=["the run itself", "with the command line"],
)
def test_run_without_a_vehicle_loads_no_more_than_it_needs(what, most_lines):
    loaded = loaded_by(what)
    assert not LAZY & {path.relative_to(ROOT).parts[0].replace(".py", "") for path in loaded}
    assert sum(len(path.read_text().splitlines()) for path in loaded) < most_lines


def test_a_vehicle_loads_no_other_one():
    making = """
from edge_runtime.config import Config
from edge_runtime.vehicles import make_vehicle
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


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of a copy: building writes into its source folder."""
    folder = tmp_path_factory.mktemp("wheel")
    ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
    shutil.copytree(ROOT, folder / "edge_runtime", ignore=ignored)
    built = pip(
        sys.executable, "wheel", "--no-deps", "--wheel-dir", ".", "./edge_runtime", cwd=folder
    )
    skip_without_index(built)
    assert built.returncode == 0, built.stderr
    return next(folder.glob("*.whl"))


def pip(python, *arguments, cwd=None):
    command = [python, "-m", "pip", "--disable-pip-version-check", "--quiet", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=cwd, timeout=200, check=False
    )


def skip_without_index(result):
    if result.returncode != 0 and "No matching distribution" in result.stderr:
        pytest.skip("no package index can be reached")


def find_python38():
    candidates = [shutil.which("python3.8")]
    candidates += [str(p) for p in sorted(Path.home().glob(".pyenv/versions/3.8*/bin/python"))]
    for candidate in filter(None, candidates):
        probe = subprocess.run(
            [candidate, "-c", "import sys; print(sys.version_info[:2])"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if probe.stdout.strip() == "(3, 8)":
            return candidate
    return None


def test_the_wheel_holds_only_the_runtime(wheel):
    archive = zipfile.ZipFile(wheel)
    names = archive.namelist()
    assert wheel.name.endswith("-py3-none-any.whl")
    assert {name.split("/")[0].split("-")[0] for name in names} == {
        "edge_runtime",
        "phil_edge_runtime",
    }
    assert not [name for name in names if "/tests/" in name or "conftest" in name]
    assert {"edge_runtime/__main__.py", "edge_runtime/vehicles/mock.py"} <= set(names)
    assert "edge_runtime/config.example.toml" in names
    assert "edge_runtime/py.typed" in names
    (scripts,) = (name for name in names if name.endswith("entry_points.txt"))
    assert f"phil-edge = {script.__module__}:{script.__name__}" in archive.read(scripts).decode()


@pytest.mark.timeout(600)
def test_the_boards_python_and_versions(wheel, make_policy, tmp_path):
    python38 = find_python38()
    if python38 is None:
        pytest.skip("no Python 3.8 on PATH or under ~/.pyenv")
    subprocess.run([python38, "-m", "venv", str(tmp_path / "board")], check=True)
    python = str(tmp_path / "board" / "bin" / "python")
    installed = pip(python, "install", "--only-binary=:all:", str(wheel), "-r", str(LOCK))
    skip_without_index(installed)
    assert installed.returncode == 0, installed.stderr
    signed = make_policy("mean")
    checked = subprocess.run(
        [python, "-m", "edge_runtime", "check", str(signed.path),
         "--public-key", str(signed.public_key)],
        capture_output=True, text=True, cwd=tmp_path, check=False,
    )  # fmt: skip
    assert (checked.returncode, checked.stderr) == (0, "")
    report = json.loads(checked.stdout)
    assert report["policy_id"] == signed.policy_id
    assert report["onnxruntime"] == "1.19.2"
    # The optional ROS 2 messages, too, in the same bytes.
    twist = "Twist(Vector3(1.5), Vector3(0.0, 0.0, 0.5))"
    code = (
        "from edge_runtime.vehicles.ros2.node import *;"
        f" m = {twist}; b = encode(m); assert decode(b, Twist) == m; print(b.hex())"
    )
    written = subprocess.run(
        [python, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert (written.stdout.strip(), written.stderr) == (
        "00010000" + struct.pack("<6d", 1.5, 0, 0, 0, 0, 0.5).hex(), ""
    )  # fmt: skip
    # The board's Zenoh against the workstation's, over the wire.
    endpoint = free_endpoint()
    flags = (*signed.flags, "--connect", endpoint)
    with EdgeProcess(*flags, python=python, cwd=tmp_path) as edge:
        # The edge first, then one simulator after the other: each must see that it is alive.
        for session in ("first", "second"):
            with Simulator(endpoint) as simulator:
                simulator.wait_for_edge()
                command = simulator.ask(make_state(0, session=session, final=True))
                assert (command.mode, command.action) == ("drive", [-1.0])
        assert edge.end() == 0
