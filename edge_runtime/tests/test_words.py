import pytest

from edge_runtime.errors import UserError
from edge_runtime.words import counted, printable


@pytest.mark.parametrize(
    ("count", "words"), [(0, "0 safe stops"), (1, "1 safe stop"), (2, "2 safe stops")]
)
def test_one_is_not_many(count, words):
    assert counted(count, "safe stop") == words


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a brake, 0.5 m/s\u00b2", "a brake, 0.5 m/s\u00b2"),
        ("\x1b[2J\x1b]0;title\x07", r"\x1b[2J\x1b]0;title\x07"),
        ("\x9b31m", r"\x9b31m"),  # the same as ESC [, in one character
        ("abc\u202edcb", r"abc\u202edcb"),  # from here on right to left
        ("line\r\nline", r"line\r\nline"),
        ("\udcff", r"\udcff"),  # a byte that is no UTF-8
    ],
)
def test_what_a_terminal_acts_upon_is_written_out(text, shown):
    assert printable(text) == shown


def test_an_error_is_one_line_that_no_terminal_obeys():
    assert str(UserError("file \x1b]0;x\x07\nis not")) == "file \\x1b]0;x\\x07 is not"
