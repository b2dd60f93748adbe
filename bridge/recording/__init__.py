"""MCAP recordings of the wire."""
