"""What goes onto the board: a wheel that stands alone and loads no more than it needs."""

import json
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import distributions
from pathlib import Path
from typing import List

import pytest
from hil_tests.tests.shared.drives import Simulator, run_edge
from hil_tests.tests.shared.messages import make_state

import edge_runtime
from edge_runtime.__main__ import script
from edge_runtime.reach import free_endpoint

ROOT = Path(edge_runtime.__file__).parent
LOCK = ROOT.parent / "requirements" / "edge-py38.txt"
# Only who asks for them loads them.
LAZY = {"hunter", "mock", "ros2"}
_LOADED = """
import json, sys
{what}
files = [m.__file__ for n, m in sys.modules.items() if n.split(".")[0] == "edge_runtime"]
print(json.dumps([files, list({{name.split(".")[0] for name in sys.modules}})]))
"""
UNWANTED = {"torch", "gymnasium", "highway_env", "rerun", "rerun_sdk", "onnx", "trainer", "bridge"}


def loaded_by(what: str) -> List[Path]:
    files, packages = json.loads(run(sys.executable, "-c", _LOADED.format(what=what)).stdout)
    assert not UNWANTED & set(packages)
    return [Path(name) for name in files]


def test_run_without_a_vehicle_loads_no_more_than_it_needs():
    assert len(loaded_by("import edge_runtime")) == 1
    loaded = loaded_by("import edge_runtime.__main__, edge_runtime.run")
    assert not LAZY & {part for path in loaded for part in path.with_suffix("").parts}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of a copy: building writes into its source folder."""
    folder = tmp_path_factory.mktemp("wheel")
    ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
    shutil.copytree(ROOT, folder / "edge_runtime", ignore=ignored)
    # With the setuptools that is here, if it is new enough: another one need not be fetched then.
    here = next((found.version for found in distributions(name="setuptools")), "")
    options = ["--no-build-isolation"] if here >= "75" else []
    words = ("wheel", "--no-deps", *options, "--wheel-dir", ".", "./edge_runtime")
    pip(sys.executable, *words, cwd=folder)
    return next(folder.glob("*.whl"))


def run(*command, cwd=None):
    words = [str(word) for word in command]
    return subprocess.run(words, capture_output=True, text=True, cwd=cwd, timeout=200)


def pip(python, *arguments, cwd=None):
    done = run(python, "-m", "pip", "-q", "--disable-pip-version-check", *arguments, cwd=cwd)
    if done.returncode != 0 and "No matching distribution" in done.stderr:
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr


def find_python38():
    pyenv = sorted(Path.home().glob(".pyenv/versions/3.8*/bin/python"))
    there = filter(None, [shutil.which("python3.8"), *pyenv])
    version = ("-c", "import sys; print(sys.version_info[:2])")
    return next((python for python in there if run(python, *version).stdout == "(3, 8)\n"), None)


def test_the_wheel_holds_only_the_runtime(wheel):
    archive = zipfile.ZipFile(wheel)
    names = archive.namelist()
    assert wheel.name.endswith("-py3-none-any.whl")
    parts = {name.split("/")[0].split("-")[0] for name in names}
    assert parts == {"edge_runtime", "phil_edge_runtime"}
    assert not [name for name in names if "/tests/" in name or "conftest" in name]
    wanted = ("__main__.py", "vehicles/mock.py", "config.example.toml", "py.typed")
    assert {f"edge_runtime/{name}" for name in wanted} <= set(names)
    (scripts,) = (name for name in names if name.endswith("entry_points.txt"))
    assert f"phil-edge = {script.__module__}:{script.__name__}" in archive.read(scripts).decode()


@pytest.mark.timeout(600)
def test_the_boards_python_and_versions(wheel, make_policy, tmp_path):
    python38 = find_python38()
    if python38 is None:
        pytest.skip("no Python 3.8 on PATH or under ~/.pyenv")
    create = [python38, "-m", "venv", "--without-pip", str(tmp_path / "board")]
    subprocess.run(create, check=True)
    python = str(tmp_path / "board" / "bin" / "python")
    # Most of what is installed is never imported here: what is, Python compiles by itself.
    install = ("install", "--no-compile", "--only-binary=:all:", wheel, "-r", LOCK)
    pip(python38, "--python", python, *install)
    signed = make_policy("mean")
    flags = (signed.path, "--public-key", signed.public_key)
    checked = run(python, "-m", "edge_runtime", "check", *flags, cwd=tmp_path)
    assert (checked.returncode, checked.stderr) == (0, "")
    report = json.loads(checked.stdout)
    assert (report["policy_id"], report["onnxruntime"]) == (signed.policy_id, "1.19.2")
    # The board's Zenoh against the workstation's, over the wire.
    endpoint = free_endpoint()
    flags = (*signed.flags, "--connect", endpoint)
    with run_edge(*flags, python=python, cwd=tmp_path) as edge:
        # The edge first, then one simulator after the other: each must see that it is alive.
        for session in ("first", "second"):
            with Simulator(endpoint) as simulator:
                simulator.wait_for_edge()
                command = simulator.ask(make_state(0, session=session, final=True))
                assert (command.mode, command.action) == ("drive", [-1.0])
        assert edge.end() == 0
