"""Files that are no flight logs, and tables with small errors: messages identify them and give advice."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.sky.place.site import Site
from glstar.telemetry import open_flight

HOME = Site(latitude_rad=-0.6, longitude_rad=2.4)


def zipped(name: str) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(name, "x" * 100)
    return data.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "what"),
    [
        ("flight.xlsx", zipped("[Content_Types].xml"), "cannot be read as an Excel workbook: "),
        ("flight.kmz", zipped("doc.kml"), "this is a track of Google Earth (KMZ); it has positions but no attitude"),
        ("flight.zip", zipped("flight.BIN"), "flight.BIN: line 1: no table of a flight: its header would name utc"),
        (
            "flight.gpx",
            b'<?xml version="1.0"?>\n<gpx version="1.1">',
            "this is a GPX track; it has positions but no attitude",
        ),
        (
            "flight.kml",
            b'<?xml version="1.0"?>\n<kml xmlns="x">',
            "this is a KML track; it has positions but no attitude",
        ),
        ("page.BIN", b"<!DOCTYPE html><html>", "this is a web page or XML; was it saved from a browser?"),
        (
            "LOG00001.BBL",
            b"H Product:Blackbox flight data recorder by Nicholas",
            "this is a Betaflight or INAV blackbox",
        ),
        ("truth.parquet", b"PAR1\x15\x04\x15", "cannot be read as Parquet: "),
        ("DJIFlightRecord_2024.txt", b"\x10\x00\x00\x01\x02" * 9, "this is no log that glstar knows; DJI encrypts its"),
    ],
)
def test_a_file_of_another_kind_is_identified(tmp_path: Path, name: str, data: bytes, what: str) -> None:
    path = tmp_path / name
    path.write_bytes(data)

    with pytest.raises(LogFormatError) as caught:
        open_flight(path)

    assert str(caught.value).startswith(f"{path}: {what}")


def rows(separator: str = ",", decimal: str = ".", *, mark: str = "") -> str:
    header = separator.join(["timestamp", "TimeUS", "Roll", "Pitch", "Yaw"])
    lines = [separator.join([f"{k}.5", f"{k}000000", "0.5", "1.5", "2.5"]).replace(".", decimal) for k in range(9)]
    return "\n".join([mark + header, *lines]) + "\n"


def test_decimal_commas_of_a_dump_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "flight_ATT.csv"
    path.write_text(rows(";", ","))

    with pytest.raises(LogFormatError) as caught:
        open_flight(path, utc_start=1.7e9, site=HOME)

    assert str(caught.value) == (
        f"{path}: line 2, column timestamp: '0,5' has a decimal comma; write decimals with a point"
    )


@pytest.mark.parametrize("mark", ["#", "# "])
def test_a_header_after_a_hash_is_a_header(tmp_path: Path, mark: str) -> None:
    path = tmp_path / "flight_ATT.csv"
    path.write_text(rows(mark=mark))

    assert open_flight(path, utc_start=1.7e9, site=HOME).attitude.utc_s.size == 9

    own = tmp_path / "own.csv"
    values = np.column_stack([1.7e9 + np.arange(5), np.zeros((5, 3))])
    np.savetxt(own, values, delimiter=",", header="flown at night\nutc_s,roll_deg,pitch_deg,yaw_deg", comments=mark)
    assert open_flight(own, site=HOME).attitude.utc_s.tolist() == values[:, 0].tolist()


def test_comments_before_a_header_remain_comments(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text("# a,b,c,d\nutc_s,roll_deg,pitch_deg,yaw_deg\n1.7e9,0,0,0\n# x,y,z,w\n1.70001e9,0,0,0\n")

    assert open_flight(path, site=HOME).attitude.utc_s.tolist() == [1.7e9, 1.70001e9]


def test_advice_on_the_name_of_a_table_is_given_once(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(rows())

    with pytest.raises(LogFormatError) as caught:
        open_flight(path, utc_start=1.7e9)

    assert "neither LOG_POS.csv nor LOG_GPS.csv lies beside it; name this table LOG_ATT.csv, so that they are" in str(
        caught.value
    )
    assert str(caught.value).count("LOG_ATT.csv") == 1
