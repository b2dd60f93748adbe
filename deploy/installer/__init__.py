"""Installs, upgrades and undoes releases on the board, with Python 3.8's standard library alone.

`deploy bundle` packs this folder as `install.pyz`, with the few modules of `edge_runtime` that it
imports.
"""
