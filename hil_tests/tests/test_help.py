"""Every command has ``--help`` with examples, and its own parser takes each of them."""

import argparse
import importlib
import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.installer import __main__ as installer
from edge_runtime import __version__
from edge_runtime.cli import ArgumentParser, examples

ROOT = Path(__file__).parents[2]
PACKAGES = ("edge_runtime", "bridge", "trainer", "deploy", "hil_tests")

LEAST_WRITING = {"edge_runtime": 2, "bridge": 6, "trainer": 7, "deploy": 4, "hil_tests": 7}
"""Commands with an --out of those packages."""


def find_programs():
    """Every module with a parser of its own, as ``python -m`` names it."""
    sources = [path for folder in PACKAGES for path in (ROOT / folder).rglob("*.py")]
    texts = [path.read_text() for path in sources if "tests" not in path.parts]
    return sorted({name for text in texts for name in re.findall(r'prog="python -m (\S+)"', text)})


PROGRAMS = find_programs()


class ParsedError(Exception):
    """The arguments are good; what they ask for is not done."""


@pytest.fixture
def only_parse(monkeypatch):
    """Parsers end once they have read their arguments, and keep what help they print."""
    helps = []

    def parse(parser, arguments):
        argparse.ArgumentParser.parse_args(parser, arguments)
        raise ParsedError

    monkeypatch.setattr(ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(ArgumentParser, "_print_message", lambda _, text, *__: helps.append(text))
    return helps


def main_of(program):
    spec = importlib.util.find_spec(program)
    assert spec is not None
    is_package = spec.submodule_search_locations is not None
    return importlib.import_module(f"{program}.__main__" if is_package else program).main


def help_of(program, words, helps):
    helps.clear()
    with pytest.raises(SystemExit) as ended:
        main_of(program)([*words, "--help"])
    assert ended.value.code == 0
    return helps[-1]


def subcommands_in(text):
    """The names below COMMAND in the help of a package."""
    _, _, below = text.partition("\n  COMMAND\n")
    return re.findall(r"^ {4}(\w+)", below.partition("\n\n")[0], re.M)


def examples_in(text):
    """The words of each example's command line, without ``python -m``."""
    _, _, below = text.replace("\\\n", " ").partition("\nexample")
    lines = re.findall(r"^(?:.*: | +)python -m (.+)$", below, re.M)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_command_shows_examples_that_it_takes(program, only_parse):
    shown = help_of(program, [], only_parse)
    commands = [[name] for name in subcommands_in(shown)]
    assert bool(commands) == (program in PACKAGES)
    for words in [[], *commands]:
        found = examples_in(help_of(program, words, only_parse))
        assert found, f"python -m {program} {' '.join(words)} --help has no example"
        for example in found:
            assert example[: 1 + len(words)] == [program, *words]
            # `train --set` alone lists the settings and ends; it drives nothing.
            lists = example[-1] == "--set"
            with pytest.raises(SystemExit if lists else ParsedError) as ended:
                main_of(program)(example[1:])
            assert not lists or ended.value.args == (0,)


@pytest.mark.parametrize(("program", "least"), LEAST_WRITING.items())
@pytest.mark.parametrize("empty", [("--out", ""), ("--out=",)], ids=" ".join)
def test_an_empty_name_of_what_is_written_is_refused(program, least, empty, only_parse):
    """It would be the directory where one stands, or, taken for no name, none at all."""
    commands = subcommands_in(help_of(program, [], only_parse))
    writing = [name for name in commands if "--out " in help_of(program, [name], only_parse)]
    assert len(writing) >= least
    for name in writing:
        with pytest.raises(SystemExit) as ended:
            main_of(program)([name, *empty])
        assert ended.value.code == 2
        assert f"{name}: an empty value after --out (see" in only_parse[-1]


def test_a_wrong_example_is_found_out(only_parse):
    parser = ArgumentParser(prog="x", epilog=examples("python -m x --runs \\\n    two # runs"))
    parser.add_argument("--runs", type=int)
    (example,) = examples_in(parser.format_help())
    assert example == ["x", "--runs", "two"]
    with pytest.raises(SystemExit) as ended:
        parser.parse_args(example[1:])
    assert ended.value.code == 2


def test_phil_runs_every_folder():
    """As installed: the script lies beside the Python that runs this test."""
    phil = Path(sys.executable).with_name("phil")
    for words, status, said in (
        (["trainer", "--version"], 0, __version__),
        (["edge_runtime", "chekc"], 2, "chekc"),
        (["bridg"], 2, "did you mean bridge?"),
        ([], 0, "hil_tests"),
    ):
        ended = subprocess.run([phil, *words], capture_output=True, text=True)
        assert ended.returncode == status
        assert said in ended.stdout + ended.stderr


def test_the_installer_shows_examples_that_it_takes():
    parser = installer._parser()
    (commands,) = (
        action for action in parser._actions if isinstance(action, argparse._SubParsersAction)
    )
    for one in [parser, *commands.choices.values()]:
        text = " ".join(one.format_help().split())
        _, _, example = text.partition("example: sudo python3 install.pyz ")
        parser.parse_args(shlex.split(example))


@pytest.mark.parametrize("empty", [["--root", ""], ["--root="]], ids=" ".join)
def test_the_installer_takes_no_empty_root(empty, capsys):
    """It would be the directory where one stands."""
    with pytest.raises(SystemExit) as ended:
        installer.main(["uninstall", *empty])
    assert ended.value.code == 2
    assert "an empty value" in capsys.readouterr().err


def test_the_installer_takes_a_root_that_ends_with_an_equals_sign():
    assert installer._parser().parse_args(["uninstall", "--root=/a="]).root == "/a="


def test_examples_and_paragraphs_keep_their_lines():
    parser = ArgumentParser(
        prog="x", description="One.\n\nTwo\nlines.", epilog=examples("a \\\n    b") + "\n\nAnd\nso."
    )
    text = parser.format_help()
    assert "One.\n\nTwo lines." in text
    assert text.endswith("examples:\n  a \\\n      b\n\nAnd so.\n")
