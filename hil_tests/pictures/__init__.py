"""``python -m hil_tests pictures``: every picture of the READMEs, made by commands."""
