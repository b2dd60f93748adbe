from __future__ import annotations

from edge_runtime.cli import ArgumentParser


def test_help_shows_every_default_that_says_something() -> None:
    parser = ArgumentParser(prog="x")
    parser.add_argument("--seed", type=int, default=0, help="of everything")
    parser.add_argument("--rate", default=1.5, help="in Hz")
    parser.add_argument("--out", default=None, help="file")
    parser.add_argument("--set", action="append", default=[], help="a setting")
    parser.add_argument("--only", default=["a", "b"], help="these parts (default: all)")
    parser.add_argument("--quiet", action="store_true", help="say less")
    text = " ".join(parser.format_help().split())
    assert "of everything (default: 0)" in text
    assert "in Hz (default: 1.5)" in text
    assert text.count("(default: ") == 3
    assert "these parts (default: all)" in text
    assert "None" not in text
    assert "False" not in text
