"""A Hunter of arithmetic on a CAN bus: `process.py` alone has a clock and a bus."""
