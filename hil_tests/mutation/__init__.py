"""Proof that the safety tests can fail: every small change of the core must break one of them."""
