from argparse import ArgumentTypeError

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.option_types import (
    not_negative,
    not_negative_number,
    positive,
    positive_number,
    seconds,
    share,
    whole_number,
)


@given(st.integers(-5, 20), st.integers(-3, 3), st.integers(0, 10))
def test_a_whole_number_is_taken_within_its_limits_only(value, least, width):
    kind = whole_number(least, least + width)
    if least <= value <= least + width:
        assert kind(str(value)) == value
    else:
        with pytest.raises(ArgumentTypeError, match=f"from {least} to {least + width}"):
            kind(str(value))


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (positive, "1", 1),
        (not_negative, "0", 0),
        (not_negative, str(2**63 - 1), 2**63 - 1),
        (positive_number, "1e-9", 1e-9),
        (not_negative_number, "0", 0.0),
        (seconds, "0.5", 0.5),
        (share, "1", 1.0),
    ],
)
def test_the_limits_themselves_are_taken(kind, text, value):
    assert kind(text) == value


@pytest.mark.parametrize(
    ("kind", "text", "line"),
    [
        (positive, "0", "'0' is not a whole number, at least 1"),
        (positive, "1.5", "'1.5' is not a whole number, at least 1"),
        (not_negative, "-1", "'-1' is not a whole number, at least 0"),
        (not_negative, "many", "'many' is not a whole number, at least 0"),
        (not_negative, str(2**63), f"'{2**63}' is larger than 2**63 - 1"),
        (positive_number, "0", "'0' is not a finite number above 0"),
        (positive_number, "inf", "'inf' is not a finite number above 0"),
        (not_negative_number, "nan", "'nan' is not a finite number, at least 0"),
        (seconds, "-0.1", "'-0.1' is not a finite number of seconds, at least 0"),
        (share, "1.01", "'1.01' is not a share above 0 and at most 1"),
        (share, "half", "'half' is not a share above 0 and at most 1"),
    ],
)
def test_what_is_wrong_is_said_in_words(kind, text, line):
    with pytest.raises(ArgumentTypeError) as refusal:
        kind(text)
    assert str(refusal.value) == line
