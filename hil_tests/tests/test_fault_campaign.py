"""One real fault from the campaign's table; all the others are `python -m hil_tests.faults`."""

from hil_tests.faults import render_faults, run_faults


def test_a_killed_edge_is_braked_for_and_a_new_one_drives_on():
    progress = []
    report = run_faults(1, ["edge_killed"], on_progress=lambda *told: progress.append(told))
    (row,) = report["rows"]
    assert (row["wrong"], row["unsafe"], row["crashes"]) == ([], [], [])
    assert row["reasons"] == {"no_command": 1}
    # Measured, and not before its time; how fast it is is the campaign's business.
    assert row["reaction_ms"]["min"] > 100.0
    assert row["recovery_ms"]["min"] > 0.0
    assert progress == [("edge_killed", 1, 1)]
    assert "SIGKILL to the edge runtime" in render_faults(report)
