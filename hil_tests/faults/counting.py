"""Rows in which the drive goes on: the gaps between its commands, and what was counted."""

from __future__ import annotations

import json
import time
from collections import Counter
from typing import Any

from hil_tests.faults.processes import wait_until
from hil_tests.faults.rig import Rig
from hil_tests.faults.row import Row, Try
from hil_tests.faults.timeline import longest_gap_s, stops_between

_HEALTH_S = 0.6

DRIVES_ON = "drives on; each rejected and counted by reason"
GAP = "longest gap between commands"


def edge_counts(rig: Rig) -> Counter[str]:
    """The edge's counts, by a health message that was sent after all that was sent so far."""
    time.sleep(_HEALTH_S)
    seen = len(rig.probe.health)
    wait_until(lambda: len(rig.probe.health) > seen, "a health message")
    return Counter(rig.probe.rejected())


def simulator_counts(rig: Rig) -> Counter[str]:
    """The simulator's counts, from the report that it wrote at its end."""
    report = json.loads((rig.directory / "report.json").read_text())
    return Counter(report["rejected_by_simulator"])


def drove_on(
    rig: Rig, begin_s: float, end_s: float, wanted: Counter[str], counted: Counter[str]
) -> Try:
    """The try of a row in which nothing is to happen but counting."""
    gap_s = longest_gap_s((c.seen_s for c in list(rig.timeline.commands)), begin_s, end_s)
    wrong = [] if counted == wanted else [f"counted {dict(counted)}, sent {dict(wanted)}"]
    # Safe stops come as steadily as drives: the gaps alone would not tell.
    wrong += stops_between(rig.timeline.commands, begin_s, end_s)
    return Try(gap_s, rejected=dict(counted), wrong=wrong)


def counted_row(*cells: Any, **options: Any) -> Row:
    """States flow on, but in the flood and where the drive is ended to read its report."""
    return Row(*cells, **{"flows": True, **options})
