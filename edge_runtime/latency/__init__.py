"""The injected network: one model for every end that stands in for a real one."""
