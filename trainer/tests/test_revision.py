"""The commit that a result names: of the code, whatever results lie beside it."""

import subprocess

from trainer.revision import revision_of, source_revision


def git(directory, *arguments: str) -> str:
    named = ("-c", "user.name=a", "-c", "user.email=a@b")
    command = ["git", *named, *arguments]
    done = subprocess.run(command, cwd=directory, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_changed_code_is_dirty_and_changed_results_are_not(tmp_path):
    code, results = tmp_path / "trainer" / "code.py", tmp_path / "results" / "table.md"
    for path in (code, results):
        path.parent.mkdir()
        path.write_text("as committed")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-qm", "all")
    commit = git(tmp_path, "rev-parse", "HEAD")
    results.write_text("a run has written")
    (results.parent / "more.md").write_text("new")
    assert revision_of(code.parent) == commit
    code.write_text("changed")
    assert revision_of(code.parent) == f"{commit}-dirty"


def test_outside_of_a_repository_it_is_unknown(tmp_path):
    assert revision_of(tmp_path) == "unknown"


def test_a_process_names_the_code_that_it_began_with():
    assert source_revision() is source_revision()
