"""Rules that are held by reading every file: imports, links, and the --help of every command."""

import argparse
import ast
import graphlib
import importlib
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from glob import glob
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from edge_runtime import __version__
from edge_runtime.cli import ArgumentParser

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
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
DOORS = {"can": ROOT / "edge_runtime/vehicles/hunter/__init__.py"}
"""Where alone the edge runtime may load a library that only one kind of vehicle needs."""
ELSEWHERE = {"ray", "av", "pyarrow", "foxglove", "stable_baselines3", "pytest", "hypothesis"}
"""Extras, and what the peers' environment has."""
ONLY_IN = {
    "torch": {"trainer"},
    "highway_env": {"trainer"},
    "onnx": {"trainer", "bridge", "hil_tests"},
}
"""Heavy libraries and the only folders that may load them."""
RUNS = re.compile(r"allow_pickle ?= ?True|shell ?=|(?<![.\w])(__import__|compile)\(")
"""What runs what it reads and is in no rule of ruff, which has `eval`, pickle and the rest."""
OURS = re.compile(
    r"left_turn|LeftTurn|\b2x45x80|\b45, 80\b|(?i:\bT|control_period_s)(: float)? = 0\.1$"
    r"|period\w*\(0\.1\)",
    re.M,
)
"""What only the trainer may know: its scenarios, their picture and their control period."""


def sources(folder: str) -> list[Path]:
    """Return the folder's files without tests and their helpers, which may use all folders."""
    others = {"tests", "build"}
    return [p for p in (ROOT / folder).rglob("*.py") if not others & set(p.parts)]


EVERY_SOURCE = [path for folder in ARROWS for path in sources(folder)]
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in EVERY_SOURCE
}


@cache
def modules_of(path: Path) -> frozenset[str]:
    """Return the dotted names of all modules that a file imports, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            for name in (f"{node.module}.{alias.name}" for alias in node.names):
                names.add(name if name in MODULES else node.module)
    return frozenset(names)


def imported(path: Path) -> set[str]:
    """Return the packages that a file imports."""
    return {name.partition(".")[0] for name in modules_of(path)}


@pytest.mark.parametrize("folder", ARROWS)
def test_a_folder_imports_only_what_stands_below_it(folder):
    heavy = {library for library, folders in ONLY_IN.items() if folder not in folders}
    for path in sources(folder):
        neighbours = imported(path) & set(ARROWS) - {folder}
        assert neighbours <= ARROWS[folder], path
        assert not imported(path) & heavy, path
        assert not [name for name in modules_of(path) if "tests" in name.split(".")], path
        assert not RUNS.search(path.read_text()), path


@pytest.mark.parametrize("folder", sorted(ARROWS.keys() - {"trainer"}))
def test_no_modules_of_a_folder_import_each_other(folder):
    known = {name: path for name, path in MODULES.items() if name.startswith(f"{folder}.")}
    imports = {name: (modules_of(path) & known.keys()) - {name} for name, path in known.items()}
    graphlib.TopologicalSorter(imports).prepare()  # CycleError names the circle


def test_the_edge_runtime_uses_only_libraries_that_a_board_has():
    for path in sources("edge_runtime"):
        foreign = imported(path) - set(sys.stdlib_module_names) - {"edge_runtime"}
        assert foreign <= EDGE_LIBRARIES | {name for name in DOORS if DOORS[name] == path}, path


def test_every_library_that_is_imported_is_a_dependency():
    lines = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    asked_for = {re.split(r"[^\w.-]", line)[0].lower() for line in lines}
    installed = packages_distributions()
    modules = {name for path in EVERY_SOURCE for name in imported(path)}
    for module in modules - {*ARROWS, *ELSEWHERE} - sys.stdlib_module_names:
        names = {name.lower() for name in installed.get(module, ())}
        assert names & asked_for, module


@pytest.mark.parametrize("folder", ["edge_runtime", "bridge"])
def test_what_drives_any_policy_knows_none_of_ours(folder):
    for path in sources(folder):
        assert OURS.search(path.read_text()) is None, path


class ParsedError(Exception):
    """The arguments are good; what they ask for is not done."""


@pytest.fixture
def only_parse(monkeypatch):
    """Let parsers end once they have read their arguments; return the texts that they print."""
    helps = []

    def parse(parser, arguments):
        argparse.ArgumentParser.parse_args(parser, arguments)
        raise ParsedError

    monkeypatch.setattr(ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(ArgumentParser, "_print_message", lambda _, text, *__: helps.append(text))
    return helps


def examples_in(text):
    """Return the words of each example's command line, without ``python -m``."""
    _, _, below = text.replace("\\\n", " ").partition("\nexample")
    lines = re.findall(r"^(?:.*: | +)python -m (.+)$", below, re.M)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.parametrize("folder", ARROWS)
def test_every_command_shows_examples_that_it_takes(folder, only_parse):
    program = importlib.import_module(f"{folder}.__main__")
    for words in [[], *([name] for name in program.COMMANDS)]:
        with pytest.raises(SystemExit):
            program.main([*words, "--help"])
        found = examples_in(only_parse[-1])
        assert found, f"python -m {folder} {' '.join(words)} --help has no example"
        for example in found:
            assert example[: 1 + len(words)] == [folder, *words]
            # `train --set` alone lists the settings and ends; it drives nothing.
            with pytest.raises(SystemExit if example[-1] == "--set" else ParsedError):
                program.main(example[1:])


HEAVY = ("torch", "highway_env", "matplotlib", "rerun", "scipy", "tensorboard", "pandas", "pygame")
"""Each takes half a second or more to load."""
SHOW_ALL = """
import importlib, sys
program = importlib.import_module(f"{sys.argv[1]}.__main__")
for words in [[], *([name] for name in program.COMMANDS)]:
    try:
        program.main([*words, "--help"])
    except SystemExit:
        pass
print(*sorted(set(sys.argv[2:]) & set(sys.modules)), file=sys.stderr)
"""


@pytest.mark.parametrize("folder", ARROWS)
def test_no_help_waits_for_what_takes_long_to_load(folder):
    command = [sys.executable, "-c", SHOW_ALL, folder, *HEAVY]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stderr.split() == []


def test_phil_runs_every_folder(tmp_path):
    """As installed: the script lies beside the Python that runs this test."""
    phil = Path(sys.executable).with_name("phil")
    for words, status, said in (
        (["trainer", "--version"], 0, __version__),
        (["bridg"], 2, "bridg"),
    ):
        ended = subprocess.run([phil, *words], capture_output=True, text=True, cwd=tmp_path)
        assert ended.returncode == status
        assert said in ended.stdout + ended.stderr


KINDS = ("*.md", "*/README.md", "docs/*.md")
READMES = sorted({Path(name) for kind in KINDS for name in glob(kind, root_dir=ROOT)})


def anchors(text: str) -> set[str]:
    """Return the names that GitHub gives a page's headings."""
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", each.lower()).strip().replace(" ", "-") for each in headings}


@pytest.mark.parametrize("readme", READMES, ids=str)
def test_links_and_kept_files_exist(readme):
    text, folder = (ROOT / readme).read_text(), ROOT / readme.parent
    for link, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]+))?\)", text):
        target = folder / link if link else ROOT / readme
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), (link, anchor)
    for path in re.findall(r"\bresults/[\w./-]+\.(?:onnx|pub|json|csv|md)\b", text):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("readme", READMES, ids=str)
def test_commands_in_prose_are_taken(readme, only_parse):
    blocks = re.findall(r"^ *```(?:bash|sh)\n(.*?)```$", (ROOT / readme).read_text(), re.M | re.S)
    text = "".join(blocks).replace("\\\n", " ").replace("$AT", "tls/h:1")
    for line in re.findall(rf"python -m ((?:{'|'.join(ARROWS)}) [^&|;<>\n]+)", text):
        folder, *words = shlex.split(line, comments=True)
        with pytest.raises(ParsedError):
            importlib.import_module(f"{folder}.__main__").main(words)


def test_every_folder_has_a_readme_and_what_is_read_first_is_short():
    assert {Path(folder) / "README.md" for folder in ARROWS} <= set(READMES)
    assert len((ROOT / "README.md").read_bytes()) <= 8192
    assert [path.name for path in DOCS.glob("*.*") if path.stat().st_size > 2_000_000] == []
