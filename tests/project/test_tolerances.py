"""Every relative tolerance in the suite is explicit: the default of `assert_allclose`, 1e-7, is 171 s of a UTC."""

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

TESTS = Path(__file__).parent.parent
SOURCES = sorted(TESTS.rglob("*.py"))
# What holds seconds since 1970 or since boot, says so.
CLOCKS = ("utc", "clock", "boot", "eleven_s", "first_s", "last_s")
NUMPY = {"assert_allclose", "allclose", "isclose"}


def names_in(node: ast.AST) -> Iterator[str]:
    for part in ast.walk(node):
        yield getattr(part, "id", getattr(part, "attr", ""))


def calls_in(node: ast.AST) -> Iterator[tuple[ast.Call, str, set[str | None]]]:
    """Each call in a piece of a program: itself, its function's name, its keywords."""
    for part in ast.walk(node):
        if isinstance(part, ast.Call):
            name = getattr(part.func, "attr", getattr(part.func, "id", ""))
            yield part, name, {keyword.arg for keyword in part.keywords}


def default_tolerances(source: str) -> list[int]:
    """Return the lines that use a default relative tolerance."""
    tree = ast.parse(source)
    lines = {call.lineno for call, name, given in calls_in(tree) if name in NUMPY and not given & {"rtol", "rel_tol"}}
    # pytest.approx(x, abs=...) has no relative tolerance, but pytest.approx(x) has 1e-6.
    for compared in (node for node in ast.walk(tree) if isinstance(node, ast.Compare)):
        if any(clock in name.lower() for name in names_in(compared) for clock in CLOCKS):
            lines |= {
                call.lineno for call, name, given in calls_in(compared) if name == "approx" and "abs" not in given
            }
    return sorted(lines)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(TESTS).as_posix())
def test_a_comparison_names_its_relative_tolerance(path: Path) -> None:
    lines = default_tolerances(path.read_text(encoding="utf-8"))
    assert not lines, (
        f"{path.name}, lines {lines}: say rtol=0 beside atol (or rtol=... alone), and approx(utc_s, abs=...): "
        "the default relative tolerance is 171 s (NumPy) or 1700 s (pytest) of a UTC"
    )


def test_the_default_relative_tolerance_passes_a_utc_that_is_minutes_wrong() -> None:
    utc_s = 1710068400.0
    np.testing.assert_allclose(utc_s + 170, utc_s, rtol=1e-7, atol=1e-6)
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(utc_s + 1e-5, utc_s, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("line", "refused"),
    [
        ("np.testing.assert_allclose(utc_s, x, atol=1e-6)", True),
        ("np.testing.assert_allclose(a, b)", True),
        ("assert np.isclose(a, b).all()", True),
        ("assert attitude.utc_s[0] == pytest.approx(UTC_S)", True),
        ("assert attitude.utc_s[0] == pytest.approx(UTC_S, rel=1e-9)", True),
        ("np.testing.assert_allclose(utc_s, x, rtol=0, atol=1e-6)", False),
        ("np.testing.assert_allclose(a, b, rtol=1e-12)", False),
        ("assert attitude.utc_s[0] == pytest.approx(UTC_S, abs=1e-6)", False),
        ("assert site.height_m == pytest.approx(48.0)", False),
    ],
)
def test_the_check_finds_a_default_tolerance(line: str, refused: bool) -> None:
    assert bool(default_tolerances(line)) == refused
