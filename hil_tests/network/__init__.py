"""The loop over a kernel's own TCP and UDP, against the same network in virtual and real time."""
