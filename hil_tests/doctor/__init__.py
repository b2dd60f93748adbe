"""``python -m hil_tests doctor``: what this machine can do, found out by doing it."""
