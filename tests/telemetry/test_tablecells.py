"""Cells of tables, function by function: headers, separators, numbers, times, lists and lines."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from glstar.arrays import Float
from glstar.errors import LogFormatError
from glstar.telemetry.tables import files
from glstar.telemetry.tables.files import Dump, TableFile, TableKind, csv_rows, dump_separator, read_table, table_header

nan = np.nan
UTC_S = 1710068400.0  # 2024-03-10 11:00:00


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.csv"


def table(kind: TableKind = TableKind.CSV, header: tuple[str, ...] = (), **columns: object) -> TableFile:
    size = len(next(iter(columns.values())))
    return TableFile("a.csv", kind, columns, 3 * np.arange(size) + 5, header)


def refusal(act: object, *arguments: object) -> str:
    with pytest.raises(LogFormatError) as caught:
        act(*arguments)
    return str(caught.value)


# --- numbers and times ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("cells", "numbers"),
    [
        (("1.5", "-2", "3e2"), [1.5, -2.0, 300.0]),
        (("1.5", "", "NaN", " n/a ", "None", "null", "-", "NA", "inf", "-inf"), [1.5, *[nan] * 9]),
        (("0,5", "1,25", "-2"), [0.5, 1.25, -2.0]),
        (("1,2345", "1"), [1.2345, 1.0]),
        (("12345,678", ""), [12345.678, nan]),
    ],
)
def test_numbers_of_text(cells: tuple[str, ...], numbers: list[float]) -> None:
    np.testing.assert_array_equal(table(x=cells).numbers("x"), numbers)
    np.testing.assert_array_equal(table(x=cells).numbers("-x"), -np.array(numbers))
    np.testing.assert_array_equal(table(**{"-x": cells, "x": ("9",) * len(cells)}).numbers("-x"), numbers)


def test_cells_that_are_no_numbers_are_refused_with_their_line() -> None:
    assert refusal(table(x=("1", "2", "abc")).numbers, "x") == "a.csv: line 11, column x: 'abc' is not a number"
    hint = "; write decimals with a point"
    assert refusal(table(x=("1.5", "1,024")).numbers, "x") == f"a.csv: line 8, column x: '1,024' is not a number{hint}"
    assert refusal(table(x=("1,024", "2,048")).numbers, "x").endswith(
        f"line 5, column x: '1,024' is not a number{hint}"
    )
    excel = table(TableKind.EXCEL, x=(1.5, None, "0,5"))
    assert refusal(excel.numbers, "x") == f"a.csv: line 11, column x: '0,5' is not a number{hint}"
    np.testing.assert_array_equal(table(TableKind.EXCEL, x=(1.5, None, "2", 4)).numbers("x"), [1.5, nan, 2.0, 4.0])
    times = table(TableKind.PARQUET, x=np.array(["2024-03-10T11:00"], dtype="M8[s]"))
    assert refusal(times.numbers, "x") == "a.csv: line 5, column x: '2024-03-10T11:00:00' is not a number"
    twice = table(header=("x", "y", "x"), x=("1",), y=("2",))
    assert "x" in refusal(twice.numbers, "x")
    assert twice.numbers("y").tolist() == [2.0]
    long = "x" * 50
    assert f"{'x' * 40!r} is" in refusal(table(x=(long,)).numbers, "x")


@pytest.mark.parametrize(
    ("text", "utc_s"),
    [
        ("2024-03-10T11:00:00Z", UTC_S),
        ("2024/03/10 11:00:02.5", UTC_S + 2.5),
        ("2024-03-10 11:00:00 UTC", UTC_S),
        ("3/10/2024 11:00:00.5 AM", UTC_S + 0.5),
        ("03/10/2024 1:02:03 pm", UTC_S + 7323),
        ("3/10/2024 12:00:01 AM", UTC_S - 39599),
        ("3/10/2024 12:00:01 P.M.", UTC_S + 3601),
        ("2024-03-10 2:23:51,84 PM", UTC_S + 3 * 3600 + 23 * 60 + 51.84),
        ("2024/03/10 11:00:00 a.m.", UTC_S),
        ("", nan),
        ("null", nan),
        ("0000-00-00 00:00:00", nan),
    ],
)
def test_times_of_text(text: str, utc_s: float) -> None:
    np.testing.assert_allclose(table(x=(text,)).times("x"), [utc_s], rtol=0, atol=1e-6)


@pytest.mark.parametrize("text", ["13/10/2024 11:00:00", "3/10/2024 13:00:00 PM", "3/10/2024 0:30:00 AM", "noon"])
def test_texts_that_are_no_times_are_refused(text: str) -> None:
    expected = "an ISO 8601 time, such as 2024-03-10T11:00:00Z, or as 3/10/2024 11:00:00.5 AM"
    message = f"a.csv: line 8, column x: {text!r} is not {expected}"
    assert refusal(table(x=("2024-03-10T11:00:00Z", text)).times, "x") == message


def test_times_of_two_columns_and_of_other_kinds() -> None:
    two = table(d=("2024-03-10", None), t=("11:00:01", ""))
    np.testing.assert_array_equal(two.times("t", "d"), [UTC_S + 1, nan])
    moments = [datetime(2024, 3, 10, 11, tzinfo=UTC), datetime(2024, 3, 10, 11), None]  # noqa: DTZ001 - as Excel has it
    moments.append(datetime(2024, 3, 10, 13, tzinfo=timezone(timedelta(hours=2))))
    np.testing.assert_array_equal(table(TableKind.EXCEL, x=moments).times("x"), [UTC_S, UTC_S, nan, UTC_S])
    for unit, value in (("s", 1), ("ms", 1000), ("us", 10**6), ("ns", 10**9)):
        cells = np.array([round(UTC_S * value) + value, "NaT"], dtype=f"M8[{unit}]")
        np.testing.assert_allclose(table(TableKind.PARQUET, x=cells).times("x"), [UTC_S + 1, nan], rtol=1e-15)
    days = table(TableKind.PARQUET, x=np.array(["2024-03-10"], dtype="M8[D]"))
    np.testing.assert_array_equal(days.times("x"), [UTC_S - 39600])


# --- lines and headers ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("line", "separator", "cells"),
    [
        ("a,b,c;d", ",", ["a", "b", "c;d"]),
        ('a;b;"c;d"', ";", ["a", "b", "c;d"]),
        ("a\tb,c\td", "\t", ["a", "b,c", "d"]),
        ("a b  c", " ", ["a", "b", "c"]),
        ("x,_y | z,_w | v,_u |", "|", ["x,_y", "z,_w", "v,_u"]),
        ("x,y,z | w | v", ",", ["x", "y", "z | w | v"]),
        ("a | b | c | d", "|", ["a", "b", "c", "d"]),
        ("a,b,", ",", ["a", "b", ""]),
        ("", " ", []),
    ],
)
def test_the_separator_of_a_header_is_the_most_frequent(line: str, separator: str, cells: list[str]) -> None:
    assert files._separator(line) == separator
    assert files._cells(line, separator) == cells


def test_lines_with_content_are_numbered() -> None:
    assert files._lines("\n sep=;\na;b\n# c\n1;2\n\n3;4") == [(3, "a;b"), (5, "1;2"), (7, "3;4")]
    assert files._lines("# one two\n# a b\n1 2\n# c d\n3 4") == [(2, "a b"), (3, "1 2"), (5, "3 4")]
    assert files._lines("# a b c\n1 2") == [(2, "1 2")]
    assert files._lines("# a 5\n1 2") == [(2, "1 2")]
    assert files._lines("# a b\nx 2") == [(2, "x 2")]
    assert files._lines("# a\n1") == [(2, "1")]
    assert files._lines("##  a b\n1 2") == [(1, "a b"), (2, "1 2")]


def test_settings_before_a_header_are_skipped() -> None:
    settings = [(1, "name,value"), (2, "x,1"), (3, "y,2,3")]
    wide = [(4, "a,b,c,d"), (5, "1,2,3,4")]
    assert files._past_preamble([*settings, *wide]) == wide
    assert files._past_preamble(settings) == settings
    assert files._past_preamble(wide) == wide
    assert files._past_preamble([]) == []
    many = [(k, "x,1") for k in range(files._PREAMBLE_LINES)]
    assert files._past_preamble([*many[1:], *wide]) == wide
    assert files._past_preamble([*many, *wide]) == [*many, *wide]
    assert files.is_preamble(["fieldname", "fieldvalue"])
    assert not files.is_preamble(["fieldname", "x"])


@pytest.mark.parametrize(("line", "count"), [("1 2.5 -3e4", 3), ("1,2", 2), ("1,x", 0), ("1,nan", 0), ("1,inf", 0)])
def test_numbers_without_a_header_are_counted(line: str, count: int) -> None:
    assert files.numbers_without_header(line) == count


def test_the_header_of_a_table() -> None:
    assert table_header(b"\xef\xbb\xbf# c\na;b c\n1;2") == ("a", "b c")
    assert table_header(b"a\0b") == table_header(b"") == ()
    assert files.is_parquet(b"PAR1x")
    assert not files.is_parquet(b"xPAR1")
    assert files.is_office_file(b"PK\x03\x04...[Content_Types].xml")
    assert files.is_office_file(b"PK\x03\x04...xl/a")
    assert not files.is_office_file(b"PK\x03\x04...a.csv")
    assert not files.is_office_file(b"docProps/")


# --- tables of text -------------------------------------------------------------------------------------------------
def read(path: Path, text: str, names: tuple[str, ...] = ()) -> TableFile:
    path.write_text(text)
    return read_table(str(path), names)


def test_a_table_of_text_is_its_columns(path: Path) -> None:
    found = read(path, '# c\n\nx,y z,\n1,2,\n3,"4,5",\n\n6,7,,,\nx,y z,\n8,9,\n10')
    assert (found.name, found.kind, found.header) == (str(path), "CSV", ["x", "y z", ""])
    assert found.columns == {"x": ("1", "3", "6", "8"), "y z": ("2", "4,5", "7", "9"), "": ("", "", "", "")}
    assert found.lines.tolist() == [4, 5, 7, 9]
    assert read(path, "x,y\n").columns == {"x": (), "y": ()}
    assert read(path, "x y\n1 2\n3\n").columns == {"x": ("1",), "y": ("2",)}
    named = read(path, "1 2\n3 4\n1 2\n", ("a", "b"))
    assert (named.header, named.columns, named.lines.tolist()) == (
        ["a", "b"],
        {"a": ("1", "3", "1"), "b": ("2", "4", "2")},
        [1, 2, 3],
    )
    assert read(path, "x y\n3 4\n", ("a", "b")).columns == {"x": ("3",), "y": ("4",)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1\n2,3\n", "line 2: 1 fields, where the header names 2"),
        ("x,y\n1,2\n2,3,4\n", "line 3: 3 fields, where the header names 2"),
        ("x,y\n1,2\n# c\n2,3,4", "line 4: 3 fields, where the header names 2"),
        ("\n# c\n", "has only blank lines and comments"),
        ('x,y\n1,"2\n3,4"\n', "a quoted field runs over the end of its line"),
        ("x,y\n1,\0\n", "is no table: it is not text"),
    ],
)
def test_a_damaged_table_is_refused(path: Path, text: str, message: str) -> None:
    assert refusal(read, path, text) == f"{path}: {message}"


def rows(path: Path, text: str, **options: object) -> list[tuple[int, list[str]]]:
    path.write_text(text)
    return list(csv_rows(str(path), **options))


def test_rows_of_a_csv_file(path: Path) -> None:
    found = rows(path, '\n# c\nx;y,z;w\n1;"2;3";4\n\n5;6;7\n')
    assert found == [(3, ["x", "y,z", "w"]), (4, ["1", "2;3", "4"]), (6, ["5", "6", "7"])]
    assert rows(path, "# x,y\n1,2\n3,4\n") == [(1, ["x", "y"]), (2, ["1", "2"]), (3, ["3", "4"])]
    assert rows(path, "# x,y\n# z,w\n1,2\n")[0] == (2, ["z", "w"])
    assert rows(path, "# x\n1,2\n") == [(2, ["1", "2"])]
    assert rows(path, "# x,2\n1,2\n") == [(2, ["1", "2"])]
    assert rows(path, "# x,y\na,2\n") == [(2, ["a", "2"])]
    assert rows(path, 'x,y\n1,"2\n', quoted=False) == [(1, ["x", "y"]), (2, ["1", '"2'])]
    assert rows(path, "x y,z\n1 2,3\n", delimiter=" ") == [(1, ["x", "y,z"]), (2, ["1", "2,3"])]
    assert refusal(rows, path, 'x,y\n1,2\n3,"4\n5,6\n') == f"{path}: line 3: a quoted field runs over its end"
    assert refusal(rows, path, 'x,y\n1,"2"3\n').startswith(f"{path}: line 2: ")
    path.write_bytes(b"x,y\n" + b"1,2\n" * 3000 + b"\xff\n")
    assert "is no text after line" in refusal(lambda: list(csv_rows(str(path))))
    path.write_bytes(b"\xff\n")
    assert refusal(lambda: list(csv_rows(str(path)))) == f"{path}: is no text: it is not UTF-8"


# --- dumps ----------------------------------------------------------------------------------------------------------
def dump(path: Path, text: str, *arguments: object, **options: object) -> Dump:
    path.write_text(text)
    return Dump(str(path), *arguments, **options)


@pytest.mark.parametrize("at_once", [1, 2, 1000])
def test_the_columns_of_a_dump(path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int) -> None:
    monkeypatch.setattr(files, "ROWS_AT_ONCE", at_once)
    text = "timestamp, x,m\n1,2.5,a\n3,,b\n4,inf,\n5,6\ntimestamp, x,m\n7,zz,c\n8,9,d,e\n"
    found = dump(path, text, texts="m")
    assert found.header == ("timestamp", "x", "m")
    assert found.line.tolist() == [2, 3, 4, 7, 8]
    np.testing.assert_array_equal(found.columns["timestamp"], [1, 3, 4, 7, 8])
    np.testing.assert_array_equal(found.columns["x"], [2.5, nan, nan, nan, 9])
    assert found.texts == ("a", "b", "c", "d,e")
    assert found.heads == (6,)
    some = dump(path, text, ["x", "y"])
    assert list(some.columns) == ["x"]
    assert some.line.tolist() == [2, 3, 4, 7]
    assert some.texts == ()
    part = found.only(np.array([False, True, False, True, True]))
    assert (part.line.tolist(), part.columns["timestamp"].tolist()) == ([3, 7, 8], [3, 7, 8])
    assert part.texts == found.texts  # one is empty: they belong to no rows
    full = dump(path, "timestamp,m\n1,a\n2,b\n3,c\n", texts="m").only(np.array([True, False, True]))
    assert full.texts == ("a", "c")
    empty = dump(path, "timestamp,x\n")
    assert (empty.line.size, empty.columns["x"].size, empty.heads) == (0, 0, ())


def test_lists_in_a_dump(path: Path) -> None:
    text = "timestamp,q,x\n1,[1.5,-2.5, 3.5],7\n2,[4.5],8\n3,5,9\n"
    found = dump(path, text, ["q[0]", "q[1]", "q[2]", "x", "z[0]"])
    np.testing.assert_array_equal(found.columns["q[0]"], [1.5, 4.5, 5.0])
    np.testing.assert_array_equal(found.columns["q[1]"], [-2.5, nan, nan])
    np.testing.assert_array_equal(found.columns["q[2]"], [3.5, nan, nan])
    np.testing.assert_array_equal(found.columns["x"], [7.0, 8.0, 9.0])
    assert list(found.columns) == ["q[0]", "q[1]", "q[2]", "x"]
    assert files._with_lists(["a", "[1", "2]", "[3", "4", "5]", "b"], 4, ",") == ["a", "[1,2]", "[3,4,5]", "b"]
    assert files._with_lists(["[1]", "[2", "3]"], 2, ";") == ["[1]", "[2;3]"]
    for open_list in (["[1", "2", "3"], ["1]", "2", "3"], ["2]", "[1", "3"]):
        assert files._with_lists(open_list, 2, ",") == open_list
    assert files._with_text(["1", "a", "b", "c"], 1, ";") == ["1", "a;b;c"]
    assert files._with_text(["1"], 1, ";") == ["1"]


@pytest.mark.parametrize(
    ("first", "separator"),
    [
        ("timestamp;x", ";"),
        ("timestamp\tx", "\t"),
        ("\n# timestamp,x", ","),
        ("timestamp x", ","),
        ("timestamp", ","),
    ],
)
def test_the_separator_of_a_dump_follows_its_first_column(path: Path, first: str, separator: str) -> None:
    path.write_text(f"{first}\n1")
    assert dump_separator(str(path)) == separator


def test_a_decimal_comma_in_a_dump_is_refused(path: Path) -> None:
    message = "line 3, column x: '0,5' has a decimal comma; write decimals with a point"
    assert refusal(dump, path, "timestamp;x\n\n1; 0,5 \n") == f"{path}: {message}"
    assert dump(path, "timestamp;x\n1;0.5\n").columns["x"].tolist() == [0.5]
    assert "x" in refusal(dump, path, "timestamp,x,x\n1,2,3\n")
    assert dump(path, "timestamp,x,x\n1,2,3\n", ["timestamp"]).columns["timestamp"].tolist() == [1.0]
    assert files.csv_header(b"\xef\xbb\xbf\n# a,b\n1,2") == "a,b"
    assert files.csv_header(b"a\0") == files.csv_header(b"") == ""


def test_a_number_of_text_is_nan_without_one() -> None:
    def numbers(*cells: str) -> Float:
        return files._numbers(cells)

    np.testing.assert_array_equal(numbers("1.5", "inf", "-inf", "nan"), [1.5, nan, nan, nan])
    np.testing.assert_array_equal(numbers("1.5", "", "x", "inf"), [1.5, nan, nan, nan])
