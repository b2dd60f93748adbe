from __future__ import annotations

from hil_tests.mutation.report import judge, read_accepted, render
from hil_tests.mutation.session import TARGETS, Mutant

KILLED = Mutant("safety", "NumberReplacer", "T = 2", "T = 3", "killed")
ALIVE = Mutant("safety", "NumberReplacer", "x = 1", "x = 2", "survived")
EQUAL = Mutant("wire", "StatementRemover", "y = 0", "pass", "survived")
ACCEPTED = [{"module": "wire", "was": "y = 0", "became": "*", "reason": "y is set again"}]


def test_each_mutant_is_killed_accepted_or_a_survivor():
    report = judge([KILLED, ALIVE, EQUAL], ACCEPTED)
    assert report["modules"] == {
        "safety": {"mutants": 2, "killed": 1, "accepted": 0, "survived": 1},
        "wire": {"mutants": 1, "killed": 0, "accepted": 1, "survived": 0},
    }
    assert [entry["was"] for entry in report["survived"]] == ["x = 1"]
    text = render(report)
    assert "| safety.py | 2 | 1 | 0 | 1 |" in text
    assert "`y = 0` became `pass`: y is set again" in text


def test_a_mutant_that_did_not_run_is_not_killed():
    report = judge([KILLED._replace(outcome="not run")], [])
    assert report["modules"]["safety"]["survived"] == 1


def test_an_accepted_mutant_names_a_line_of_the_source(pytestconfig):
    """An entry whose line has changed since would accept nothing, and nobody would notice."""
    for entry in read_accepted():
        assert entry["module"] in TARGETS
        assert entry["reason"]
        source = (pytestconfig.rootpath / "edge_runtime" / f"{entry['module']}.py").read_text()
        assert " ".join(entry["was"].split()) in " ".join(source.split()), entry
