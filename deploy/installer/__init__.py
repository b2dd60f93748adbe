"""What runs on the board to install, upgrade and undo: Python 3.8's standard library, nothing else.

`deploy bundle` packs this folder as `install.pyz`. It imports nothing of the other parts.
"""
