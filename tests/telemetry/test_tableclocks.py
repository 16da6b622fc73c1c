"""UTC of tables of strangers: wrong cells, clocks that stand still, step or run fast, weeks of 10 bits."""

import re
from pathlib import Path

import numpy as np
import pytest

from glstar.arrays import Float
from glstar.errors import LogFormatError
from glstar.flight import Flight
from glstar.rotation import euler_from_quaternion
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import format_utc
from glstar.telemetry import open_flight, open_source, survey
from glstar.telemetry.tables.tableclock import first_of_each_time, has_whole_seconds, in_first_second, valid_rows
from tests.support.tablefiles import START_S, largest_error_s, make_table

# tests/scripts/strange_flights.py makes thousands of others.
# The last ones: a clock that steps back by 2 s beside UTC of whole seconds; most cells of such UTC empty.
SEEDS = [*range(20), 567, 656, 5010]
HOME = Site(latitude_rad=-0.61, longitude_rad=2.42)
HEADER = (
    "time(millisecond),datetime(utc),latitude,longitude,altitude_above_seaLevel(meters),"
    "compass_heading(degrees),pitch(degrees),roll(degrees)"
)


def heading_deg(flight: Flight) -> Float:
    return np.rad2deg(euler_from_quaternion(flight.attitude.q_body_ned)[2])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_table_with_wrong_times_is_true_or_refused(tmp_path: Path, seed: int) -> None:
    case = make_table(tmp_path, seed)
    try:
        flight = open_flight(case.path)
    except LogFormatError:
        assert not case.must_read, case
        return

    assert largest_error_s(flight.attitude.utc_s, heading_deg(flight)) < case.tolerance_s, case


def airdata(path: Path, clock_s: Float, utc: list[str], true_s: Float | None = None) -> Path:
    """Write a table whose heading says how much time has passed."""
    true_s = clock_s if true_s is None else true_s
    rows = [
        f"{1000 * clock:.1f},{cell},-34.93,138.6,100,{100 + 0.5 * true:.6f},20,10"
        for clock, cell, true in zip(clock_s, utc, true_s, strict=True)
    ]
    path.write_text("\n".join([HEADER, *rows]) + "\n", encoding="utf-8")
    return path


def texts(past_s: Float) -> list[str]:
    return [format_utc(START_S + past)[:19].replace("T", " ") for past in past_s]


CLOCK_S = np.arange(300) * 0.1
WHOLE_S = np.floor(CLOCK_S + 1e-9)


@pytest.mark.parametrize("row", [0, 9, 150, 155, 299])
def test_one_odd_cell_shifts_nothing_and_is_counted(tmp_path: Path, row: int) -> None:
    utc = texts(WHOLE_S)
    utc[row] = texts(WHOLE_S + 3600)[row]
    path = airdata(tmp_path / "air.csv", CLOCK_S, utc)

    with open_source(path) as source:
        report, flight = survey(source)

    assert format_utc(flight.attitude.first_s) == "2024-03-10T11:00:00.000000Z"
    assert report.clocks[0].cut == 1
    remark = rf"1 of its 300 cells .* disagrees with its clock by up to 3(599|600).\d s \(.* line {row + 2}\)"
    assert any(re.match(remark, note) for note in report.notes)


def test_a_date_before_the_first_fix_is_cut(tmp_path: Path) -> None:
    past_s = np.where(CLOCK_S < 2.05, WHOLE_S + 1e7, np.where(CLOCK_S < 5.05, WHOLE_S + 18, WHOLE_S))

    flight = open_flight(airdata(tmp_path / "air.csv", CLOCK_S, texts(past_s)))

    assert format_utc(flight.attitude.first_s) == "2024-03-10T11:00:00.000000Z"
    assert flight.clocks[0].cut == 51


@pytest.mark.parametrize("stands", [CLOCK_S < 9, CLOCK_S > 20])
def test_a_clock_that_stands_still_shifts_nothing(tmp_path: Path, stands: np.ndarray) -> None:
    held_s = WHOLE_S[stands][-1 if stands[0] else 0]
    path = airdata(tmp_path / "air.csv", CLOCK_S, texts(np.where(stands, held_s, WHOLE_S)))

    flight = open_flight(path)

    assert abs(flight.attitude.first_s - START_S) < 1e-6
    assert flight.attitude.utc_s.size == 300


def test_a_table_whose_utc_stands_still_has_none(tmp_path: Path) -> None:
    with pytest.raises(LogFormatError, match="its UTC stands still"):
        open_flight(airdata(tmp_path / "air.csv", CLOCK_S, texts(0 * CLOCK_S)))


def test_two_times_of_about_equal_length_are_refused(tmp_path: Path) -> None:
    past_s = np.where(np.arange(300) % 100 < 50, WHOLE_S, WHOLE_S + 300)

    with pytest.raises(LogFormatError, match="its UTC has two different times, and most cells agree with neither"):
        open_flight(airdata(tmp_path / "air.csv", CLOCK_S, texts(past_s)))


def test_a_clock_in_another_unit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogFormatError, match="in a second of its clock, its UTC goes on by 1000 s; check time_unit"):
        open_flight(airdata(tmp_path / "air.csv", CLOCK_S / 1000, texts(WHOLE_S)))


@pytest.mark.parametrize("rate", [1e-4, -3e-4])
def test_a_clock_that_runs_fast_follows_its_utc(tmp_path: Path, rate: float) -> None:
    true_s = np.arange(20000) * 0.1
    path = airdata(tmp_path / "air.csv", true_s * (1 + rate), texts(np.floor(true_s + 1e-6)), true_s)

    flight = open_flight(path)

    assert largest_error_s(flight.attitude.utc_s[:300], heading_deg(flight)[:300]) < 0.15
    assert abs(flight.attitude.last_s - START_S - true_s[-1]) < 0.15
    assert any("millionths" in note for note in flight.notes)


def test_a_step_of_the_clock_is_a_boundary(tmp_path: Path) -> None:
    true_s = np.arange(600) * 0.1
    clock_s = np.where(true_s < 30, true_s, true_s - 30)
    path = airdata(tmp_path / "air.csv", clock_s, texts(np.floor(true_s + 1e-6)), true_s)

    flight = open_flight(path)

    assert largest_error_s(flight.attitude.utc_s, heading_deg(flight)) < 0.02
    assert [gap.reason for gap in flight.attitude.gaps] == ["a reboot of the autopilot"]
    assert open_flight(path, boot=2).attitude.first_s > START_S + 29.9


@pytest.mark.parametrize("decimals", [0, 3])
@pytest.mark.parametrize("rows", [[40], [40, 41], [0], [200]])
def test_odd_times_of_a_table_in_glstars_columns_are_left_out(tmp_path: Path, rows: list[int], decimals: int) -> None:
    times_s = START_S + np.arange(201) * (1.0 if decimals == 0 else 0.1)
    shown_s = times_s.copy()
    shown_s[rows] += 3600
    lines = [f"{format_utc(t)[: 19 + (decimals and 4)]},1,2,{100 + k % 100},-34,138" for k, t in enumerate(shown_s)]
    path = tmp_path / "own.csv"
    path.write_text("\n".join(["utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg", *lines]))

    flight = open_flight(path)

    np.testing.assert_allclose(flight.attitude.utc_s, np.delete(times_s, rows), rtol=0, atol=1e-3)
    assert any(note.startswith(f"{len(rows)} row") for note in flight.notes)


def test_times_truncated_to_seconds_have_one_attitude_each(tmp_path: Path) -> None:
    times_s = START_S + 0.7 + np.arange(100) * 0.1
    lines = [f"{format_utc(np.floor(t + 1e-6))},1,2,{100 + 0.5 * (t - START_S):.6f},-34,138" for t in times_s]
    for name, header in (("own", "utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"), ("map", "t,r,p,y,a,o")):
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *lines]))
        columns = None if name == "own" else "utc=t,roll=r,pitch=p,yaw=y,latitude=a,longitude=o"

        flight = open_flight(tmp_path / f"{name}.csv", columns=columns)

        assert largest_error_s(flight.attitude.utc_s, heading_deg(flight)) < 0.1


@pytest.mark.parametrize("week", [257, 1281, 0])
def test_a_gps_week_of_10_bits_is_no_utc(tmp_path: Path, week: int) -> None:
    rows = "\n".join(f"{39618 + 0.1 * k:.3f},{week},10,20,{100 + 0.2 * k}" for k in range(100))
    (tmp_path / "week.csv").write_text(f"t,w,r,p,y\n{rows}\n")
    columns = "time=t,time_epoch=week,gps_week=w,roll=r,pitch=p,yaw=y"

    with open_source(tmp_path / "week.csv", columns=columns) as source:
        report, _ = survey(source)

    assert report.utc_first is None
    assert "the receiver's week has rolled over" in report.utc_source


def test_a_gps_week_of_0_before_the_fix_is_left_out(tmp_path: Path) -> None:
    rows = "\n".join(f"{39618 + 0.1 * k:.3f},{2305 if k >= 60 else 0},10,20,{100 + 0.2 * k}" for k in range(100))
    (tmp_path / "week.csv").write_text(f"t,w,r,p,y\n{rows}\n")
    columns = "time=t,time_epoch=week,gps_week=w,roll=r,pitch=p,yaw=y"

    with open_source(tmp_path / "week.csv", columns=columns) as source:
        report, _ = survey(source)

    assert report.utc_first == "2024-03-10T11:00:06.000000Z"


# 2024-03-10 11:00:00 UTC in GPS time since 1980, of which 18 s are leap seconds, and its week and second of the week.
GPS_S, WEEK, SECOND_S = START_S - 315964800 + 18, 2305, 39618.0


def gps_table(path: Path, header: str, *columns: float) -> Path:
    """Write a table of 10 s at 10 Hz whose columns after the attitude begin at these numbers; weeks do not advance."""
    rows = []
    for k in range(100):
        cells = [f"{first + (0.1 * k if first != WEEK else 0):.3f}" for first in columns]
        rows.append(",".join(["10", "20", f"{100 + 0.2 * k}", *cells, format_utc(START_S + 0.1 * k)]))
    path.write_text("\n".join([f"r,p,y,{header},utc", *rows]) + "\n")
    return path


ANGLES = "roll=r,pitch=p,yaw=y"


@pytest.mark.parametrize(
    ("header", "columns", "words", "message"),
    [
        (
            "gps_time_s",
            (GPS_S,),
            "time=gps_time_s",
            "gps_time_s is GPS time by its name, .*time_epoch=gps makes it 2024-03-10 and time_epoch=unix .*2014-03-06",
        ),
        ("iTOW", (SECOND_S * 1e3,), "time=iTOW,time_unit=ms", "iTOW is GPS time by its name, .*give time_epoch"),
        ("t,gps_week", (GPS_S, WEEK), "time=t", "its GPS week counts them from 1980; give time_epoch=gps"),
        ("t,Week", (GPS_S, WEEK), "time=t,time_epoch=unix", "its GPS week counts them from 1980; give time_epoch=gps"),
        ("t,gpsWeek", (SECOND_S, WEEK), "time=t", "within one week, beside a GPS week; give time_epoch=week,gps_week="),
        ("t", (GPS_S,), "time=t,utc=utc", r"t is 315964782\.0 s behind utc: it counts GPS time since 1980"),
        (
            "t",
            (START_S + 18,),
            "time=t,time_epoch=unix,utc=utc",
            r"t is 18\.0 s ahead of utc: it counts GPS time; name one",
        ),
        ("t", (START_S - 3600,), "time=t,utc=utc", r"t is 3600\.0 s behind utc; name one of both"),
        ("t", (GPS_S - 18,), "time=t,time_epoch=gps,utc=utc", r"t is 18\.0 s behind utc; name one of both"),
    ],
)
def test_gps_time_that_a_map_calls_utc_is_refused(
    tmp_path: Path, header: str, columns: tuple[float, ...], words: str, message: str
) -> None:
    path = gps_table(tmp_path / "gps.csv", header, *columns)

    with pytest.raises(LogFormatError, match=message), open_source(path, columns=f"{words},{ANGLES}") as source:
        survey(source)


@pytest.mark.parametrize(
    ("header", "columns", "words"),
    [
        ("gps_time", (START_S,), "time=gps_time,time_epoch=unix"),
        ("gps_time", (GPS_S,), "time=gps_time,time_epoch=gps"),
        ("t,week", (START_S, WEEK), "time=t,utc=utc"),
        ("t,week", (START_S, 10), "time=t"),
        ("t,week", (SECOND_S, WEEK), "time=t,time_epoch=week,gps_week=week"),
    ],
)
def test_times_whose_epoch_is_stated_or_not_in_doubt_are_utc(
    tmp_path: Path, header: str, columns: tuple[float, ...], words: str
) -> None:
    path = gps_table(tmp_path / "gps.csv", header, *columns)

    with open_source(path, columns=f"{words},{ANGLES}") as source:
        report, _ = survey(source)

    assert report.utc_first == "2024-03-10T11:00:00.000000Z"


@pytest.mark.parametrize(("epoch", "remarks"), [("", 1), (",time_epoch=unix", 0)])
def test_seconds_that_may_count_from_1980_are_remarked(tmp_path: Path, epoch: str, remarks: int) -> None:
    path = gps_table(tmp_path / "gps.csv", "t", GPS_S)
    columns = f"time=t{epoch},{ANGLES}"

    flight = open_flight(path, columns=columns, site=HOME)

    named = "taken as seconds since 1970, 2014-03-06; time_epoch=gps, since 1980, makes them 2024-03-10"
    assert sum(named in note for note in flight.notes) == remarks


def blackbox(path: Path, columns: dict[str, object], before: str = "") -> Path:
    header = ", ".join(["loopIteration", "time (us)", *columns])
    rows = [", ".join(map(str, [k, 5000000 + 10000 * k, *columns.values()])) for k in range(300)]
    path.write_text("\n".join([before + header, *rows]) + "\n")
    return path


QUATERNION = {"imuQuaternion[0]": -2534, "imuQuaternion[1]": -5798, "imuQuaternion[2]": -24307}
PLACE = {"GPS_coord[0]": -34.93, "GPS_coord[1]": 138.6, "GPS_altitude": 5000}


def test_heights_of_betaflight_are_in_decimetres_and_those_of_inav_in_metres(tmp_path: Path) -> None:
    betaflight = blackbox(tmp_path / "btfl.csv", QUATERNION | PLACE)
    angles = {"attitude[0]": 100, "attitude[1]": -200, "attitude[2]": 1000}
    inav = blackbox(tmp_path / "inav.csv", angles | PLACE)

    heights_m = [open_flight(path, utc_start=START_S).position.at(START_S).height_m for path in (betaflight, inav)]

    assert heights_m == [500, 5000]


@pytest.mark.parametrize(
    ("firmware", "height_m", "unit"),
    [
        ("Betaflight 3.5.7", 5000, "metres, as its firmware writes"),
        ("Cleanflight 2.3.2", 5000, "metres, as its firmware writes"),
        ("Betaflight 4.3.2 (b38b2fb) STM32F405", 500, "tenths of a metre"),
        ("Betaflight 2025.12.0", 500, "tenths of a metre"),
    ],
)
def test_the_firmware_of_a_blackbox_says_the_unit_of_its_heights(
    tmp_path: Path, firmware: str, height_m: float, unit: str
) -> None:
    before = f'"fieldname","fieldvalue"\n"Product","Blackbox"\n"Firmware revision","{firmware}"\n'
    path = blackbox(tmp_path / "bbe.csv", QUATERNION | PLACE, before)

    flight = open_flight(path, utc_start=START_S)

    assert flight.position.at(START_S).height_m == height_m
    assert f"GPS_altitude has no unit and is taken in {unit}" in flight.notes


def test_the_date_and_time_of_a_blackbox_is_its_utc(tmp_path: Path) -> None:
    path = blackbox(tmp_path / "inav.csv", {"attitude[0]": 100, "attitude[1]": -200, "attitude[2]": 1000} | PLACE)
    lines = path.read_text().splitlines()
    dated = [f"{line}, 2024-03-10T11:00:{k * 0.01:09.6f}+00:00" for k, line in enumerate(lines[1:])]
    path.write_text("\n".join([f"{lines[0]}, dateTime", *dated]))
    assert abs(open_flight(path).attitude.first_s - START_S) < 1e-6

    path.write_text(
        "\n".join([f"{lines[0]}, dateTime", *(f"{line}, 0000-01-01T00:00:00.000000+00:00" for line in lines[1:])])
    )
    with pytest.raises(LogFormatError, match="no UTC"):
        open_flight(path)


@pytest.mark.parametrize("settings", [2, 400])
def test_the_settings_before_a_header_of_blackbox_explorer_are_skipped(tmp_path: Path, settings: int) -> None:
    before = '"fieldname","fieldvalue"\n' + "".join(f'"setting{k}","a, b, c {k}"\n' for k in range(settings))
    path = blackbox(tmp_path / "bbe.csv", QUATERNION | PLACE, before)

    flight = open_flight(path, utc_start=START_S)

    assert flight.attitude.utc_s.size == 300
    assert flight.position.at(START_S).height_m == 500


@pytest.mark.parametrize(("numbers", "hint"), [(8, "--columns tum, if it is a TUM trajectory"), (5, "with --columns")])
def test_a_table_of_numbers_without_header_gets_a_hint(tmp_path: Path, numbers: int, hint: str) -> None:
    (tmp_path / "poses.txt").write_text(f"{' '.join(map(str, range(numbers)))}\n" * 3)

    with pytest.raises(LogFormatError, match=f"no header but {numbers} numbers; .*{hint}"):
        open_flight(tmp_path / "poses.txt")


@pytest.mark.parametrize(
    ("utc_s", "are_whole"),
    [
        ([], False),
        ([np.nan], False),
        ([5.0], True),
        ([5.0, 6.25], False),  # half is not most
        ([5.0, 6.25, 7.0, np.nan], True),
        ([5.25, 6.25, 7.0, 8.75], False),
        ([START_S, START_S + 1, START_S + 1.5], True),
    ],
)
def test_most_readings_have_whole_seconds_or_not(utc_s: list[float], are_whole: bool) -> None:
    assert has_whole_seconds(np.array(utc_s)) == are_whole


def test_the_first_row_of_each_time_is_found_but_not_of_a_first_one_that_is_held() -> None:
    nan = np.nan
    # The first value may have been held before the table began: its rows do not say when it was first.
    np.testing.assert_array_equal(
        first_of_each_time(np.array([5.0, 5.0, nan, 6.0, 6.0, 7.0, 7.0])), [0, 0, 0, 1, 0, 1, 0]
    )
    np.testing.assert_array_equal(first_of_each_time(np.array([nan, 5.0, 6.0, 6.0, 7.0])), [0, 1, 1, 0, 1])
    np.testing.assert_array_equal(first_of_each_time(np.array([5.0, 5.0])), [1, 0])
    np.testing.assert_array_equal(first_of_each_time(np.array([5.0, 6.0, 6.0, 7.0, 7.0])), [0, 1, 0, 1, 0])


def test_rows_of_the_first_second_are_those_that_repeat_it() -> None:
    truncated = np.repeat(np.arange(5.0, 9.0), 10)[3:]
    np.testing.assert_array_equal(in_first_second(truncated), np.arange(37) < 7)
    assert not in_first_second(truncated + 0.3).any()
    assert not in_first_second(np.arange(5.0, 40.0)).any()
    assert not in_first_second(np.full(20, 5.0)).any()


@pytest.mark.parametrize(
    ("rows", "glitches", "are_found"),
    [(5000, 40, True), (5000, 98, True), (5000, 104, False), (500, 15, True), (500, 20, True), (500, 21, False)],
)
def test_times_that_are_wrong_for_a_row_are_not_valid_unless_a_fiftieth_are(rows, glitches, are_found) -> None:
    """A table with more steps back than a fiftieth of its rows is not sorted: all finite times are valid."""
    clock_s = np.arange(rows) / 10
    wrong = np.linspace(10, rows - 10, glitches).astype(int)
    clock_s[wrong] -= 400.0
    clock_s[5] = np.nan
    expected = np.isfinite(clock_s)
    if are_found:
        expected[wrong] = False
    np.testing.assert_array_equal(valid_rows(clock_s), expected)


def glitched(rows: int, step_s: float, glitch: slice, by_s: float) -> Float:
    clock_s = np.arange(rows) * step_s
    clock_s[glitch] += by_s
    return clock_s


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("rows", "step_s", "length", "by_s", "is_valid"),
    [
        (600, 0.1, 97, 400.0, False),  # up to 10 s
        (600, 0.1, 103, 400.0, True),
        (600, 1.0, 9, 4000.0, False),
        (600, 1.0, 12, 4000.0, True),
        (60, 8.0, 2, 4000.0, False),  # or two rows
        (60, 8.0, 3, 4000.0, True),
    ],
)
def test_an_excursion_of_the_time_is_cut_up_to_ten_seconds_or_two_rows(
    side: int, rows: int, step_s: float, length: int, by_s: float, is_valid: bool
) -> None:
    glitch = slice(20, 20 + length)
    expected = np.full(rows, True)
    expected[glitch] = is_valid
    np.testing.assert_array_equal(valid_rows(glitched(rows, step_s, glitch, side * by_s)), expected)


@pytest.mark.parametrize(
    ("length", "by_s", "is_valid"), [(2, 0.68, True), (2, 0.72, False), (20, 1.95, True), (20, 2.05, False)]
)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_smaller_excursion_than_a_jump_or_its_own_length_is_kept(
    length: int, by_s: float, is_valid: bool, side: int
) -> None:
    """Rows at 0.1 s: a jump is 0.5 s and three intervals more than the usual one, or its times overlap others."""
    glitch = slice(100, 100 + length)
    expected = np.full(300, True)
    expected[glitch] = is_valid
    np.testing.assert_array_equal(valid_rows(glitched(300, 0.1, glitch, side * by_s)), expected)


@pytest.mark.parametrize(("lost_s", "is_cut"), [(4.6, True), (4.8, False), (-2.0, True), (-2.2, False)])
def test_a_time_that_comes_back_elsewhere_is_no_excursion(lost_s: float, is_cut: bool) -> None:
    """Rows after twenty at 0.1 s go on within 2.1 s before them, and 6.8 s: three times the usual ones and 0.5 s."""
    clock_s = glitched(300, 0.1, slice(100, 120), 400.0)
    clock_s[120:] += lost_s
    expected = np.full(300, True)
    expected[100:120] = not is_cut
    np.testing.assert_array_equal(valid_rows(clock_s), expected)
