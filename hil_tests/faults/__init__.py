"""Faults done to real processes, and how fast each is noticed and got over."""
