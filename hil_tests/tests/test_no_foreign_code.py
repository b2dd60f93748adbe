"""Nothing from outside, a message or a file, is ever run as code: held by reading every file."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("edge_runtime", "bridge", "trainer", "hil_tests", "deploy")
UNPICKLERS = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
RUNNERS = {"eval", "exec", "compile", "__import__"}
SAFE_YAML = {"SafeLoader", "CSafeLoader"}


def shipped(folder: str) -> list[Path]:
    return [p for p in (ROOT / folder).rglob("*.py") if not {"tests", "build"} & set(p.parts)]


def keyword(call: ast.Call, name: str) -> object:
    """The constant that a keyword argument is; None where it is absent or computed."""
    found = [
        k.value.value for k in call.keywords if k.arg == name and isinstance(k.value, ast.Constant)
    ]
    return found[0] if found else None


def fault_of(node: ast.AST) -> str | None:
    """What is wrong with one node of a syntax tree."""
    if isinstance(node, ast.Import):
        names = {alias.name.split(".")[0] for alias in node.names}
        return "unpickles" if names & UNPICKLERS else None
    if isinstance(node, ast.ImportFrom):
        return "unpickles" if (node.module or "").split(".")[0] in UNPICKLERS else None
    if not isinstance(node, ast.Call):
        return None
    function = node.func
    if isinstance(function, ast.Name):
        return "runs text as code" if function.id in RUNNERS else None
    if not isinstance(function, ast.Attribute):
        return None
    return fault_of_method(node, function)


def fault_of_method(node: ast.Call, function: ast.Attribute) -> str | None:
    owner = ast.unparse(function.value)
    if function.attr == "load" and owner == "torch" and keyword(node, "weights_only") is not True:
        return "torch.load without weights_only=True"
    if (
        any(k.arg == "allow_pickle" for k in node.keywords)
        and keyword(node, "allow_pickle") is not False
    ):
        return "allow_pickle"
    if owner == "yaml" and function.attr in ("load", "load_all", "unsafe_load", "full_load"):
        loaders = {ast.unparse(k.value).split(".")[-1] for k in node.keywords if k.arg == "Loader"}
        return None if loaders & SAFE_YAML else "yaml.load"
    if function.attr in ("read_pickle", "to_pickle"):
        return "unpickles"
    if keyword(node, "shell"):
        return "runs text in a shell"
    return None


def faults(source: str) -> list[str]:
    found = (fault_of(node) for node in ast.walk(ast.parse(source)))
    return [fault for fault in found if fault]


@pytest.mark.parametrize("folder", FOLDERS)
def test_nothing_shipped_runs_what_it_reads(folder):
    files = shipped(folder)
    assert files
    for path in files:
        assert faults(path.read_text()) == [], path


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from marshal import loads",
        "import cloudpickle as c",
        "eval(text)",
        "exec(open(p).read())",
        "torch.load(p)",
        "torch.load(p, weights_only=False)",
        "torch.load(p, weights_only=flag)",
        "np.load(p, allow_pickle=True)",
        "numpy.load(p, allow_pickle=flag)",
        "yaml.load(text)",
        "yaml.load(text, Loader=yaml.FullLoader)",
        "pandas.read_pickle(p)",
        "subprocess.run(text, shell=True)",
    ],
)
def test_the_check_sees_it(line):
    assert faults(f"def f():\n    {line}\n")


@pytest.mark.parametrize(
    "line",
    [
        "model.eval()",
        "re.compile(text)",
        "torch.compile(model)",
        "torch.load(p, weights_only=True)",
        "np.load(p)",
        "yaml.load(text, Loader=yaml.SafeLoader)",
        "subprocess.run([name])",
    ],
)
def test_the_check_lets_the_harmless_pass(line):
    assert not faults(line)
