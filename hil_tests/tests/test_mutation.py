"""What is made of cosmic-ray's sessions (`make mutate`)."""

import tomllib
from pathlib import Path

from hil_tests.mutation.mutants import ACCEPTED, Mutant, judge, read_accepted

ROOT = Path(__file__).parents[2]
KILLED = Mutant("safety.py", "T = 2", "T = 3", "killed")
ALIVE = Mutant("safety.py", "x = 1", "x = 2", "survived")
EQUAL = Mutant("wire.py", "y = 0", "pass", "survived")
REASONED = [{"file": "wire.py", "was": "y = 0", "became": "*", "reason": "y is set again"}]


def test_each_mutant_is_killed_accepted_or_a_survivor():
    assert judge([KILLED, ALIVE, EQUAL], REASONED) == [
        "safety.py: 2 mutants, 1 killed, 0 accepted",
        "wire.py: 1 mutants, 0 killed, 1 accepted",
        "SURVIVED safety.py: `x = 1` became `x = 2`",
    ]


def test_a_mutant_that_did_not_run_is_not_killed():
    assert judge([KILLED._replace(outcome="not run")], [])[1].startswith("SURVIVED")


def test_every_file_and_line_that_is_named_is_there():
    """An entry whose line has changed since would accept nothing, and nobody would notice."""
    settings = [
        tomllib.loads(ACCEPTED.with_name(name).read_text())["cosmic-ray"]
        for name in ("core.toml", "hunter.toml")
    ]
    files = [file for each in settings for file in each["module-path"]]
    tests = [word for each in settings for word in each["test-command"].split() if ".py" in word]
    assert [path for path in (*files, *tests) if not (ROOT / path).is_file()] == []
    for entry in read_accepted():
        assert entry["file"] in files
        assert entry["reason"]
        source = (ROOT / entry["file"]).read_text()
        assert " ".join(entry["was"].split()) in " ".join(source.split()), entry
