"""The only part that runs on the board: verifies a policy, drives it over Zenoh, stops safely."""

__version__ = "0.1.0"
