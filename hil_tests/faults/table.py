"""All rows of the fault table."""

from __future__ import annotations

from hil_tests.faults import ends, garbage, hunter, messages, recordings, vehicles
from hil_tests.faults.row import Row

ROWS: tuple[Row, ...] = (
    *ends.ROWS,
    *garbage.ROWS,
    *messages.ROWS,
    *vehicles.ROWS,
    *hunter.ROWS,
    *recordings.ROWS,
)
