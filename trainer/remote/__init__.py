"""A policy that is not on the vehicle: its answers as they come over a network."""
