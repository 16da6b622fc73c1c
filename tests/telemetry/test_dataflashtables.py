"""The CSV of a DataFlash log, table by table: positions, boots, what lies beside a file, and timestamps as UTC."""

from pathlib import Path

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.telemetry import source
from glstar.telemetry.dataflash import dump
from glstar.telemetry.dataflash.dump import DataFlashDumpReader, is_dataflash_dump

UTC_S = 1710068400.0
STEP = 1 << 50
nan = np.nan


def table(path: Path, fields: str, *rows: str) -> Path:
    path.write_text("\n".join([f"timestamp,TimeUS,{fields}", *rows]) + "\n")
    return path


def att(clock_s: float, yaw_deg: float = 40.0, utc_s: float | None = None) -> str:
    return f"{UTC_S + clock_s - 30 if utc_s is None else utc_s},{round(clock_s * 1e6)},-3,2,{yaw_deg},3"


ATT = "Roll,Pitch,Yaw,AEKF"


def times(*clock_s: float) -> list[str]:
    return [att(one) for one in clock_s]


@pytest.mark.parametrize(
    ("header", "is_dump"),
    [
        ("timestamp,TimeUS,Roll", True),
        ("timestamp;TimeMS;Roll", True),
        ("timestamp,TimeUS\n", True),
        ("timestamp,TimeUS;x", False),
        ("timestamp,TimeS", False),
        ("timestamp,ATTITUDE.roll", False),
    ],
)
def test_a_dump_is_known_by_its_header(header: str, is_dump: bool) -> None:
    assert is_dataflash_dump(header) is is_dump


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"C", "Q1", "Q2", "Q3", "Q4", "x"}, "XKQ"),
        ({"Roll", "Pitch", "Yaw", "Lat", "Lng"}, "AHR2"),
        ({"Roll", "Pitch", "Yaw", "Lat"}, "ATT"),
        ({"GWk", "GMS"}, "GPS"),
        ({"Week", "T"}, "GPS"),
        ({"Lat", "Lng", "Alt"}, "POS"),
        ({"GyrX", "GyrY", "GyrZ"}, "IMU"),
        ({"x"}, "message"),
    ],
)
def test_a_message_is_known_by_its_fields(fields: set[str], name: str) -> None:
    assert dump._by_fields(tuple(fields)) == name


def test_the_name_of_a_file_says_the_names_of_the_others(tmp_path: Path) -> None:
    for own, pos, message in (
        ("flight_ATT.csv", "flight_POS.csv", "ATT"),
        ("att-flight.CSV", "pos-flight.CSV", "ATT"),
        ("a_GPS_xkq.csv", "a_GPS_pos.csv", "XKQ"),
        ("ATTITUDE.csv", "LOG_POS.csv", "ATT"),
    ):
        tables = dump._Tables(str(table(tmp_path / own, ATT, *times(30, 31))))
        assert (tables.called("POS"), tables.own) == (pos, message)
        named = "; name this table LOG_ATT.csv, so that they are found" if own == "ATTITUDE.csv" else ""
        assert tables.how_to_name == named


def test_the_rows_of_a_message(tmp_path: Path) -> None:
    rows = [*times(30, 31), f"{UTC_S},x,1,2,3,4", *times(31.5)]
    tables = dump._Tables(str(table(tmp_path / "a_ATT.csv", ATT, *rows)))
    table(tmp_path / "a_POS.csv", "Lat,Lng,Alt")
    (tmp_path / "a_MSG.csv").write_text("timestamp,TimeUS,Message\n1,2,one, two\n1,3,three\n")
    (tmp_path / "a_GPS.csv").write_text("\nSpecified type 'GPS' not found\n")
    (tmp_path / "a_IMU.csv").write_text("x,y\n1,2\n")
    (tmp_path / "a_OTHER.csv").write_text("timestamp,TimeUS,x\n1,2,3\n")
    assert tables.names == ["ATT", "MSG"]
    assert [tables.count(name) for name in ("ATT", "MSG", "POS", "GPS", "OTHER")] == [4, 2, 0, 0, 0]
    assert ("ATT" in tables, "POS" in tables, "GPS" in tables) == (True, False, False)
    assert tables.fields("ATT") == ("timestamp", "TimeUS", "Roll", "Pitch", "Yaw", "AEKF")
    assert tables.fields("POS") == tables.fields("GPS") == ()
    np.testing.assert_array_equal(tables.columns("ATT", "TimeUS", "Yaw"), [[30e6, 31e6, nan, 31.5e6], [40, 40, 3, 40]])
    assert tables.columns("ATT", "Q1") is tables.columns("POS", "Lat") is tables.columns("GPS", "Lat") is None
    assert tables.texts("MSG", "Message") == ["one, two", "three"]
    assert tables.texts("MSG", "TimeUS") == tables.texts("ATT", "Message") == tables.texts("VER", "FWS") == []
    assert tables.position("ATT").tolist() == [30_000_000, 31_000_000, -1, 31_500_000]
    assert tables.position("GPS").tolist() == []
    assert (tables.heads, tables.end, tables.unread_bytes, tables.loss(), tables.alike(1, 2)) == ((), 5, 0, "", True)
    assert tables.left_out == [
        "a_IMU.csv beside it is left out: is no table of mavlogdump: it does not begin with timestamp,TimeUS"
    ]
    part = tables.only([(30_500_000, 31_200_000)])
    assert part.columns("ATT", "TimeUS")[0].tolist() == [31e6]
    assert tables.count("ATT") == 4
    unstamped = dump._Tables(str(tmp_path / "a_OTHER.csv"))
    assert unstamped.position("message").tolist() == [2]


def test_joined_tables_have_positions_of_their_own(tmp_path: Path) -> None:
    head = f"timestamp,TimeUS,{ATT}"
    path = table(tmp_path / "a_ATT.csv", ATT, *times(30, 31, 32), head, *times(40, 41, 42))
    tables = dump._Tables(str(path))
    assert tables.heads == (STEP,)
    expected = [30_000_000, 31_000_000, 32_000_000, STEP + 40_000_000, STEP + 41_000_000, STEP + 42_000_000]
    assert tables.position("ATT").tolist() == expected
    assert tables.only([(STEP, 2 * STEP)]).columns("ATT", "TimeUS")[0].tolist() == [40e6, 41e6, 42e6]
    # A step back of more than a second is another table without its header, but no head of a file.
    for back_s, number in ((0.96, 0), (1.04, 1)):
        path = table(
            tmp_path / "b_ATT.csv",
            ATT,
            *times(30, 30.2, 30.4, 30.6, 30.8, 31, 31 - back_s, 31.2 - back_s, 31.4 - back_s),
        )
        tables = dump._Tables(str(path))
        assert tables._nth("ATT").tolist() == [0] * 6 + [number] * 3
        assert tables.heads == ()
    spike = dump._Tables(str(table(tmp_path / "c_ATT.csv", ATT, *times(30, 31, 5, 32, 33))))
    assert spike._nth("ATT").tolist() == [0] * 5
    path = table(tmp_path / "d_ATT.csv", ATT, *times(30, 31, 32), head, *times(2, 3, 4))
    assert dump._Tables(str(path))._nth("ATT").tolist() == [0, 0, 0, 1, 1, 1]
    table(tmp_path / "d_POS.csv", "Lat,Lng,Alt", "1,30000000,-34.5,138.5,50", "1,31000000,-34.5,138.5,50")
    message = "its tables are of different numbers of boots (d_ATT.csv 2, d_POS.csv 1); give the .BIN itself"
    with pytest.raises(LogFormatError) as caught:
        _ = dump._Tables(str(path)).heads
    assert str(caught.value) == f"{path}: {message}"
    assert caught.value.offset == 8
    table(tmp_path / "d_POS.csv", "Lat,Lng,Alt", "1,30000000,-34.5,138.5,50")
    assert dump._Tables(str(path)).heads == (STEP,)


def batches(path: Path, **options: object) -> dict[type, list[source.Samples]]:
    found: dict[type, list[source.Samples]] = {}
    for batch in DataFlashDumpReader(path, **options).samples():
        found.setdefault(type(batch), []).append(batch)
    return found


def test_timestamps_are_utc_with_the_leap_seconds_of_their_date(tmp_path: Path) -> None:
    """pymavlink assumes 18 leap seconds in every year; in 2013 there were 16."""
    path = table(tmp_path / "a_ATT.csv", ATT, *times(30, 31, 32), "x,33000000,1,2,3,3")
    found = batches(path)
    [clock] = found[source.ClockSamples]
    better = "may be wrong by seconds; a_GPS.csv beside it would be accurate"
    assert clock.source == f"timestamps of mavlogdump, by the first GPS fix ({better}), 18 leap seconds"
    np.testing.assert_allclose(clock.clock_s, np.array([30, 31, 32]) - 0.02, rtol=0, atol=1e-9)
    np.testing.assert_allclose(clock.utc_s, UTC_S + np.arange(3), rtol=0, atol=1e-6)
    assert found[source.AttitudeSamples][0].notes == ()
    [place] = found[source.PositionSamples]
    assert place.source == "neither a_POS.csv nor a_GPS.csv lies beside it"
    old_s = 1370000000.0
    path = table(tmp_path / "b_ATT.csv", ATT, *(att(30 + k, utc_s=old_s + k) for k in range(3)))
    np.testing.assert_allclose(batches(path)[source.ClockSamples][0].utc_s, old_s + 2 + np.arange(3), rtol=0, atol=1e-6)
    path = table(tmp_path / "c_ATT.csv", ATT, *(att(30 + k, utc_s=30 + k) for k in range(3)))
    assert batches(path)[source.ClockSamples][0].source == "no c_GPS.csv beside it, and its timestamps are no UTC"
    plain = table(tmp_path / "plain.csv", ATT, *times(30, 31, 32))
    [place] = batches(plain)[source.PositionSamples]
    named = "; name this table LOG_ATT.csv, so that they are found"
    assert place.source == f"neither LOG_POS.csv nor LOG_GPS.csv lies beside it{named}"
    two = table(tmp_path / "d_ATT.csv", ATT, *times(*np.arange(30, 40, 0.2), *np.arange(2, 10, 0.2)))
    assert {one.source for one in batches(two)[source.ClockSamples]} == {
        "no d_GPS.csv beside it, and timestamps hold for one boot only"
    }


def test_the_named_attitude_is_taken_and_a_better_one_is_named(tmp_path: Path) -> None:
    path = table(tmp_path / "a_ATT.csv", ATT, *times(30, 31, 32))
    quaternion = "timestamp,TimeUS,C,Q1,Q2,Q3,Q4"
    rows = "".join(f"{UTC_S},{30 + k}000000,0,0.6,0,0,0.8\n" for k in range(3))
    (tmp_path / "a_XKQ.csv").write_text(f"{quaternion}\n{rows}")
    own = batches(path)[source.AttitudeSamples][0]
    better = "ATT is taken, because its table was named; a_XKQ.csv beside it has XKQ (--attitude XKQ)"
    assert (own.source, better in own.notes) == ("ATT", True)
    other = batches(path, attitude="XKQ")[source.AttitudeSamples][0]
    assert (other.source, better in other.notes) == ("XKQ lane 0", False)
    best = batches(tmp_path / "a_XKQ.csv")[source.AttitudeSamples][0]
    assert (best.source, any("because its table was named" in note for note in best.notes)) == ("XKQ lane 0", False)
    place = table(tmp_path / "a_POS.csv", "Lat,Lng,Alt", *(f"1,{30 + k}000000,-34.5,138.5,50" for k in range(3)))
    from_place = batches(place)
    assert from_place[source.AttitudeSamples][0].source == "XKQ lane 0"
    assert from_place[source.PositionSamples][0].clock_s.size == 3
