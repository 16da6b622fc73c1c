"""TOML values, read back by tomllib."""

import tomllib
from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.config.keys import toml_value

scalars = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8"))
)


def same(value: object, read: object) -> bool:
    """Whether two values are equal and of one type; lists item by item."""
    if isinstance(value, list) and isinstance(read, list):
        return len(value) == len(read) and all(map(same, value, read))
    return type(value) is type(read) and value == read


@given(value=scalars | st.lists(scalars | st.lists(scalars, max_size=3), max_size=4))
def test_any_value_is_read_back_as_it_was(value: object) -> None:
    text = toml_value(value)

    assert same(value, tomllib.loads(f"value = {text}  # a comment\n")["value"])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([True, False], "[true, false]"),
        ([inf, -inf, 0.5], "[inf, -inf, 0.5]"),
        ([np.float64(-0.25), 1e-9], "[-0.25, 1e-09]"),
        ("a\nb\x7f", '"a\\nb\\u007f"'),
    ],
)
def test_a_value_is_written_on_one_line(value: object, text: str) -> None:
    assert toml_value(value) == text
