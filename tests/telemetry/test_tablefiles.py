"""Cells of Parquet and Excel files of every type, and what is refused."""

from datetime import date, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np
import openpyxl
import pyarrow as pa
import pytest
from pyarrow import parquet

from glstar.errors import LogFormatError
from glstar.telemetry import tables
from glstar.telemetry.tables import excel_rows
from glstar.telemetry.tables.files import TableFile, TableKind, read_table

MOMENT = datetime(2024, 3, 10, 11)  # noqa: DTZ001 - as a spreadsheet has it
UTC_S = 1710068400.0


def parquet_of(path: Path, **columns: object) -> TableFile:
    parquet.write_table(pa.table(columns), path)
    return read_table(str(path))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.table"


def test_columns_of_a_parquet_file(path: Path) -> None:
    found = parquet_of(
        path,
        whole=pa.array([3, None, 5], pa.int32()),
        full=pa.array([3, 4, 5], pa.int64()),
        real=pa.array([1.5, 2.5, None], pa.float32()),
        text=["a", None, "a"],
        flag=[True, False, None],
        exact=pa.array([Decimal("1.25"), None, Decimal("3.50")], pa.decimal128(5, 2)),
        moment=pa.array([MOMENT, None, MOMENT], pa.timestamp("ms")),
        day=pa.array([date(2024, 3, 10), None, date(2024, 3, 11)], pa.date32()),
        parts=[[1, 2], [3], []],
    )
    columns = found.columns
    assert (found.kind, found.lines.tolist(), list(found.header)) == (TableKind.PARQUET, [1, 2, 3], list(columns))
    assert (len(columns), "text" in columns, "x" in columns) == (9, True, False)
    np.testing.assert_array_equal(columns["whole"], [3.0, np.nan, 5.0])
    assert columns["full"].dtype == np.int64
    assert columns["full"].tolist() == [3, 4, 5]
    np.testing.assert_array_equal(columns["real"], [1.5, 2.5, np.nan])
    assert columns["real"].dtype == np.float64
    assert list(columns["text"]) == ["a", None, "a"]
    assert list(columns["flag"]) == [True, False, None]
    np.testing.assert_array_equal(found.numbers("exact"), [1.25, np.nan, 3.5])
    np.testing.assert_array_equal(found.times("moment"), [UTC_S, np.nan, UTC_S])
    np.testing.assert_array_equal(found.times("day"), [UTC_S - 39600, np.nan, UTC_S + 46800])
    with pytest.raises(KeyError):
        columns["x"]
    with pytest.raises(LogFormatError, match=r"its column parts holds list<.*>, not numbers, times or text"):
        columns["parts"]


def test_text_of_several_row_groups_is_one_column(path: Path) -> None:
    parquet.write_table(pa.table({"t": ["a", "b", "c", "b"], "n": [1, 2, 3, 4]}), path, row_group_size=2)
    found = read_table(str(path))
    assert list(found.columns["t"]) == ["a", "b", "c", "b"]
    assert found.columns["n"].tolist() == [1, 2, 3, 4]
    two = found.columns._unpacked_bytes("n")
    parquet.write_table(pa.table({"t": ["a", "b", "c", "b"], "n": [1, 2, 3, 4]}), path, row_group_size=1)
    assert two < read_table(str(path)).columns._unpacked_bytes("n")


def test_a_column_above_the_limit_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = parquet_of(path, n=list(range(50_000)), s=[1.0] * 50_000)
    monkeypatch.setenv("GLSTAR_MAX_CONTENT_MIB", "0.1")
    assert found.columns["s"].size == 50_000
    with pytest.raises(LogFormatError, match="its column n unpacks to more than glstar takes"):
        found.columns["n"]


def workbook(path: Path, *rows: tuple[object, ...]) -> str:
    book = openpyxl.Workbook()
    for number, row in enumerate(rows, start=1):
        for column, cell in enumerate(row, start=1):
            if cell is not None:
                book.active.cell(number, column, cell)
    book.create_sheet("other").append(["no"])
    book.save(path.with_suffix(".xlsx"))
    return str(path.with_suffix(".xlsx"))


def test_rows_of_the_first_sheet_with_cells(path: Path) -> None:
    name = workbook(
        path, (None,), ("x", " y ", None, "x z"), (1, 2.5), (), (None, "a", None, None, "note"), (MOMENT, True)
    )
    assert [number for number, _ in excel_rows(name)] == [2, 3, 5, 6]
    found = read_table(name)
    assert (found.kind, found.header, found.lines.tolist()) == (TableKind.EXCEL, ["x", "y", "", "x z"], [3, 5, 6])
    assert dict(found.columns) == {"x": (1, None, MOMENT), "y": (2.5, "a", True), "x z": (None, None, None)}
    only = workbook(path, ("x", "y"))
    assert dict(read_table(only).columns) == {"x": (), "y": ()}
    with pytest.raises(LogFormatError, match="its first sheet is empty"):
        read_table(workbook(path, ()))


@pytest.mark.parametrize(
    ("limit", "most", "is_refused"), [("ROWS", 3, False), ("ROWS", 2, True), ("CELLS", 6, False), ("CELLS", 5, True)]
)
def test_a_sheet_above_a_limit_is_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int, is_refused: bool
) -> None:
    name = workbook(path, ("x", "y"), (1, 2), (3, 4))
    monkeypatch.setenv(f"GLSTAR_MAX_{limit}", str(most))
    if is_refused:
        with pytest.raises(LogFormatError, match=f"has {most + 1} {limit.lower()}"):
            read_table(name)
    else:
        assert read_table(name).columns["y"] == (2, 4)


@pytest.mark.parametrize(("name", "most"), [("_EXCEL_ROWS", 2), ("_EXCEL_COLUMNS", 1)])
def test_a_cell_beyond_the_last_of_excel_is_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch, name: str, most: int
) -> None:
    assert (tables._EXCEL_ROWS, tables._EXCEL_COLUMNS) == (2**20, 2**14)
    sheet = workbook(path, ("x", "y"), (1, 2), (3, 4))
    monkeypatch.setattr(tables, name, most + 1)
    assert read_table(sheet).columns["y"] == (2, 4)
    monkeypatch.setattr(tables, name, most)
    with pytest.raises(LogFormatError, match="has a cell beyond the last row or column of Excel"):
        read_table(sheet)
