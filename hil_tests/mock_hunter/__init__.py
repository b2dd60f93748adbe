"""A Hunter of arithmetic on a CAN bus: it speaks the chassis's frames and obeys as it does.

The chassis's state machine, the actuators, the battery and the faults are pure, with time passed
in; `process.py` alone has a clock and a bus.
"""
