"""Recorded states through another policy or runtime, and what differs."""
