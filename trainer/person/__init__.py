"""A person at the wheel: drives, takes over from a policy, and is recorded."""
