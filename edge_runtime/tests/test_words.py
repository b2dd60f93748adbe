import pytest

from edge_runtime.errors import UserError
from edge_runtime.words import counted, printable


@pytest.mark.parametrize(
    ("count", "words"), [(0, "0 safe stops"), (1, "1 safe stop"), (2, "2 safe stops")]
)
def test_one_is_not_many(count, words):
    assert counted(count, "safe stop") == words


def test_what_a_terminal_would_obey_is_written_out():
    assert printable("two\n lines\t\x1b[31m\x9b \u202e\udc80 grün") == (
        "two lines \\x1b[31m\\x9b \\u202e\\udc80 grün"
    )
    assert str(UserError("file \x1b]0;x\x07\nis not")) == "file \\x1b]0;x\\x07 is not"
