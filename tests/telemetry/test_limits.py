"""Limits of packed files and tables: what exceeds a lowered limit is refused, with the variable that raises it."""

import bz2
import gzip
import io
import os
import re
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import openpyxl
import pandas as pd
import pyarrow as pa
import pytest
import zstandard
from pyarrow import parquet

from glstar.errors import LogFormatError
from glstar.system.userinput import LIMITS, Unpacking
from glstar.telemetry import open_flight
from glstar.telemetry.bags.storage import _inflated
from glstar.telemetry.tables.files import read_table
from glstar.telemetry.tracks import read_track

START_S = 1710068400.0
ROWS = 50
OWN = {
    "utc_s": START_S + np.arange(ROWS) / 10,
    "roll_deg": np.zeros(ROWS),
    "pitch_deg": np.zeros(ROWS),
    "yaw_deg": np.arange(ROWS) * 1.0,
    "latitude_deg": np.full(ROWS, -34.93),
    "longitude_deg": np.full(ROWS, 138.6),
}


def csv() -> bytes:
    return pd.DataFrame(OWN).to_csv(index=False).encode()


def refusal(path: Path | str) -> str:
    with pytest.raises(LogFormatError) as caught:
        open_flight(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def zipped(files: dict[str, bytes]) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return target.getvalue()


@pytest.mark.parametrize("suffix", [".gz", ".zip"])
def test_a_log_that_unpacks_to_more_than_the_limit_is_refused(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"flight.csv{suffix}"
    path.write_bytes(gzip.compress(csv()) if suffix == ".gz" else zipped({"flight.csv": csv()}))
    assert open_flight(path).attitude.utc_s.size == ROWS

    monkeypatch.setenv("GLSTAR_MAX_UNPACKED_GIB", "1e-6")

    assert refusal(path) == (
        f"{path}: unpacks to more than glstar takes; glstar reads up to 1e-06 GiB (GLSTAR_MAX_UNPACKED_GIB raises the"
        " limit)"
    )


def test_a_file_that_unpacks_to_a_multiple_of_its_size_is_refused_from_64_mib_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unpacking = Unpacking(1 << 20, "unpacked_gib")
    unpacking.add(250 << 20)
    with pytest.raises(ValueError, match=r"a much larger file.* 250 times its size \(GLSTAR_MAX_RATIO raises"):
        unpacking.add(1)

    Unpacking(1, "unpacked_gib").add(64 << 20)
    monkeypatch.setenv("GLSTAR_MAX_RATIO", "300")
    unpacking.add(49 << 20)


def test_an_archive_of_many_members_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLSTAR_MAX_MEMBERS", "3")
    path = tmp_path / "card.zip"
    path.write_bytes(zipped({f"{k}.txt": b"x" for k in range(3)} | {"flight.csv": csv()}))

    assert "has 4 members; glstar reads up to 3 members (GLSTAR_MAX_MEMBERS raises" in refusal(path)


def test_archives_inside_each_other_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content, path = csv(), tmp_path / "flight.csv.gz"
    for _ in range(3):
        content = gzip.compress(content)
    path.write_bytes(content)
    assert open_flight(path).attitude.utc_s.size == ROWS

    path.write_bytes(gzip.compress(content))
    assert "has 4 archives; glstar reads up to 3 archives (GLSTAR_MAX_ARCHIVES raises" in refusal(path)
    monkeypatch.setenv("GLSTAR_MAX_ARCHIVES", "4")
    assert open_flight(path).attitude.utc_s.size == ROWS


@pytest.mark.parametrize("compression", ["lz4", "zstd", "bz2"])
def test_a_chunk_of_a_bag_that_unpacks_to_more_than_the_limit_is_refused(
    compression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack = {"lz4": lz4.frame.compress, "zstd": zstandard.compress, "bz2": bz2.compress}[compression]
    content = bytes(3 << 20)
    assert _inflated(compression, pack(content)) == content
    # What there is of a chunk whose end is missing.
    noise = np.random.default_rng(1).bytes(3 << 20)
    assert noise.startswith(_inflated(compression, pack(noise)[:-1000]))

    monkeypatch.setenv("GLSTAR_MAX_CONTENT_MIB", "2")
    with pytest.raises(ValueError, match="GLSTAR_MAX_CONTENT_MIB raises the limit"):
        _inflated(compression, pack(content))


def track(placemarks: int = 3, depth: int = 1) -> bytes:
    point = "<Placemark><TimeStamp><when>2024-03-10T11:00:0{k}Z</when></TimeStamp><Point><coordinates>138.6,-34.9,9"
    points = "".join(point.replace("{k}", str(k)) + "</coordinates></Point></Placemark>" for k in range(placemarks))
    return f"<?xml version='1.0'?><kml>{'<Folder>' * depth}{points}{'</Folder>' * depth}</kml>".encode()


def test_a_track_that_unpacks_to_more_than_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "track.kmz"
    path.write_bytes(zipped({"doc.kml": track(10)}))
    assert read_track(str(path)).fix_utc_s.size == 10

    monkeypatch.setenv("GLSTAR_MAX_CONTENT_MIB", "0.0007")
    assert len(track(10)) > 0.0007 * 2**20 > path.stat().st_size
    with pytest.raises(LogFormatError, match=r"unpacks to more .* \(GLSTAR_MAX_CONTENT_MIB raises the limit\)"):
        read_track(str(path))


def test_a_track_that_is_nested_deeply_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "track.kml"
    path.write_bytes(track(depth=50))
    assert read_track(str(path)).fix_utc_s.size == 3

    path.write_bytes(track(depth=200_000))
    with pytest.raises(LogFormatError, match=r"has 65 levels; glstar reads up to 64 levels \(GLSTAR_MAX_DEPTH raises"):
        read_track(str(path))
    monkeypatch.setenv("GLSTAR_MAX_DEPTH", "200")
    path.write_bytes(track(depth=150))
    assert read_track(str(path)).fix_utc_s.size == 3


# --- tables -----------------------------------------------------------------------------------------------------------
def as_parquet(path: Path, columns: dict[str, Any]) -> Path:
    parquet.write_table(pa.table(columns), path)
    return path


def test_only_the_needed_columns_of_a_parquet_file_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = {f"other{k}": np.arange(ROWS) for k in range(20)} | {"lists": [[1, 2]] * ROWS}
    path = as_parquet(tmp_path / "flight.parquet", OWN | others)
    read = []
    whole = parquet.ParquetFile.read
    monkeypatch.setattr(
        parquet.ParquetFile, "read", lambda self, columns: read.extend(columns) or whole(self, columns=columns)
    )

    assert open_flight(path).attitude.utc_s.size == ROWS
    assert {*read} == {*OWN}


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        ("ROWS", "49", r"has 50 rows; glstar reads up to 49 rows \(GLSTAR_MAX_ROWS raises the limit\)"),
        ("COLUMNS", "5", r"has 6 columns; glstar reads up to 5 columns \(GLSTAR_MAX_COLUMNS raises the limit\)"),
        ("CONTENT_MIB", "1e-4", r"its column \w+ unpacks to more than glstar takes; .*GLSTAR_MAX_CONTENT_MIB"),
    ],
)
def test_a_parquet_file_above_a_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, value: str, message: str
) -> None:
    path = as_parquet(tmp_path / "flight.parquet", OWN)
    monkeypatch.setenv(f"GLSTAR_MAX_{variable}", value)

    assert re.search(message, refusal(path))


def test_a_column_of_lists_is_refused(tmp_path: Path) -> None:
    path = as_parquet(tmp_path / "flight.parquet", OWN | {"yaw_deg": [[1.0, 2.0]] * ROWS})

    assert refusal(path) == f"{path}: its column yaw_deg holds list<element: double>, not numbers, times or text"


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_timestamps_of_every_unit_are_read(tmp_path: Path, unit: str) -> None:
    per_s = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    ticks = [int(START_S) * per_s + k * per_s for k in range(ROWS)]
    utc = pa.array(ticks, pa.int64()).cast(pa.timestamp(unit, "UTC"))
    columns = {"utc": utc, **{name: column for name, column in OWN.items() if name != "utc_s"}}

    flight = open_flight(as_parquet(tmp_path / "flight.parquet", columns))

    np.testing.assert_allclose(flight.attitude.utc_s, START_S + np.arange(ROWS), rtol=0, atol=1e-6)


def test_timestamps_far_from_now_are_refused(tmp_path: Path) -> None:
    utc = pa.array([2**60] * ROWS, pa.int64()).cast(pa.timestamp("ms"))
    columns = {"utc": utc, **{name: column for name, column in OWN.items() if name != "utc_s"}}

    assert "column utc: 1.15292e+15 s since 1970 is no UTC" in refusal(as_parquet(tmp_path / "a.parquet", columns))


def workbook(path: Path, rows: list[list[Any]], *, dimension: str = "") -> Path:
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append(row)
    book.save(path)
    if dimension:
        with zipfile.ZipFile(path) as old:
            files = {name: old.read(name) for name in old.namelist()}
        sheet = "xl/worksheets/sheet1.xml"
        files[sheet] = re.sub(rb'<dimension ref="[^"]*"', f'<dimension ref="{dimension}"'.encode(), files[sheet])
        assert dimension.encode() in files[sheet]
        path.write_bytes(zipped(files))
    return path


def own_rows() -> list[list[Any]]:
    return [[*OWN], *(list(map(float, row)) for row in zip(*OWN.values(), strict=True))]


@pytest.mark.parametrize("dimension", ["A1:F20", "A1:C51", "A1", "A1:XFD1048576"])
def test_all_rows_of_a_sheet_are_read_whatever_dimension_it_states(tmp_path: Path, dimension: str) -> None:
    path = workbook(tmp_path / "flight.xlsx", own_rows(), dimension=dimension)

    np.testing.assert_allclose(open_flight(path).attitude.utc_s, OWN["utc_s"], rtol=0, atol=1e-6)


def test_rows_of_a_sheet_may_be_shorter_or_longer_than_the_header(tmp_path: Path) -> None:
    header, *rows = own_rows()
    rows[3] = rows[3][:4]  # without a place
    rows[5] = [*rows[5], None, "a note"]

    table = read_table(str(workbook(tmp_path / "flight.xlsx", [header, *rows])))

    assert np.isnan(table.numbers("latitude_deg")).nonzero()[0].tolist() == [3]
    np.testing.assert_array_equal(table.numbers("yaw_deg"), OWN["yaw_deg"])


def test_a_row_of_zeros_is_a_row(tmp_path: Path) -> None:
    table = read_table(str(workbook(tmp_path / "a.xlsx", [["time", "roll"], [0, 0], [1, 2], [], [3, 0]])))

    assert table.numbers("time").tolist() == [0, 1, 3]
    assert table.lines.tolist() == [2, 3, 5]


def test_a_cell_far_below_or_to_the_right_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = workbook(tmp_path / "flight.xlsx", own_rows())
    with zipfile.ZipFile(path) as old:
        files = {name: old.read(name) for name in old.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    far = files[sheet].replace(b'<row r="51"', b'<row r="999999999"')
    path.write_bytes(zipped(files | {sheet: far}))
    assert refusal(path) == f"{path}: has a cell beyond the last row or column of Excel"

    path.write_bytes(zipped(files))
    monkeypatch.setenv("GLSTAR_MAX_CELLS", "60")
    assert "has 66 cells; glstar reads up to 60 cells (GLSTAR_MAX_CELLS raises" in refusal(path)


@pytest.mark.parametrize("kind", ["Excel", "CSV", "Parquet"])
def test_two_columns_of_one_name_are_refused_if_they_are_needed(tmp_path: Path, kind: str) -> None:
    def written(*names: str) -> str:
        columns = [OWN[name] if name in OWN else OWN["yaw_deg"] for name in names]
        if kind == "Excel":
            cells = [list(map(float, row)) for row in zip(*columns, strict=True)]
            return str(workbook(tmp_path / "a.xlsx", [[*names], *cells]))
        if kind == "Parquet":
            table = pa.Table.from_arrays([pa.array(column) for column in columns], list(names))
            parquet.write_table(table, tmp_path / "a.parquet")
            return str(tmp_path / "a.parquet")
        rows = [",".join(names), *(",".join(map(str, row)) for row in zip(*columns, strict=True))]
        (tmp_path / "a.csv").write_text("\n".join(rows), encoding="utf-8")
        return str(tmp_path / "a.csv")

    columns = "time=utc_s,time_epoch=unix,roll=roll_deg,pitch=pitch_deg,yaw=yaw_deg,latitude=latitude_deg"
    columns += ",longitude=longitude_deg,angle_unit=deg"
    path = written(*OWN, "note", "note")
    assert open_flight(path, columns=columns).attitude.utc_s.size == ROWS

    path = written(*OWN, "yaw_deg")
    with pytest.raises(LogFormatError) as caught:
        open_flight(path, columns=columns)
    assert str(caught.value) == f"{path}: has several columns named yaw_deg; rename or remove all but one"


def test_a_table_of_text_above_a_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "flight.csv"
    path.write_bytes(csv())
    monkeypatch.setenv("GLSTAR_MAX_ROWS", "49")
    with pytest.raises(LogFormatError, match=r"has 51 rows; glstar reads up to 49 rows"):
        open_flight(path, columns="time=utc_s,time_epoch=unix,roll=roll_deg,pitch=pitch_deg,yaw=yaw_deg,angle_unit=deg")


# --- temporary directories --------------------------------------------------------------------------------------------
_UNPACK_AND_WAIT = """
import sys, time
from glstar.telemetry import open_source
source = open_source(sys.argv[1])
print("open", flush=True)
time.sleep(60)
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_what_a_killed_run_unpacked_is_removed_by_the_next_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tmp").mkdir()
    path = tmp_path / "flight.csv.gz"
    path.write_bytes(gzip.compress(csv()))
    environment = os.environ | {"TMPDIR": str(tmp_path / "tmp")}
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))

    def folders() -> int:
        return len(list((tmp_path / "tmp").glob("glstar-unpacked-*")))

    with subprocess.Popen(
        [sys.executable, "-c", _UNPACK_AND_WAIT, str(path)], env=environment, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        open_flight(path)
        assert folders() == 1  # in use by a process that lives
        process.send_signal(signal.SIGKILL)
    assert folders() == 1

    open_flight(path)

    assert folders() == 0


def test_every_limit_has_its_row_in_the_manual() -> None:
    page = (Path(__file__).parents[2] / "assets/manual/conventions.md").read_text(encoding="utf-8")

    for limit in LIMITS:
        assert f"| `{limit.variable}` | {limit.default:,g} {limit.unit} | {limit.covers} |" in page
