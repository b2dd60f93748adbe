"""One session of cosmic-ray for each module, in a copy of the sources."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import edge_runtime
from edge_runtime.util import UserError

_ROOT = Path(edge_runtime.__file__).parent.parent
_HERE = Path(__file__).parent
_TIMEOUT_S = 120.0
_START_S = 60.0
_ENTRY_POINT = "[cosmic_ray.operator_providers]\nphil = hil_tests.mutation.operators:Provider\n"

# What nobody mistakes for the other: bits for arithmetic, an order for an identity.
_EXCLUDED = (
    "core/ReplaceBinaryOperator_.*_(RShift|LShift|BitOr|BitAnd|BitXor|Mod|FloorDiv|Pow)$",
    "core/ReplaceComparisonOperator_(Is|IsNot)_(Lt|LtE|Gt|GtE|Eq|NotEq)$",
    "core/ReplaceComparisonOperator_(Lt|LtE|Gt|GtE|Eq|NotEq)_(Is|IsNot)$",
)

_CONTROLLER = ("test_controller", "test_controller_vehicle", "test_controller_properties")
_HUNTER = ("test_hunter_enable", "test_hunter_stops", "test_hunter_drive", "test_hunter_table")
# Each module with the tests that must notice a change of it, the quick ones first.
TARGETS = {
    "safety": ("test_safety", *_CONTROLLER),
    "latest": ("test_latest",),
    "wire": ("test_wire",),
    "controller": _CONTROLLER,
    "vehicles/hunter/states": _HUNTER,
    "vehicles/hunter/core": _HUNTER,
}


class Mutant(NamedTuple):
    """A change of one line (or a few), and what the tests said: killed, survived, incompetent."""

    module: str
    operator: str
    was: str
    became: str
    outcome: str


def run_targets(names: Sequence[str], jobs: int) -> list[Mutant]:
    """All mutants of these modules. Raises UserError where cosmic-ray is not installed."""
    if shutil.which("cosmic-ray", path=str(Path(sys.executable).parent)) is None:
        raise UserError("cosmic-ray is not installed here; run this as `make mutate`")
    with ThreadPoolExecutor(jobs) as pool:
        found = pool.map(_run_target, names)
        return [mutant for mutants in found for mutant in mutants]


def _run_target(name: str) -> list[Mutant]:
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copy = Path(folder)
        _copy_sources(copy)
        tests = [f"edge_runtime/tests/{test}.py" for test in TARGETS[name]]
        with _Server(copy) as server:
            _write_config(copy, name, server.test_command(tests))
            _cosmic_ray(copy, "init", "config.toml", "session.sqlite")
            _run(copy, "cr-filter-operators", "session.sqlite", "config.toml")
            _cosmic_ray(copy, "baseline", "config.toml")
            _cosmic_ray(copy, "exec", "config.toml", "session.sqlite")
        lines = _cosmic_ray(copy, "dump", "session.sqlite").splitlines()
    return [_mutant(name, item, result) for item, result in map(json.loads, lines) if _ran(result)]


def _copy_sources(copy: Path) -> None:
    ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
    shutil.copytree(_ROOT / "edge_runtime", copy / "edge_runtime", ignore=ignored)
    shutil.copytree(_HERE, copy / "hil_tests" / "mutation", ignore=ignored)
    (copy / "hil_tests" / "__init__.py").write_text("")
    # What pip would write: so cosmic-ray finds our operators without an installation.
    information = copy / "phil_operators-1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: phil-operators\nVersion: 1\n"
    )
    (information / "entry_points.txt").write_text(_ENTRY_POINT)


def _write_config(copy: Path, name: str, test_command: str) -> None:
    (copy / "config.toml").write_text(
        f'[cosmic-ray]\nmodule-path = "edge_runtime/{name}.py"\ntimeout = {_TIMEOUT_S}\n'
        f"excluded-modules = []\ntest-command = {json.dumps(test_command)}\n"
        '[cosmic-ray.distributor]\nname = "local"\n'
        "[cosmic-ray.filters.operators-filter]\n"
        f"exclude-operators = {json.dumps(_EXCLUDED)}\n"
    )


def _cosmic_ray(copy: Path, *arguments: str) -> str:
    return _run(copy, "cosmic-ray", *arguments)


def _run(copy: Path, program: str, *arguments: str) -> str:
    command = [str(Path(sys.executable).parent / program), *arguments]
    done = subprocess.run(
        command, cwd=copy, env=_environment(copy), capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise UserError(f"{program} {arguments[0]} failed: {lines[-1]}")
    return done.stdout


def _environment(copy: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}


class _Server:
    """The fork server of one copy (fork_server.py)."""

    def __init__(self, copy: Path) -> None:
        self._path = copy / "socket"
        self._process = subprocess.Popen(
            [sys.executable, "-m", "hil_tests.mutation.fork_server", str(self._path)],
            cwd=copy,
            env=_environment(copy),
        )

    def test_command(self, tests: Sequence[str]) -> str:
        """What cosmic-ray starts for each mutant."""
        arguments = ("-x", "-q", "-p", "no:cacheprovider", "--timeout=100", *tests)
        client = _HERE / "fork_client.py"
        return " ".join([sys.executable, "-S", "-E", str(client), str(self._path), *arguments])

    def __enter__(self) -> _Server:
        end_s = time.monotonic() + _START_S
        while not self._path.exists():
            if self._process.poll() is not None or time.monotonic() > end_s:
                raise UserError("the test server did not start; is the environment complete?")
            time.sleep(0.05)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()


def _ran(result: dict | None) -> bool:
    return result is None or result.get("worker_outcome") != "skipped"


def _mutant(name: str, item: dict, result: dict | None) -> Mutant:
    (mutation,) = item["mutations"]
    diff = [
        line
        for line in ((result or {}).get("diff") or "").splitlines()
        if not line.startswith(("--- ", "+++ "))
    ]
    changed = {sign: [line[1:].strip() for line in diff if line[:1] == sign] for sign in "-+"}
    return Mutant(
        module=name,
        operator=mutation["operator_name"].split("/")[-1],
        was=" ".join(changed["-"]),
        became=" ".join(changed["+"]),
        outcome=str((result or {}).get("test_outcome") or "not run"),
    )
