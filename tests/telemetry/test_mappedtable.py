"""Tables of other programs: attitude, UTC and position agree with SciPy and with the program's own conventions."""

import gzip
import zipfile
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation, Slerp

from glstar.config import Config
from glstar.errors import ConfigError, LogFormatError
from glstar.flight import Flight
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from glstar.telemetry import RateSamples, column_map, open_flight, open_source, ready_maps
from glstar.telemetry.tables.files import TableFile, TableKind

START_S = 1710068400.0  # 2024-03-10T11:00:00Z
TIMES_S = np.arange(200) * 0.05
ROLL_DEG, PITCH_DEG, YAW_DEG = 25 * np.sin(TIMES_S), 8 * np.cos(0.7 * TIMES_S), 340 + 4 * TIMES_S
LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = -34.93 + 1e-5 * TIMES_S, 138.60 + 2e-5 * TIMES_S, 120 + TIMES_S


@pytest.fixture
def log() -> Path:
    return asset("adelaide.BIN")


HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60))

# Body axes forward, right, down in north, east, down; columns of the matrix are the body axes.
NED_FRD = Rotation.from_euler("ZYX", np.column_stack([YAW_DEG, PITCH_DEG, ROLL_DEG]), degrees=True)
FLIP = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
ENU_NED = Rotation.from_matrix(np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]))
ENU_FLU = ENU_NED * NED_FRD * FLIP
NWU_FLU = FLIP * NED_FRD * FLIP


def off_deg(flight: Flight, times_s: np.ndarray, start_s: float = START_S) -> float:
    """Return the largest angle between the flight and SciPy's slerp of the attitudes that were written, deg."""
    truth = Slerp(TIMES_S, NED_FRD)(times_s).as_matrix()
    C_body_ned = matrix_from_quaternion(flight.attitude.at(times_s + start_s))
    return float(np.rad2deg(Rotation.from_matrix(C_body_ned @ truth).magnitude().max()))


def require_agreement(flight: Flight, *, start_s: float = START_S, places: bool = True) -> None:
    between_s = TIMES_S[3:-3] + 0.013
    assert off_deg(flight, between_s, start_s) < 0.001
    assert abs(flight.attitude.first_s - (start_s + TIMES_S[0])) < 1e-3
    if places:
        latitude_rad, longitude_rad, height_m = flight.position.coordinates(between_s + start_s)
        metres = 6.4e6 * np.abs(np.rad2deg(latitude_rad) - np.interp(between_s, TIMES_S, LATITUDE_DEG)) * np.pi / 180
        assert metres.max() < 1
        np.testing.assert_allclose(
            np.rad2deg(longitude_rad), np.interp(between_s, TIMES_S, LONGITUDE_DEG), rtol=0, atol=1e-5
        )
        np.testing.assert_allclose(height_m, np.interp(between_s, TIMES_S, HEIGHT_M), rtol=0, atol=1)


def utc_texts(separator: str = "T", decimals: int = 3) -> list[str]:
    times = pd.to_datetime(START_S + TIMES_S, unit="s")
    return [f"{time:%Y-%m-%d}{separator}{time:%H:%M:%S.%f}"[: 20 + decimals - (decimals == 0)] for time in times]


def euler_table(**renamed: str) -> pd.DataFrame:
    table = {
        "roll": ROLL_DEG, "pitch": PITCH_DEG, "yaw": YAW_DEG % 360,
        "latitude": LATITUDE_DEG, "longitude": LONGITUDE_DEG, "height": HEIGHT_M,
    }  # fmt: skip
    return pd.DataFrame(table).rename(columns=renamed)


# --- ready maps -----------------------------------------------------------------------------------------------------
def test_an_airdata_table_is_recognised_by_its_header(tmp_path: Path) -> None:
    table = euler_table(roll=" roll(degrees)", pitch=" pitch(degrees)", yaw=" compass_heading(degrees)")
    table["altitude_above_seaLevel(feet)"] = table.pop("height") / 0.3048
    # UTC in whole seconds, as AirData writes it; the flight begins on a second.
    table.insert(0, "datetime(utc)", utc_texts(" ", 0))
    table.insert(0, "time(millisecond)", np.round(TIMES_S * 1e3).astype(int))
    table.to_csv(tmp_path / "airdata.csv", index=False)

    flight = open_flight(tmp_path / "airdata.csv")

    require_agreement(flight)
    assert flight.utc_source == "AirData CSV, datetime(utc)"
    assert any("whole seconds" in note for note in flight.notes)


def test_whole_seconds_of_utc_are_refined_by_the_clock(tmp_path: Path) -> None:
    begins_s = START_S + 0.34
    table = euler_table(roll="roll(degrees)", pitch="pitch(degrees)", yaw="compass_heading(degrees)")
    stamps = pd.to_datetime(np.floor(begins_s + TIMES_S), unit="s")
    table.insert(0, "datetime(utc)", [f"{stamp:%Y-%m-%d %H:%M:%S}" for stamp in stamps])
    table.insert(0, "time(millisecond)", np.round(TIMES_S * 1e3).astype(int))
    table.to_csv(tmp_path / "airdata.csv", index=False)

    flight = open_flight(tmp_path / "airdata.csv")

    # Truncated seconds alone would be half a second early; the clock leaves one sample interval.
    assert -0.05 < flight.attitude.first_s - begins_s <= 1e-6


def test_a_dji_flight_record_with_utc_is_read(tmp_path: Path) -> None:
    table = euler_table(
        roll="OSD.roll", pitch="OSD.pitch", yaw="OSD.yaw", latitude="OSD.latitude", longitude="OSD.longitude"
    )
    table["OSD.altitude [ft]"] = table.pop("height") / 0.3048
    table["OSD.flyTime [s]"] = TIMES_S + 7
    table["CUSTOM.updateTime"] = [text.replace("-", "/") for text in utc_texts(" ")]
    path = tmp_path / "dji.csv"
    path.write_text("sep=,\n" + table.to_csv(index=False))

    require_agreement(open_flight(path))


def american(text: str) -> tuple[str, str]:
    """Return date and time of day as DJI's programs write them: 3/10/2024 and 7:05:08.97 PM."""
    time = datetime.fromisoformat(text.removesuffix("Z"))
    fraction = f"{time.microsecond:06d}"
    clock = f"{(time.hour - 1) % 12 + 1}:{time:%M:%S}.{fraction} {'AM' if time.hour < 12 else 'PM'}"
    return f"{time.month}/{time.day}/{time.year}", clock


@pytest.mark.parametrize("program", ["PhantomHelp", "Flight Reader", "DroneLog"])
def test_dji_flight_records_are_read_as_their_programs_write_them(tmp_path: Path, program: str) -> None:
    """A clock with AM or PM; decimal commas in quotes; units in the names of the columns."""
    degree = " [°]" if program == "DroneLog" else ""
    table = euler_table(
        roll=f"OSD.roll{degree}", pitch=f"OSD.pitch{degree}", yaw=f"OSD.yaw{degree}", latitude="OSD.latitude"
    ).rename(columns={"longitude": "OSD.longitude", "height": "OSD.altitude [m]"})
    texts = [american(text) for text in utc_texts("T")]
    table["CUSTOM.date [UTC]"], table["CUSTOM.updateTime [UTC]"] = zip(*texts, strict=True)
    table["OSD.flyTime [ms]" if degree else "OSD.flyTime [s]"] = (TIMES_S + 7) * (1e3 if degree else 1)
    is_european = program == "Flight Reader"
    if is_european:
        table["CUSTOM.date [UTC]"] = [text[:10] for text in utc_texts(" ")]
        table["CUSTOM.updateTime [UTC]"] = table["CUSTOM.updateTime [UTC]"].str.lower()
    path = tmp_path / "dji.csv"
    path.write_text(table.to_csv(index=False, decimal="," if is_european else "."), encoding="utf-8-sig")

    require_agreement(open_flight(path))


def test_commas_that_may_be_thousands_are_refused(tmp_path: Path) -> None:
    table = euler_table(roll="OSD.roll", pitch="OSD.pitch", yaw="OSD.yaw", latitude="OSD.latitude")
    table = table.rename(columns={"longitude": "OSD.longitude"})
    table["OSD.flyTime [s]"] = "1,024"
    table.to_csv(tmp_path / "dji.csv", index=False)

    with pytest.raises(LogFormatError, match="'1,024' is not a number; write decimals with a point"):
        open_flight(tmp_path / "dji.csv")


@pytest.mark.parametrize(
    ("text", "utc"),
    [
        ("10/16/2024 12:00:00 AM", "2024-10-16T00:00:00Z"),
        ("10/16/2024 12:59:59.5 pm", "2024-10-16T12:59:59.5Z"),
        ("2024-10-16 1:00:00,25 p.m.", "2024-10-16T13:00:00.25Z"),
    ],
)
def test_clocks_with_am_and_pm(text: str, utc: str) -> None:
    table = TableFile("table", TableKind.CSV, {"utc": [text]}, np.array([1]))
    assert table.times("utc")[0] == pytest.approx(parse_utc(utc), abs=1e-6, rel=0)


@pytest.mark.parametrize("text", ["16/10/2024 1:00:00 PM", "10/16/2024 13:00:00 PM", "10/16/2024 1:00:00"])
def test_ambiguous_dates_and_clocks_are_refused(text: str) -> None:
    table = TableFile("table", TableKind.CSV, {"utc": [text]}, np.array([1]))
    with pytest.raises(LogFormatError, match="is not an ISO 8601 time"):
        table.times("utc")


def test_local_time_of_a_dji_flight_record_is_no_utc(tmp_path: Path) -> None:
    table = euler_table(roll="OSD.roll", pitch="OSD.pitch", yaw="OSD.yaw", latitude="OSD.latitude")
    table = table.rename(columns={"longitude": "OSD.longitude"})
    table["OSD.flyTime [s]"], table["CUSTOM.updateTime [local]"] = TIMES_S, "7:05:08.97 PM"
    table.to_csv(tmp_path / "dji.csv", index=False)

    with pytest.raises(LogFormatError, match=r"the log has no UTC .*--utc-start"):
        open_flight(tmp_path / "dji.csv")


def test_an_x_plane_table_is_read(tmp_path: Path) -> None:
    names = ("_real,_time", "_totl,_time", "pitch,__deg", "_roll,__deg", "hding,_true", "__lat,__deg", "__lon,__deg",
             "__alt,ftmsl")  # fmt: skip
    columns = (TIMES_S, TIMES_S, PITCH_DEG, ROLL_DEG, YAW_DEG % 360, LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M / 0.3048)
    lines = [" | ".join(names) + " |"] + [
        " | ".join(f"{x:.7f}" for x in row) + " |" for row in zip(*columns, strict=True)
    ]
    path = tmp_path / "Data.txt"
    path.write_text("\n" + "\n".join(lines) + "\n")

    require_agreement(open_flight(path, utc_start=START_S))


def test_a_betaflight_table_holds_three_components_of_a_quaternion(tmp_path: Path) -> None:
    q_xyzw = NWU_FLU.as_quat()
    q_xyzw = np.where(q_xyzw[:, 3:] < 0, -q_xyzw, q_xyzw)
    # 32767 would round to 0.003 deg: write more digits than the firmware does, to test the frames.
    table = pd.DataFrame({"loopIteration": np.arange(TIMES_S.size), "time (us)": TIMES_S * 1e6 + 5e6})
    for k in range(3):
        table[f"imuQuaternion[{k}]"] = q_xyzw[:, k] * 32767
    table["GPS_coord[0]"], table["GPS_coord[1]"] = LATITUDE_DEG, LONGITUDE_DEG
    # Decimetres, as Betaflight writes since 4.
    table["GPS_altitude"] = 10 * HEIGHT_M
    table.to_csv(tmp_path / "btfl.csv", index=False)

    require_agreement(open_flight(tmp_path / "btfl.csv", utc_start=START_S))


def test_half_a_turn_of_betaflight_has_no_fourth_component_and_a_longer_quaternion_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "btfl.csv"
    table = pd.DataFrame({"loopIteration": np.arange(TIMES_S.size), "time (us)": TIMES_S * 1e6 + 5e6})
    # As the firmware rounds half a turn about an axis between x and z: 1.00003 long.
    for k, count in enumerate((23170, 0, 23171)):
        table[f"imuQuaternion[{k}]"] = count
    table.to_csv(path, index=False)

    flight = open_flight(path, site=HOME, utc_start=START_S)

    turned = (FLIP * Rotation.from_quat([23170, 0, 23171, 0]) * FLIP).inv().as_matrix()
    np.testing.assert_allclose(matrix_from_quaternion(flight.attitude.q_body_ned[0]), turned, rtol=0, atol=1e-9)

    table["imuQuaternion[2]"] = 24000
    table.to_csv(path, index=False)
    with pytest.raises(LogFormatError, match="begins a quaternion longer than 1"):
        open_flight(path, site=HOME, utc_start=START_S)


def test_an_inav_table_counts_the_pitch_downwards_in_tenths_of_a_degree(tmp_path: Path) -> None:
    table = pd.DataFrame({"loopIteration": np.arange(TIMES_S.size), "time (us)": TIMES_S * 1e6})
    table["attitude[0]"], table["attitude[1]"] = ROLL_DEG * 10, -PITCH_DEG * 10
    table["attitude[2]"] = (YAW_DEG % 360) * 10
    table["GPS_coord[0]"], table["GPS_coord[1]"], table["GPS_altitude"] = LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M
    table.to_csv(tmp_path / "inav.csv", index=False)

    require_agreement(open_flight(tmp_path / "inav.csv", utc_start=START_S))


def test_a_euroc_table_turns_the_sensor_into_a_world_with_z_up(tmp_path: Path) -> None:
    q = (ENU_NED * NED_FRD).as_quat(scalar_first=True)
    table = pd.DataFrame({"#timestamp": np.round((START_S + TIMES_S) * 1e9).astype(np.int64)})
    for axis in "xyz":
        table[f" p_RS_R_{axis} [m]"] = 0.0
    for k, name in enumerate("wxyz"):
        table[f" q_RS_{name} []"] = q[:, k]
    table.to_csv(tmp_path / "data.csv", index=False)

    flight = open_flight(tmp_path / "data.csv", site=HOME)

    require_agreement(flight, places=False)
    assert any("azimuth" in note for note in flight.notes)


@pytest.mark.parametrize("header", ["# timestamp tx ty tz qx qy qz qw\n", ""])
def test_a_tum_trajectory_is_read_with_and_without_its_header(tmp_path: Path, header: str) -> None:
    q = (ENU_NED * NED_FRD).as_quat()
    rows = [f"{START_S + t:.4f} 0 0 0 {' '.join(f'{x:.9f}' for x in one)}\n" for t, one in zip(TIMES_S, q, strict=True)]
    path = tmp_path / "groundtruth.txt"
    path.write_text("# ground truth trajectory\n# file: 'x.bag'\n" + header + "".join(rows))

    flight = open_flight(path, site=HOME, columns=None if header else "tum")

    require_agreement(flight, places=False)


# --- maps of the user ------------------------------------------------------------------------------------------------
def save_csv(table: pd.DataFrame, path: Path) -> Path:
    table.to_csv(path.with_suffix(".csv"), index=False)
    return path.with_suffix(".csv")


def save_parquet(table: pd.DataFrame, path: Path) -> Path:
    table.to_parquet(path.with_suffix(".parquet"))
    return path.with_suffix(".parquet")


def save_excel(table: pd.DataFrame, path: Path) -> Path:
    table.to_excel(path.with_suffix(".xlsx"), index=False)
    return path.with_suffix(".xlsx")


@pytest.mark.parametrize("save", [save_csv, save_parquet, save_excel])
def test_a_map_in_words_reads_csv_parquet_and_excel(tmp_path: Path, save: Callable[[pd.DataFrame, Path], Path]) -> None:
    table = euler_table(roll="phi", pitch="theta", yaw="psi", latitude="lat", longitude="lon", height="h")
    table[["phi", "theta", "psi", "lat", "lon"]] = np.deg2rad(table[["phi", "theta", "psi", "lat", "lon"]])
    table["t"] = (START_S + TIMES_S) * 1e3
    words = "time=t,time_unit=ms,roll=phi,pitch=theta,yaw=psi,angle_unit=rad,latitude=lat,longitude=lon"

    require_agreement(open_flight(save(table, tmp_path / "flight"), columns=f"{words},place_unit=rad,height=h"))


@pytest.mark.parametrize("save", [save_parquet, save_excel])
def test_glstars_own_columns_need_no_map(tmp_path: Path, save: Callable[[pd.DataFrame, Path], Path]) -> None:
    table = euler_table(
        roll="roll_deg", pitch="pitch_deg", yaw="yaw_deg", latitude="latitude_deg", longitude="longitude_deg"
    ).rename(columns={"height": "height_m"})
    table["utc"] = pd.to_datetime(START_S + TIMES_S, unit="s").round("ms")

    require_agreement(open_flight(save(table, tmp_path / "flight")))


@pytest.mark.parametrize(
    ("rotation", "words"),
    [
        (NED_FRD, "world=NED,body=FRD"),
        (ENU_FLU, "world=ENU,body=FLU"),
        (NWU_FLU, "world=NWU,body=FLU"),
        (NED_FRD.inv(), "rotates=world_to_body"),
        (NED_FRD * FLIP, "body=FLU"),
    ],
)
def test_quaternions_between_any_frames_are_converted(tmp_path: Path, rotation: Rotation, words: str) -> None:
    q = rotation.as_quat(scalar_first=True)
    table = pd.DataFrame({"t": START_S + TIMES_S} | {f"q{k}": q[:, k] for k in range(4)})
    table.to_csv(tmp_path / "q.csv", index=False)

    flight = open_flight(tmp_path / "q.csv", site=HOME, columns=f"time=t,quaternion=q0|q1|q2|q3,{words}")

    require_agreement(flight, places=False)


def test_euler_angles_in_enu_and_flu_are_converted(tmp_path: Path) -> None:
    yaw_deg, pitch_deg, roll_deg = ENU_FLU.as_euler("ZYX", degrees=True).T
    table = pd.DataFrame({"t": START_S + TIMES_S, "r": roll_deg, "p": pitch_deg, "y": yaw_deg})
    table.to_csv(tmp_path / "e.csv", index=False)

    flight = open_flight(tmp_path / "e.csv", site=HOME, columns="time=t,roll=r,pitch=p,yaw=y,world=ENU,body=FLU")

    require_agreement(flight, places=False)


def test_rates_in_flu_change_the_sign_of_pitch_and_yaw(tmp_path: Path) -> None:
    table = euler_table()
    table["t"], table["p"], table["q"], table["r"] = START_S + TIMES_S, 0.1, 0.2, 0.3
    table.to_csv(tmp_path / "e.csv", index=False)
    words = "time=t,roll=roll,pitch=pitch,yaw=yaw,roll_rate=p,pitch_rate=q,yaw_rate=r,rate_unit=rad"

    for body, signs in (("FRD", (1, 1, 1)), ("FLU", (1, -1, -1))):
        with open_source(tmp_path / "e.csv", columns=f"{words},body={body}") as source:
            (found,) = [one for one in source.samples() if isinstance(one, RateSamples)]
        np.testing.assert_allclose(found.rate_rad_per_s[0], np.array([0.1, 0.2, 0.3]) * signs, rtol=0, atol=1e-12)


@pytest.mark.parametrize("epoch", ["gps", "week"])
def test_gps_time_becomes_utc_by_the_leap_seconds(tmp_path: Path, epoch: str) -> None:
    # 18 leap seconds between GPS time and UTC since 2017; 315964800 is 1980-01-06.
    gps_s = START_S + TIMES_S - 315964800 + 18
    table = euler_table()
    table["t"], table["w"] = (gps_s, 0) if epoch == "gps" else (gps_s % 604800, gps_s // 604800)
    table.to_csv(tmp_path / "g.csv", index=False)
    week = ",gps_week=w" if epoch == "week" else ""
    words = f"time=t,time_epoch={epoch}{week},roll=roll,pitch=pitch,yaw=yaw,latitude=latitude,longitude=longitude"

    require_agreement(open_flight(tmp_path / "g.csv", columns=f"{words},height=height"))


def test_a_map_file_is_found_beside_the_config_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "mine.toml").write_text('time = "t"\nroll = "roll"\npitch = "pitch"\nyaw = "yaw"\n')
    (tmp_path / "maps" / "night.toml").write_text(
        '[flight]\ncolumns = "mine.toml"\nlatitude_deg = 0\nlongitude_deg = 0\n'
    )
    table = euler_table()
    table["t"] = START_S + TIMES_S
    table.to_csv(tmp_path / "e.csv", index=False)
    monkeypatch.chdir(tmp_path)

    config = Config.load(tmp_path / "maps" / "night.toml")

    require_agreement(config.open_flight("e.csv"), places=False)
    assert Config.load(tmp_path / "maps" / "night.toml").resolved()["flight"]["columns"].endswith("mine.toml")


# --- archives ---------------------------------------------------------------------------------------------------------
def test_a_gzipped_log_and_a_zipped_log_are_opened(tmp_path: Path, log: Path) -> None:
    content = log.read_bytes()
    (tmp_path / "flight.BIN.gz").write_bytes(gzip.compress(content, 1))
    with zipfile.ZipFile(tmp_path / "flight.zip", "w") as archive:
        archive.writestr("logs/readme.txt", b"\0 nothing")
        archive.writestr("logs/flight.BIN", content)
    expected = open_flight(log)

    for name in ("flight.BIN.gz", "flight.zip"):
        flight = open_flight(tmp_path / name)
        np.testing.assert_array_equal(flight.attitude.q_body_ned, expected.attitude.q_body_ned)
        np.testing.assert_array_equal(flight.attitude.utc_s, expected.attitude.utc_s)
        assert flight.name == name


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (
            {"a.csv": "utc,roll_deg\n", "b.csv": "utc,roll_deg\n"},
            r"holds 2 logs \(a.csv, b.csv\); name one, such as logs.zip::a.csv",
        ),
        (
            {"a/flight.csv": "utc,roll_deg\n", "b/flight.csv": "utc,roll_deg\n"},
            r"holds 2 logs \(a/flight.csv, b/flight.csv\); name one, such as logs.zip::a/flight.csv",
        ),
        ({"a.png": b"\x89PNG\r\n\x1a\n"}, "is a zip archive without a log"),
        ({"a.csv": "utc,roll_deg\n1,2\n"}, r"a.csv: line 1: .*no column pitch_deg"),
    ],
)
def test_an_archive_without_exactly_one_log_is_refused(
    tmp_path: Path, members: dict[str, str | bytes], message: str
) -> None:
    with zipfile.ZipFile(tmp_path / "logs.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)

    with pytest.raises(LogFormatError, match=message) as caught:
        open_flight(tmp_path / "logs.zip")

    assert str(caught.value).startswith(f"{tmp_path / 'logs.zip'}: ")


@pytest.mark.parametrize(("folder", "expected_deg"), [("a", 50.0), ("b", 200.0), ("../b", 200.0), ("c\\d", 200.0)])
def test_a_member_of_an_archive_is_opened(tmp_path: Path, folder: str, expected_deg: float) -> None:
    header = "utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg\n"
    rows = "2024-03-10T11:00:00Z,1,2,{0},-34,138\n2024-03-10T11:00:01Z,1,2,{0},-34,138\n"
    with zipfile.ZipFile(tmp_path / "card.zip", "w") as archive:
        archive.writestr("a/flight.csv" if folder != "a" else "b/flight.csv", header + rows.format(250 - expected_deg))
        archive.writestr(f"{folder}/flight.csv", header + rows.format(expected_deg))

    flight = open_flight(f"{tmp_path / 'card.zip'}::{folder}/flight.csv")

    found_deg = np.rad2deg(euler_from_quaternion(flight.attitude.q_body_ned)[2]) % 360
    np.testing.assert_allclose(found_deg, expected_deg, rtol=0, atol=1e-9)
    with pytest.raises(LogFormatError, match=r"the archive has several logs of that name; it holds .*/flight\.csv"):
        open_flight(f"{tmp_path / 'card.zip'}::flight.csv")
    with pytest.raises(LogFormatError, match=r"the archive has no logs of that name; it holds .*/flight\.csv"):
        open_flight(f"{tmp_path / 'card.zip'}::c/other.csv")


def test_an_archive_with_a_damaged_name_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "flight.zip", "w") as archive:
        archive.writestr("flüge.csv", "utc,roll_deg\n")
    # The name in the directory of the archive: its UTF-8 is cut in two.
    content = (tmp_path / "flight.zip").read_bytes()
    at = content.rindex("ü".encode())
    (tmp_path / "flight.zip").write_bytes(content[:at] + b"\xff" + content[at + 1 :])
    with pytest.raises(LogFormatError, match="cannot be unpacked"):
        open_flight(tmp_path / "flight.zip")


def test_a_time_that_no_flight_reaches_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text("t,roll,pitch,yaw\n0,1,2,3\n1e305,1,2,3\n", encoding="utf-8")
    with pytest.raises(LogFormatError, match=r"line 3.*is no time since a start"):
        open_flight(path, columns="time=t,time_epoch=start,roll=roll,pitch=pitch,yaw=yaw")


def test_a_damaged_gzip_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "flight.csv.gz").write_bytes(gzip.compress(b"utc,roll_deg" * 100)[:-30])

    with pytest.raises(LogFormatError, match="cannot be unpacked"):
        open_flight(tmp_path / "flight.csv.gz")


# --- maps and tables that are wrong -----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("airdta", "there is no column map 'airdta' .did you mean airdata?."),
        ("time=t,rol=r", "'rol' is no key of a column map .did you mean roll?."),
        ("time=t,roll=r", "roll, pitch and yaw belong together"),
        ("roll=r,pitch=p,yaw=y", "a column map needs time or utc"),
        ("time=t,time_unit=min,roll=r,pitch=p,yaw=y", "time_unit must be one of s, ms, us, ns, not 'min'"),
        ("time=t,quaternion=a|b|c", "quaternion must be the four columns w, x, y, z"),
        ("time=t,time_epoch=week,roll=r,pitch=p,yaw=y", "gps_week belong together"),
        ("time=t,roll=r,pitch=p,yaw=y,quaternion=a|b|c|d", "attitude twice"),
        ("nothing.toml", "nothing.toml: there is no such file"),
    ],
)
def test_a_wrong_map_is_refused_in_one_line(words: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        column_map(words)


def test_a_scale_of_hundreds_of_digits_is_no_positive_number(tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(f'time = "t"\nquaternion = ["a", "b", "c", "d"]\nquaternion_scale = {10**400}\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="quaternion_scale must be a positive number"):
        column_map(str(path))


@pytest.mark.parametrize(
    ("text", "words", "message"),
    [
        ("t,r,p,y\n1710068400,2,3,x\n", "", r"line 2, column y: 'x' is not a number"),
        ("t,r,p,y\n1,2,3,4\n", "", r"line 2, column t: 1 s since 1970 is no UTC of a flight; check time_unit"),
        ("t,r,p\n1,2,3\n", "", "has no column y"),
        ("t,r,p,yaw\n1,2,3,4\n", ",yaw=yow", r"has no column yow \(is it named 'yaw'\?\)"),
        ("t,r,p,y\n1,2,3\n1,2,3,4\n", "", "line 2: 3 fields, where the header names 4"),
    ],
)
def test_a_wrong_table_is_refused_with_line_and_column(tmp_path: Path, text: str, words: str, message: str) -> None:
    (tmp_path / "x.csv").write_text(text)

    with pytest.raises(LogFormatError, match=message):
        open_flight(tmp_path / "x.csv", site=HOME, columns=f"time=t,roll=r,pitch=p{words or ',yaw=y'}")


def test_columns_are_refused_for_a_log_that_is_no_table(log: Path) -> None:
    with pytest.raises(LogFormatError, match=r"is no table but of the format ArduPilot DataFlash; leave out columns"):
        open_flight(log, columns="airdata")


def test_each_ready_map_is_recognised_by_its_own_columns_only() -> None:
    for name, one in ready_maps().items():
        others = [other for other, two in ready_maps().items() if other != name and set(two.sign) <= set(one.sign)]
        assert not others, (name, others)
