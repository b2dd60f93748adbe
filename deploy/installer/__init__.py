"""The installer on the board: Python 3.8 and its standard library alone."""
