"""The CSV of mavlogdump as packets: rows of other senders, tables of several vehicles, from both sides of limits."""

from pathlib import Path

import numpy as np
import pytest

from glstar.arrays import Float
from glstar.errors import LogFormatError
from glstar.telemetry.mavlink import mavlogdump

nan = np.nan
STAMP_S = 1710068375.0  # Arrival minus time since boot


def dump(path: Path, columns: dict[str, Float]) -> mavlogdump._Rows:
    names, table = list(columns), np.column_stack(list(columns.values()))
    lines = [",".join("" if np.isnan(cell) else repr(float(cell)) for cell in row) for row in table]
    path.write_text("\n".join([",".join(names), *lines]) + "\n")
    return mavlogdump._Rows(str(path))


def attitudes(boot_ms: Float, yaw_rad: Float | float = 0.5) -> dict[str, Float]:
    yaw = np.broadcast_to(yaw_rad, boot_ms.shape)
    fields = {"time_boot_ms": boot_ms, "roll": boot_ms * 0 + 0.1, "pitch": boot_ms * 0 + 0.2, "yaw": yaw}
    return {"timestamp": STAMP_S + boot_ms / 1e3} | {f"ATTITUDE.{name}": column for name, column in fields.items()}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "dump.csv"


def test_rows_of_a_dump_are_packets(path: Path) -> None:
    boot_ms = 30_000 + 100.0 * np.arange(40)
    odd = np.arange(40) % 2 == 1
    columns = {name: np.where(odd & (name != "timestamp"), nan, column) for name, column in attitudes(boot_ms).items()}
    columns |= {
        f"HEARTBEAT.{name}": np.where(odd, value, nan)
        for name, value in (("autopilot", np.where(np.arange(40) < 9, 8, 3)), ("type", 1))
    }
    times_ms = np.where(np.arange(40) % 4 == 1, boot_ms + 4900, boot_ms + 5200)
    columns |= {
        "SYSTEM_TIME.time_boot_ms": np.where(odd, times_ms, nan),
        "SYSTEM_TIME.time_unix_usec": np.where(odd, 1.7e15, nan),
    }
    found = dump(path, columns)
    even = np.flatnonzero(~odd)
    expected = [[k + 2, STAMP_S + boot_ms[k] / 1e3, 1, 1, boot_ms[k], 0.1, 0.2, 0.5] for k in even]
    np.testing.assert_allclose(found.message("ATTITUDE"), expected, rtol=1e-12)
    senders = found.message("HEARTBEAT")[:, 2:5].tolist()
    assert senders == [[0, 0, 8]] * 4 + [[1, 1, 3]] * 16
    # The next attitude is 0.1 s later: 4.8 and 5.1 s, by which the clock of SYSTEM_TIME differs.
    assert found.message("SYSTEM_TIME")[:, 2].tolist() == [1, 0] * 9 + [1, 0]
    assert (found.count, found.whole_bytes, found.unread_bytes, found.checked) == (40, 41, 0, False)
    assert found.message("RAW_IMU").shape == (0, 8)
    assert found.called((0, 0)) == "another sender"
    assert found.lack("X") == "no X in the table: write it again with mavlogdump --types ...,X"


@pytest.mark.parametrize(("back_ms", "is_mixed"), [(4800.0, False), (5200.0, True)])
def test_clocks_that_alternate_are_of_two_vehicles(path: Path, back_ms: float, is_mixed: bool) -> None:
    """Eleven steps back in forty rows."""
    steps = np.where((np.arange(40) % 3 == 2) & (np.arange(40) < 33), -back_ms, back_ms / 2 + 10)
    if is_mixed:
        with pytest.raises(LogFormatError, match=r"has ATTITUDE of several vehicles, and no column with their systems"):
            dump(path, attitudes(1e6 + np.cumsum(steps)))
    else:
        assert not mavlogdump._goes_back(1e6 + np.cumsum(steps), 5000.0)


@pytest.mark.parametrize(
    ("steps", "size", "goes_back"),
    [(10, 100, False), (11, 100, True), (11, 219, True), (11, 221, False), (15, 299, True)],
)
def test_how_often_a_clock_steps_back(steps: int, size: int, goes_back: bool) -> None:
    """More than ten times, and more than a twentieth of the rows."""
    clock_ms = 100.0 * np.arange(size)
    clock_ms[5 + 8 * np.arange(steps)] -= 150
    assert mavlogdump._goes_back(clock_ms, 40.0) is goes_back
    assert not mavlogdump._goes_back(clock_ms, 60.0)


@pytest.mark.parametrize(
    ("rows_of", "other_by", "drift", "alternates"),
    [
        (20, 0.021, 0.0, True),
        (20, 0.019, 0.0, False),
        (19, 0.5, 0.0, False),
        (30, 0.5, 0.052, False),
        (30, 0.5, 0.045, True),
    ],
)
def test_attitudes_that_alternate_are_of_two_vehicles(
    rows_of: int, other_by: float, drift: float, alternates: bool
) -> None:
    """Neighbours differ by more than 0.02, and five times more than every other row, which drifts by twice a step."""
    k = np.arange(rows_of)
    values = np.column_stack([drift * k + other_by * (k % 2), 3.0 + 0 * k])
    assert mavlogdump._alternates(values, 0.02) is alternates


def test_positions_and_angles_that_alternate_are_of_two_vehicles(path: Path) -> None:
    boot_ms = 30_000 + 100.0 * np.arange(40)
    turn = np.where(np.arange(40) % 2, 3.135, -3.135)
    dump(path, attitudes(boot_ms, turn))  # the same heading
    with pytest.raises(LogFormatError, match="has ATTITUDE of several"):
        dump(path, attitudes(boot_ms, np.where(np.arange(40) % 2, 0.5, 0.6)))
    for off, is_mixed in ((1900, False), (2100, True)):
        place = {"lat": -345000000 + off * (np.arange(40) % 2), "lon": 1385000000.0, "alt": 1e5 * (np.arange(40) % 2)}
        columns = attitudes(boot_ms) | {"GLOBAL_POSITION_INT.time_boot_ms": boot_ms}
        columns |= {f"GLOBAL_POSITION_INT.{name}": np.broadcast_to(of, 40) * 1.0 for name, of in place.items()}
        if is_mixed:
            with pytest.raises(LogFormatError, match="has GLOBAL_POSITION_INT of several"):
                dump(path, columns)
        else:
            dump(path, columns)


@pytest.mark.parametrize(
    ("header", "is_dump"),
    [
        ("timestamp,ATTITUDE.roll,x", True),
        ("timestamp;SYSTEM_TIME.time_boot_ms", True),
        ("timestamp,ATTITUDE.roll\n", True),
        ("timestamp,TimeUS", False),
        ("timestamp,ATTITUDE.roll;x", False),
        ("time,ATTITUDE.roll", False),
    ],
)
def test_a_dump_is_known_by_its_header(header: str, is_dump: bool) -> None:
    assert mavlogdump.is_mavlogdump(header) is is_dump
