"""The records of DataFlash logs, byte by byte: layouts, damage, joined files, and the bookkeeping of positions."""

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.telemetry.dataflash import records, text
from glstar.telemetry.dataflash.records import BinaryRecords, nearest, numbered, stamped
from glstar.telemetry.dataflash.text import TextRecords, is_dataflash_text

HEAD = b"\xa3\x95"


def definition(kind: int, name: str, letters: str, fields: str, length: int) -> bytes:
    """Return a FMT record, 89 bytes; `length`: of the records of the message, with their head of 3 bytes."""
    return HEAD + struct.pack("<BBB4s16s64s", 128, kind, length, name.encode(), letters.encode(), fields.encode())


def record(kind: int, layout: str, *values: float | bytes) -> bytes:
    return HEAD + bytes([kind]) + struct.pack("<" + layout, *values)


LOG_HEAD = definition(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89)
PAIR = definition(7, "AB", "Bc", "N,V", 6)


def pair(number: int, value: int) -> bytes:
    return record(7, "Bh", number, value)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.BIN"


def read(path: Path, *parts: bytes) -> BinaryRecords:
    path.write_bytes(b"".join(parts))
    return BinaryRecords(str(path))


# --- what all logs share --------------------------------------------------------------------------------------------
def log_with(**columns: list[float]) -> SimpleNamespace:
    """Return a log that has one message of three records."""

    def of(_: str, *fields: str) -> list[np.ndarray] | None:
        return [np.array(columns[field]) for field in fields] if set(fields) <= columns.keys() else None

    return SimpleNamespace(columns=of, count=lambda _: 3)


@pytest.mark.parametrize(
    ("name", "columns", "clock_s"),
    [
        ("ATT", {"TimeUS": [2e6, 5e6], "TimeMS": [9.0, 9.0]}, [2.0, 5.0]),
        ("ATT", {"TimeMS": [3000.0, 4500.0], "T": [9.0, 9.0]}, [3.0, 4.5]),
        ("GPS2", {"TimeMS": [9.0, 9.0], "T": [7000.0, 8250.0]}, [7.0, 8.25]),
        ("GPS", {"TimeMS": [9.0, 9.0]}, None),
        ("ATT", {"T": [9.0, 9.0]}, None),
    ],
)
def test_records_have_a_time_since_boot_by_microseconds_or_milliseconds(
    name: str, columns: dict[str, list[float]], clock_s: list[float] | None
) -> None:
    read_back = stamped(log_with(**columns, Roll=[1.5, 2.5], Yaw=[3.5, 4.5]), name, "Roll", "Yaw")

    if clock_s is None:
        assert read_back is None
    else:
        np.testing.assert_allclose(read_back[0], clock_s, rtol=1e-15)
        np.testing.assert_array_equal(read_back[1], [[1.5, 2.5], [3.5, 4.5]])
    assert stamped(log_with(**columns), name, "Roll") is None


def test_a_number_without_a_lane_is_none() -> None:
    log = log_with(C=[255.0, 256.0, np.nan, -255.0, -256.0, 3.0, np.inf])

    assert numbered(log, "XKQ", "C").tolist() == [255, -1, -1, -255, -1, 3, -1]
    assert numbered(log, "XKQ", "I").tolist() == [0, 0, 0]
    assert numbered(log, "XKQ", "C").dtype == numbered(log, "XKQ", "I").dtype == np.int64


def test_the_nearest_time_is_found_in_any_order_and_the_earlier_of_two() -> None:
    times_s = np.array([7.0, 2.0, 4.0, 12.0])

    assert nearest(times_s, np.array([-3.0, 2.9, 3.0, 3.1, 4.0, 5.5, 9.5, 9.6, 40.0])).tolist() == [
        *(1, 1, 1, 2, 2),  # 3.0 is as near to 2 as to 4
        *(2, 0, 3, 3),
    ]
    rng = np.random.default_rng(3)
    times_s, requested_s = rng.uniform(0, 30, 40), rng.uniform(-3, 33, 200)
    brute = np.abs(times_s - requested_s[:, np.newaxis]).argmin(axis=1)
    np.testing.assert_array_equal(nearest(times_s, requested_s), brute)
    assert nearest(np.array([5.0]), np.array([3.0, 9.0])).tolist() == [0, 0]


# --- binary logs ----------------------------------------------------------------------------------------------------
def test_numbers_of_every_letter_are_scaled(path: Path) -> None:
    letters, layout = "bBhHiIfdqQgcCeEL", "bBhHiIfdqQehHiIi"
    values = (-3, 250, -301, 60_001, -70_001, 4_000_000_001, 1.5, -2.25, -(1 << 40), 1 << 41, 0.375, -251, 60_002)
    values = (*values, -70_003, 4_000_000_003, -349_300_001)
    fields = ",".join(f"F{letter}" for letter in letters)
    size = 3 + struct.calcsize("<" + layout)
    log = read(path, definition(9, "NUM", letters, fields, size), *[record(9, layout, *values)] * 2)

    columns = log.columns("NUM", *fields.split(","))
    expected = [*values[:11], -2.51, 600.02, -700.03, 40_000_000.03, -34.9300001]
    np.testing.assert_array_equal(columns, np.transpose([expected] * 2))
    assert all(column.dtype == np.float64 for column in columns)
    assert log.fields("NUM") == tuple(fields.split(","))
    assert log.texts("NUM", "Fb") == []


def test_texts_of_every_letter_end_at_the_first_zero(path: Path) -> None:
    layout = "4s16s64s64sb"
    log = read(
        path,
        definition(9, "TXT", "nNZaM", "A,B,C,D,E", 3 + struct.calcsize("<" + layout)),
        record(9, layout, b"abcd", b"sixteen letters!", b"one\0two", b"\xffx", -7),
        record(9, layout, b"x", b"", b"y" * 64, b"z\0", 4),
    )

    assert [log.texts("TXT", field) for field in "ABCD"] == [
        ["abcd", "x"],
        ["sixteen letters!", ""],
        ["one", "y" * 64],
        ["\N{REPLACEMENT CHARACTER}x", "z"],
    ]
    assert log.columns("TXT", "E")[0].tolist() == [-7.0, 4.0]
    assert log.columns("TXT", "E", "A") is None
    assert log.texts("TXT", "E") == log.texts("TXT", "F") == log.texts("ATT", "A") == []


def test_every_record_of_a_damaged_log_is_counted(path: Path) -> None:
    """AB at 347 is followed by no record, and the last two bytes begin another one."""
    text_layout = definition(9, "TX", "ZB", "Msg,No", 68)
    first = LOG_HEAD + PAIR + pair(4, -250) + pair(200, 31) + text_layout + record(9, "64sB", b"hello", 8)
    log = read(path, first, pair(5, 6), b"\1\2\3\4", pair(9, 7), HEAD)

    assert log.names == ["AB", "FMT", "TX"]
    assert [log.count(name) for name in ("AB", "FMT", "TX", "XX")] == [3, 3, 1, 0]
    assert log.position("AB").tolist() == [178, 184, 357]
    assert log.position("FMT").tolist() == [0, 89, 190]
    assert log.position("XX").tolist() == []
    assert (log.position("XX").dtype, log.position("AB").dtype) == (np.int64, np.int64)
    np.testing.assert_array_equal(log.columns("AB", "V", "N"), [[-2.5, 0.31, 0.07], [4.0, 200.0, 9.0]])
    assert log.texts("TX", "Msg") == ["hello"]
    assert log.columns("TX", "No")[0].tolist() == [8.0]
    assert ("AB" in log, "XX" in log) == (True, False)
    assert (log.fields("AB"), log.fields("XX")) == (("N", "V"), ())
    assert log.columns("AB", "N", "Msg") is None
    assert log.columns("XX") is None
    assert (log.end, log.unread_bytes) == (363, 365 - (3 * 89 + 3 * 6 + 68))
    assert log.loss() == " in 363 whole bytes of 365"
    assert log.heads == (0,)
    log.close()
    log.close()


@pytest.mark.parametrize("cut", range(6))
def test_a_log_cut_anywhere_in_its_last_record_has_all_others(path: Path, cut: int) -> None:
    whole = PAIR + pair(1, 100) + pair(2, 300)
    log = read(path, whole, pair(3, 500)[:cut])

    assert log.columns("AB", "V")[0].tolist() == [1.0, 3.0]
    assert log.end == len(whole)
    assert log.loss() == (f" in {len(whole)} whole bytes of {len(whole) + cut}" if cut else "")
    assert log.unread_bytes == 89 + cut  # FMT itself is not defined


@pytest.mark.parametrize("size", range(5, 89, 12))
def test_a_log_cut_within_a_definition_has_the_records_before(path: Path, size: int) -> None:
    log = read(path, PAIR, pair(1, 100), definition(8, "CD", "B", "W", 4)[:size])

    assert log.columns("AB", "V")[0].tolist() == [1.0]


def test_a_last_record_that_three_other_bytes_follow_is_damaged(path: Path) -> None:
    log = read(path, PAIR, pair(1, 100), pair(2, 300), b"\1\2\3")

    assert log.columns("AB", "V")[0].tolist() == [1.0]


def test_the_head_of_a_record_within_another_one_is_none(path: Path) -> None:
    """The second C holds what could be two records; the second of these would end after the next two."""
    layouts = PAIR + definition(8, "C", "BIII", "A,B,C,D", 16) + definition(9, "L", "BIIIIB", "A,B,C,D,E,F", 21)
    within = HEAD + b"\7" + b"\1\2\3" + HEAD + b"\x09" + b"\5\6\7\xa3"
    log = read(
        path, layouts, record(8, "BIII", 1, 2, 3, 4), HEAD + b"\x08" + within, pair(2, 3), pair(4, 5), pair(6, 7)
    )

    begin = 3 * 89
    assert log.position("C").tolist() == [begin, begin + 16]
    assert log.position("AB").tolist() == [begin + 32, begin + 38, begin + 44]
    assert log.count("L") == 0


@pytest.mark.parametrize("piece_bytes", [1, 2, 3, 5, 1000])
def test_a_log_may_be_searched_in_pieces(monkeypatch: pytest.MonkeyPatch, piece_bytes: int) -> None:
    monkeypatch.setattr(records, "_PIECE_BYTES", piece_bytes)
    raw = np.frombuffer(b"\xa3\x95\1\xa3\xa3\x95\2..\x95\xa3\x95\3\xa3\x95", dtype=np.uint8)

    assert records._heads(raw).tolist() == [0, 4, 10]
    assert records._heads(raw[:3]).tolist() == [0]
    assert records._heads(raw[:2]).tolist() == []


@pytest.mark.parametrize(
    "bad",
    [
        definition(7, "AB", "Bc", "N,V", 7),
        definition(7, "AB", "Bc", "N,V", 5),
        definition(7, "AB", "Bc", "N", 6),
        definition(7, "AB", "B", "N,V", 4),
        definition(7, "AB", "Bc", "N,N", 6),
        definition(7, "AB", "BcX", "N,V", 6),
        definition(7, "AB", "BcX", "N,V,W", 6),
        definition(7, "AB", "Bc", "N,", 6),
        definition(7, "A-", "Bc", "N,V", 6),
        definition(7, "", "Bc", "N,V", 6),
        definition(7, "A\xe4", "Bc", "N,V", 6),
        definition(7, "AB", "B\xe4", "N,V", 6),
        definition(7, "AB", "Bc", "N,\xe4", 6),
    ],
)
def test_a_damaged_definition_defines_nothing(path: Path, bad: bytes) -> None:
    with pytest.raises(LogFormatError) as caught:
        read(path, bad, pair(1, 2), pair(3, 4))

    message = f"{path}: no whole record in 101 bytes: the log is cut off or damaged; copy it again"
    assert str(caught.value) == message
    assert caught.value.offset == 0
    log = read(path, bad, PAIR, pair(1, 2), pair(3, 4), bad)
    assert log.columns("AB", "N")[0].tolist() == [1.0, 3.0]


def test_a_definition_may_have_no_fields(path: Path) -> None:
    log = read(path, definition(9, "NO", "", "", 3), record(9, ""), PAIR, pair(8, 900))

    assert (log.count("NO"), log.fields("NO"), log.names) == (1, (), ["AB", "NO"])


def test_a_definition_applies_until_another_one_contradicts_it(path: Path) -> None:
    """The records of AB change their fields; those of the number 7 before are not read by the new layout."""
    other = definition(7, "AB", "hB", "V,N", 6)
    same = definition(9, "Z", "B", "N", 4)
    first = pair(5, 600) + PAIR + same + pair(1, 200) + record(9, "B", 77)
    log = read(path, first, other, record(7, "hB", 300, 4), same, record(9, "B", 78), record(7, "hB", 500, 6))
    changed = len(first)

    assert log.fields("AB") == ("N", "V")
    np.testing.assert_array_equal(log.columns("AB", "N", "V"), [[5.0, 1.0], [6.0, 2.0]])
    assert log.columns("Z", "N")[0].tolist() == [77.0, 78.0]
    assert log.heads == ()
    assert [log.alike(0, at) for at in (changed - 1, changed)] == [True, False]
    assert log.alike(changed, changed + 50)
    assert log.alike(-5, 3)
    later = log.only([(changed, changed + 500)])
    assert later.fields("AB") == ("V", "N")
    np.testing.assert_array_equal(later.columns("AB", "V", "N"), [[300.0, 500.0], [4.0, 6.0]])
    np.testing.assert_array_equal(log.columns("AB", "N", "V"), [[5.0, 1.0], [6.0, 2.0]])


def test_the_last_definition_of_a_name_is_used(path: Path) -> None:
    log = read(path, PAIR, definition(8, "AB", "B", "W", 4), pair(1, 2), record(8, "B", 9), pair(3, 4))

    assert log.columns("AB", "W")[0].tolist() == [9.0]
    assert log.columns("AB", "N") is None


def test_joined_logs_have_layouts_of_their_own(path: Path) -> None:
    """The second file gives the number 7 to another message, and defines it after its first record."""
    first = LOG_HEAD + PAIR + pair(1, 200) + pair(3, 400)
    second = LOG_HEAD + record(7, "I", 70_000) + definition(7, "CD", "I", "W", 7) + definition(8, "E", "B", "X", 4)
    log = read(path, first, second, record(7, "I", 80_000), record(8, "B", 12))

    assert log.heads == (0, len(first))
    assert log.names == ["AB", "CD", "E", "FMT"]
    assert log.columns("AB", "N")[0].tolist() == [1.0, 3.0]
    assert log.columns("CD", "W")[0].tolist() == [70_000.0, 80_000.0]
    assert log.count("FMT") == 5
    assert (log.end, log.unread_bytes, log.loss()) == (len(first + second) + 11, 0, "")
    assert log.alike(0, len(first))  # they share no other message than FMT
    part = log.only([(0, 180), (len(first), len(first) + 200)])
    assert part.names == ["AB", "CD", "FMT"]
    assert part.columns("AB", "N")[0].tolist() == [1.0]
    assert part.columns("CD", "W")[0].tolist() == [70_000.0]


# --- texts ----------------------------------------------------------------------------------------------------------
LINES = (
    "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    "FMT, 7, 30, ATT, Qcf, TimeUS,Roll,Yaw\n"
    "FMT, 8, 75, MSG, QZ, TimeUS,Message\n"
    "ATT, 2000000, -1.25, 3.500000\n"
    "MSG, 2500000, one, two \n"
    "ATT, 3000000, 4.75\n"
    "ATT, 4000000, 1e19, x\n"
    "LONGER, 1, 2, 3\n"
    "MSG, 4500000\n"
    "ATT, 5000000, 9e18, inf\r\n"
)


def read_text(path: Path, content: str | bytes) -> TextRecords:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return TextRecords(str(path))


@pytest.mark.parametrize("piece_bytes", [1 << 22, 60, 100])
def test_every_line_of_a_damaged_text_is_counted(path: Path, monkeypatch: pytest.MonkeyPatch, piece_bytes: int) -> None:
    monkeypatch.setattr(text, "_PIECE_BYTES", piece_bytes)
    log = read_text(path, LINES + "ATT, 6000000, 7.00, 8.0")

    assert log.names == ["ATT", "FMT", "MSG"]
    assert [log.count(name) for name in ("ATT", "MSG", "FMT", "XX")] == [3, 1, 3, 0]
    np.testing.assert_array_equal(
        log.columns("ATT", "TimeUS", "Roll", "Yaw"),
        [[2e6, 4e6, 5e6], [-1.25, np.nan, 9e18], [3.5, np.nan, np.nan]],
    )
    assert log.columns("ATT", "Yaw")[0][0] == 3.5
    assert log.texts("MSG", "Message") == ["one, two"]
    assert log.columns("MSG", "Message") is None
    assert log.columns("XX") is None
    assert log.columns("ATT", "Roll", "Pitch") is None
    assert log.texts("ATT", "Roll") == log.texts("XX", "Roll") == []
    assert (log.fields("ATT"), log.fields("XX")) == (("TimeUS", "Roll", "Yaw"), ())
    assert log.position("ATT").tolist() == [LINES.index(line) for line in ("ATT, 2", "ATT, 4", "ATT, 5")]
    assert log.position("XX").tolist() == []
    assert log.heads == ()
    bad = len("ATT, 3000000, 4.75\nLONGER, 1, 2, 3\nMSG, 4500000\nATT, 6000000, 7.00, 8.0")
    assert (log.end, log.unread_bytes, log.loss()) == (10, bad, "")


def test_the_end_of_a_text_is_its_last_complete_line(path: Path) -> None:
    log = read_text(path, LINES + "ATT, 1\n\nend\n")

    assert (log.end, log.loss()) == (10, " in 10 lines of 13")
    log.close()


@pytest.mark.parametrize("mark", ["", "\N{BYTE ORDER MARK}"])
def test_joined_texts_have_layouts_of_their_own(path: Path, mark: str) -> None:
    head = "FMT,128,\t89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    first = f"{mark}{head}FMT, 7, 30, ATT, Qf, TimeUS,Yaw\nATT, 1000, 2.5\n".encode()
    second = f"{head}FMT, 7, 30, ATT, fQ, Yaw,TimeUS\nATT, 3.5, 2000\nFMT, 9, 9, POS, Q, TimeUS\nPOS, 5\n".encode()
    log = read_text(path, first + second)

    assert log.heads == (len(first),)
    assert log.columns("ATT", "TimeUS", "Yaw") is not None
    np.testing.assert_array_equal(log.columns("ATT", "TimeUS", "Yaw"), [[1000.0], [2.5]])
    part = log.only([(len(first), len(first) + 1000)])
    np.testing.assert_array_equal(part.columns("ATT", "TimeUS", "Yaw"), [[2000.0], [3.5]])
    assert part.names == ["ATT", "FMT", "POS"]
    assert log.only([(0, len(first))]).names == ["ATT", "FMT"]
    assert log.only([(0, len(first) - 3)]).names == ["ATT", "FMT"]  # a record is where it begins
    assert not log.alike(0, len(first))
    assert (log.end, log.loss()) == (8, "")
    assert log.unread_bytes == (3 if mark else 0)


def test_a_layout_that_changes_within_a_text_begins_another_part(path: Path) -> None:
    first = "FMT, 7, 30, ATT, Qf, TimeUS,Yaw\nFMT, 9, 9, POS, Q, TimeUS\nATT, 1000, 2.5\nPOS, 5\n"
    second = "FMT, 7, 30, ATT, Qff, TimeUS,Yaw,Roll\nATT, 2000, 3.5, 4.5\nPOS, 6\nATT, 3000, 5.5\n"
    log = read_text(path, first + second)

    np.testing.assert_array_equal(log.columns("ATT", "TimeUS", "Yaw"), [[1000.0], [2.5]])
    assert log.columns("POS", "TimeUS")[0].tolist() == [5.0, 6.0]
    assert (log.heads, log.end, log.loss()) == ((), 7, " in 7 lines of 8")
    third = "FMT, 7, 30, ATT, fQ, Pitch,TimeUS\nATT, 6.5, 7000\n"
    assert log.only([(len(first), 1000)]).columns("ATT", "Roll")[0].tolist() == [4.5]
    log = read_text(path, first + second + third)
    assert log.columns("ATT", "TimeUS")[0].tolist() == [1000.0]
    assert log.only([(len(first + second), 1000)]).columns("ATT", "Pitch")[0].tolist() == [6.5]
    assert log.only([(len(first) - 7, 1000)]).columns("POS", "TimeUS")[0].tolist() == [5.0, 6.0]


@pytest.mark.parametrize(
    "bad",
    [
        "FMT, 7, 30, ATT, Qf, TimeUS,Yaw,Roll",
        "FMT, 7, 30, ATT, Qff, TimeUS,Yaw",
        "FMT, 7, 30, ATT, Qf, Yaw,Yaw",
        "FMT, 7, 30, ATT, Qf, TimeUS,",
        "FMT, 7, 30, A-T, Qf, TimeUS,Yaw",
        "FMT, 7, 30, ATTIC, Qf, TimeUS,Yaw",
        "FMT, 7, 30, FMT, Qf, TimeUS,Yaw",
        "FMT, 7, 30, ATT, Qf",
    ],
)
def test_a_damaged_definition_of_a_text_defines_nothing(path: Path, bad: str) -> None:
    name = bad.split(", ")[3]
    records_of = f"{name}, 1000, 2.5\n" * 2
    with pytest.raises(LogFormatError) as caught:
        read_text(path, f"FMX, 1\n{bad[1:]}\n{records_of}")
    assert str(caught.value) == (f"{path}: no whole record in 4 lines: the log is cut off or damaged; copy it again")
    assert caught.value.offset == 0

    assert read_text(path, f"{bad}\n{records_of}FMT, 9, 9, POS, Q, TimeUS\nPOS, 5\n").names == ["FMT", "POS"]


def test_a_name_has_four_bytes(path: Path) -> None:
    log = read_text(path, "FMT, 7, 30, ABCD, B, N\nABCD, 5\nABCDE, 6\n, 8\nFMT, 8, 3, ABC, B, M\nABC, 9\n")

    assert log.columns("ABCD", "N")[0].tolist() == [5.0]
    assert log.columns("ABC", "M")[0].tolist() == [9.0]
    assert read_text(path, "FMT, 7, 30, A, B, N\nA, 5\nB, 6\n").columns("A", "N")[0].tolist() == [5.0]


@pytest.mark.parametrize("long", [59, 60, 61, 200])
def test_a_line_longer_than_a_piece_is_no_record(path: Path, monkeypatch: pytest.MonkeyPatch, long: int) -> None:
    monkeypatch.setattr(text, "_PIECE_BYTES", 60)
    log = read_text(path, "FMT, 7, 30, ATT, Qf, TimeUS,Yaw\nATT, 1, 2\n" + "x" * long + "\nATT, 3, 4\n")

    np.testing.assert_array_equal(log.columns("ATT", "TimeUS", "Yaw"), [[1.0, 3.0], [2.0, 4.0]])


@pytest.mark.parametrize(
    ("head", "is_text"),
    [
        (b"FMT, 128, 89, FMT", True),
        (b"\xef\xbb\xbfFMT,1 , 2,", True),
        (b"Init\nFMT , 7 , 30 , ATT", True),
        (b"a FMT, 128, 89, FMT", False),
        (b"FMT, x, 89, FMT", False),
        (b"FMT, 128, 89", False),
    ],
)
def test_a_text_is_known_by_a_line_that_defines_records(head: bytes, is_text: bool) -> None:
    assert is_dataflash_text(head) is is_text
