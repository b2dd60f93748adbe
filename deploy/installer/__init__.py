"""What runs on the board to install, upgrade and undo: Python 3.8's standard library, nothing else.

`deploy bundle` packs this folder as `install.pyz`, with the modules of the edge runtime that it
imports: they need nothing more.
"""
