"""Proof that the safety tests can fail: cosmic-ray's settings, and what it may leave alive."""
