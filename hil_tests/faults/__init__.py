"""Faults done to real processes, and how fast each is noticed and got over."""

from __future__ import annotations

from hil_tests.faults.campaign import check_rows, run_faults
from hil_tests.faults.render import render_faults

__all__ = ["check_rows", "render_faults", "run_faults"]
