"""``glstar sky``: its accuracy as claimed, and its notes in each format."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from glstar.cli import app
from tests.support.satellites import PASS, elements

pytest.importorskip("skyfield_data")
from tests.support.horizonplaces import listed_beside_authorities

ADELAIDE = ("sky", "--lat", "-34.93", "--lon", "138.60")
UT1 = "continues the last value of astropy-iers-data"
YEARS = "within 90 arcsec only"
OLD = "elements are up to"


def listed(*words: object) -> Result:
    result = CliRunner().invoke(app, [*ADELAIDE, *map(str, words)])
    assert result.exit_code == 0, result.output
    return result


@pytest.mark.parametrize("seed", range(5))
def test_all_rows_are_as_accurate_as_the_manual_claims(seed: int, tmp_path: Path) -> None:
    rows = list(listed_beside_authorities(seed, tmp_path))

    assert {row.kind for row in rows} == {"stars", "bodies", "satellites"}
    assert [row for row in rows if row.excess > 1] == []


@pytest.mark.parametrize(
    ("utc", "what", "notes"),
    [
        ("2060-03-10T11:00:00Z", ("--vmag", 1), [UT1]),
        ("2060-03-10T11:00:00Z", ("--bodies",), [YEARS, UT1]),
        ("2032-03-10T11:00:00Z", ("--satellites", "{file}", "--all"), [OLD, UT1]),
        ("2060-03-10T11:00:00Z", ("--bodies", "--dut1", 0.1), [YEARS]),
        ("2024-03-18T10:37:30Z", ("--satellites", "{file}", "--all"), []),
        ("2024-03-18T10:37:30Z", ("--bodies",), []),
        ("2024-03-18T10:37:30Z", ("--vmag", 1), []),
    ],
)
def test_notes_are_in_the_json_on_standard_error_and_in_the_caption(
    utc: str, what: tuple[object, ...], notes: list[str], tmp_path: Path
) -> None:
    pytest.importorskip("astropy_iers_data")
    (tmp_path / "pass.tle").write_text(elements(PASS), encoding="utf-8")
    words = ("--utc", utc, *(str(word).format(file=tmp_path / "pass.tle") for word in what))

    as_json, as_csv, as_table = (listed(*words, "--format", kind) for kind in ("json", "csv", "table"))

    rows = json.loads(as_json.stdout)
    assert rows
    for row in rows:
        for found, expected in zip(row.get("notes", []), notes, strict=True):
            assert expected in found
    for result in (as_json, as_csv):
        lines = result.stderr.splitlines()
        assert [line for line in lines if not line.startswith("note: ")] == []
        assert lines == [f"note: {note}" for note in rows[0].get("notes", [])]
    assert "notes" not in as_csv.stdout
    caption = " ".join(as_table.stdout.split())
    assert [note for note in rows[0].get("notes", []) if note not in caption] == []
    assert as_table.stderr == ""


def test_old_elements_are_said_where_no_satellite_is_listed(tmp_path: Path) -> None:
    (tmp_path / "pass.tle").write_text(elements(PASS), encoding="utf-8")
    for hour in range(24):
        result = listed("--satellites", tmp_path / "pass.tle", "--json", "--utc", f"2024-06-18T{hour:02}:00:00Z")
        if json.loads(result.stdout) == []:
            assert OLD in result.stderr
            assert "no satellite is above the horizon" in result.stderr
            return
    pytest.fail("the satellite never set")
