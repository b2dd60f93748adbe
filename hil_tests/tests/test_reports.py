"""The two files of a campaign's report."""

import json

import pytest

from edge_runtime.util import UserError
from hil_tests.reports import check_report, write_report


def test_the_markdown_stands_beside_the_json(tmp_path):
    out = tmp_path / "r.json"
    check_report(out)
    write_report(out, {"passed": True}, ["# Campaign", "", "all", ""])
    assert json.loads(out.read_text()) == {"passed": True}
    assert (tmp_path / "r.md").read_text() == "# Campaign\n\nall\n"


def test_what_could_not_be_written_is_said_before_the_work(tmp_path):
    with pytest.raises(UserError, match=r"r\.md is for the JSON"):
        check_report(tmp_path / "r.md")
    (tmp_path / "r.md").mkdir()
    with pytest.raises(UserError, match="is a directory"):
        check_report(tmp_path / "r.json")
