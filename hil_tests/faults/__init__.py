"""Faults done to real processes, and how fast each is noticed and got over."""

from __future__ import annotations

from hil_tests.faults.campaign import run_faults
from hil_tests.faults.render import render_faults

__all__ = ["render_faults", "run_faults"]
