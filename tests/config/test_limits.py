"""The limits of the config's keys are those that a person reads when a value is refused."""

import re
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from glstar.config.keys import SECTIONS, SYNTHETIC

NUMBER = r"(-?[\d.]*\d)"
WORDS = {
    rf"{NUMBER} to {NUMBER}(?! \d)": ("at_least", "at_most"),
    rf"between {NUMBER} and {NUMBER}": ("above", "below"),
    rf"above {NUMBER}, at most {NUMBER}": ("above", "at_most"),
    rf"{NUMBER} or more": ("at_least",),
    rf"^a whole number from {NUMBER}$": ("at_least",),
    rf"an angle of up to {NUMBER}": ("at_most",),
    rf"an azimuth in degrees up to {NUMBER}": ("at_most",),
    r"^a positive ()": ("above",),
}
IS_ALLOWED = {"at_least": True, "at_most": True, "above": False, "below": False}
OUTWARDS = {"at_least": -1, "above": -1, "at_most": 1, "below": 1}


def stated(field: FieldInfo) -> dict[str, float]:
    """Return the limits that the description of a key states."""
    for pattern, names in WORDS.items():
        if (found := re.search(pattern, field.description or "")) is not None:
            return {name: float(number or 0) for name, number in zip(names, found.groups(), strict=True)}
    return {}


def accepts(field: FieldInfo, value: float) -> bool:
    try:
        TypeAdapter(field.rebuild_annotation()).validate_python(value)
    except ValidationError:
        return False
    return True


CASES = [
    pytest.param(field, *limit, id=f"{section}.{name}-{limit[0]}")
    for section, model in SECTIONS.items()
    for name, field in model.model_fields.items()
    if section != SYNTHETIC and re.search("int|float", str(field.annotation))
    for limit in stated(field).items()
]


def test_many_keys_state_limits() -> None:
    assert len(CASES) > 150


@pytest.mark.parametrize(("field", "name", "limit"), CASES)
def test_a_key_is_limited_as_its_description_says(field: FieldInfo, name: str, limit: float) -> None:
    is_whole = "int" in str(field.annotation) and "float" not in str(field.annotation)
    kind: Any = int if is_whole else float
    step = OUTWARDS[name] * (1 if is_whole else 1e-6 * max(1.0, abs(limit)))
    assert not accepts(field, kind(limit + step))
    assert accepts(field, kind(limit)) == IS_ALLOWED[name]
    assert accepts(field, kind(limit - step))


def test_a_key_says_all_of_its_upper_limits() -> None:
    silent = [
        f"{section}.{name}"
        for section, model in SECTIONS.items()
        for name, field in model.model_fields.items()
        if any(hasattr(one, "le") or hasattr(one, "lt") for one in field.metadata)
        and not {"at_most", "below"} & set(stated(field))
    ]
    assert silent == []
