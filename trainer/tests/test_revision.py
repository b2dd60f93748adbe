"""The commit that a result names: of the code, whatever results lie beside it."""

import subprocess

from trainer.revision import revision_of, source_revision


def git(directory, *arguments: str) -> str:
    named = ("-c", "user.name=a", "-c", "user.email=a@b")
    command = ["git", *named, *arguments]
    done = subprocess.run(command, cwd=directory, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_changed_code_is_dirty_and_changed_results_are_not(tmp_path):
    code, human = tmp_path / "trainer" / "code.py", tmp_path / "results" / "humans" / "human.pt"
    paper = tmp_path / "results" / "paper"
    table, unit = paper / "README.md", paper / "left_turn.jsonl"
    for path in (code, human, table, unit):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("as committed")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-qm", "all")
    commit = git(tmp_path, "rev-parse", "HEAD")
    table.write_text("a run has written")
    unit.write_text("another one")
    (unit.parent / "fig7.png").write_text("new")
    assert revision_of(code.parent) == commit
    for path in (human, code):
        path.write_text("changed")
        assert revision_of(code.parent) == f"{commit}-dirty"
        path.write_text("as committed")


def test_outside_of_a_repository_it_is_unknown(tmp_path):
    assert revision_of(tmp_path) == "unknown"


def test_a_process_names_the_code_that_it_began_with():
    assert source_revision() is source_revision()
