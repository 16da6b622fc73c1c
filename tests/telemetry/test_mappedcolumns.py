"""Column maps and glstar's own columns: what is read of columns in memory, and lines of small CSV files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.arrays import Float
from glstar.errors import ConfigError, LogFormatError
from glstar.telemetry import source
from glstar.telemetry.tables import mapped, native
from glstar.telemetry.tables.files import TableFile, TableKind
from glstar.telemetry.tables.mapped import (
    ColumnMap,
    MappedTableReader,
    column_map,
    q_body_ned_of,
    ready_map,
    ready_maps,
)
from glstar.telemetry.tables.native import TableReader
from glstar.telemetry.tables.tableclock import ClockFit

nan = np.nan
UTC_S = 1710068400.0  # 2024-03-10 11:00:00
GPS_S, WEEK, SECOND_S = UTC_S - 315964800 + 18, 2305.0, 39618.0
SIZE = 40
PAST_S = 0.1 * np.arange(SIZE)

Batches = dict[type, list[source.Samples]]


@pytest.fixture(autouse=True)
def in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read the tables of `reader`, not files."""
    monkeypatch.setattr(mapped, "read_table", lambda *_: TABLES[-1])


TABLES: list[TableFile] = []


def reader(
    words: str | ColumnMap | None, *, kind: TableKind = TableKind.PARQUET, boot: int | None = None, **columns: object
) -> MappedTableReader:
    spread = {
        name: of if isinstance(of, (list, tuple)) else np.broadcast_to(of, SIZE) * 1.0 for name, of in columns.items()
    }
    TABLES.append(TableFile("a.csv", kind, spread, 10 + np.arange(SIZE), tuple(spread)))
    return MappedTableReader("a.csv", boot=boot, columns=column_map(words) if isinstance(words, str) else words)


def batches(words: str | ColumnMap | None, **columns: object) -> Batches:
    found: Batches = {}
    for batch in reader(words, **columns).samples():
        found.setdefault(type(batch), []).append(batch)
    return found


def refusal(act: object, *arguments: object, **more: object) -> str:
    with pytest.raises((LogFormatError, ConfigError)) as caught:
        act(*arguments, **more)
    return str(caught.value)


def agree(q_body_ned: Float, rotation: Rotation) -> bool:
    """Return whether NED to body quaternions are those of rotations from body to NED."""
    q = rotation.inv().as_quat()[:, [3, 0, 1, 2]]
    return bool(np.allclose(np.abs(np.sum(q_body_ned * q, axis=-1)), 1.0, rtol=0, atol=1e-9))


ANGLES = {"r": 11.0, "p": -23.0, "y": 30 + np.arange(SIZE)}
NED_FRD = Rotation.from_euler(
    "ZYX", np.column_stack([30.0 + np.arange(SIZE), [-23.0] * SIZE, [11.0] * SIZE]), degrees=True
)
EULER = "roll=r,pitch=p,yaw=y"


# --- maps -----------------------------------------------------------------------------------------------------------
def test_a_map_is_of_words_with_alternatives() -> None:
    found = column_map("time= t | u ,time_unit=ms,time_epoch=start,roll=r,pitch=-p,yaw=y,quaternion_scale=2.5,title=x")
    assert found == ColumnMap(
        title="x",
        time=("t", "u"),
        time_unit="ms",
        time_epoch="start",
        roll=("r",),
        pitch=("-p",),
        yaw=("y",),
        quaternion_scale=2.5,
    )
    assert found.found(("a", "-b", "c"), {"b", "c"}) == "-b"
    assert found.found(("-b",), {"-b"}) == "-b"
    assert found.found(("a",), {"b"}) is None
    assert column_map("tum") is ready_maps()["tum"]
    assert mapped.is_map_file("a.TOML")
    assert not mapped.is_map_file("time=a.toml")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("tim=t", "columns: 'tim' is no key of a column map (did you mean time?)"),
        ("time=t,time_unit=h", "columns: time_unit must be one of s, ms, us, ns, not 'h'"),
        ("roll=r,pitch=p,yaw=y", "columns: a column map needs time or utc"),
        ("time=t,time_epoch=week", 'columns: time_epoch = "week" and gps_week belong together'),
        ("time=t,gps_week=w", 'columns: time_epoch = "week" and gps_week belong together'),
        ("time=t,roll=r,pitch=p", "columns: roll, pitch and yaw belong together"),
        (
            "time=t,roll=r,pitch=p,yaw=y,quaternion=a|b|c|d",
            "columns: attitude twice; give roll, pitch and yaw, or quaternion",
        ),
        (
            "time=t,quaternion_xyz=b|c|d,quaternion=a|b|c|d",
            "columns: attitude twice; give roll, pitch and yaw, or quaternion",
        ),
        ("time=t,quaternion=a|b|c", "columns: quaternion must be the four columns w, x, y, z"),
        ("time=t,quaternion_xyz=a|b", "columns: quaternion_xyz must be the three columns x, y, z"),
        ("time=t,latitude=a", "columns: latitude and longitude belong together"),
        ("time=t,roll_rate=a,pitch_rate=b", "columns: roll_rate, pitch_rate and yaw_rate belong together"),
        ("time=t,quaternion_scale=0", "columns: quaternion_scale must be a positive number, not '0'"),
        ("time=t,quaternion_scale=x", "columns: quaternion_scale must be a positive number, not 'x'"),
        ("time=t,quaternion_scale=1e12", "columns: quaternion_scale must be a positive number, not '1e12'"),
        ("time=", "columns: time must be the name of a column, or a list of names, not ''"),
        ("time=a||b", "columns: time must be the name of a column, or a list of names, not ['a', '', 'b']"),
    ],
)
def test_a_wrong_map_is_refused(words: str, message: str) -> None:
    assert refusal(column_map, words) == message


def test_an_unknown_map_is_refused_with_the_known_ones() -> None:
    said = refusal(column_map, "tumm")
    assert said.startswith("columns: there is no column map 'tumm' (did you mean tum?); give one of ")
    assert said.endswith(", a .toml file, or key=column,key=column")
    assert ColumnMap.of({"time": "t", "quaternion_scale": 9e11}, "x").quaternion_scale == 9e11
    assert ready_map({"nothing"}) is None
    one = next(of for of in ready_maps().values() if of.sign)
    assert ready_map({*one.sign, "more"}) == one


# --- attitudes ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("world", ["NED", "ENU", "NWU"])
@pytest.mark.parametrize("body", ["FRD", "FLU"])
@pytest.mark.parametrize("rotates", ["body_to_world", "world_to_body"])
def test_quaternions_between_any_frames(world: str, body: str, rotates: str) -> None:
    of_world = {"NED": np.eye(3), "ENU": [[0, 1, 0], [1, 0, 0], [0, 0, -1]], "NWU": np.diag([1.0, -1, -1])}[world]
    to_world = (
        Rotation.from_matrix(of_world)
        * NED_FRD
        * Rotation.from_matrix(np.diag([1.0, -1, -1]) if body == "FLU" else np.eye(3))
    )
    turned = to_world if rotates == "body_to_world" else to_world.inv()
    assert agree(q_body_ned_of(turned.as_quat()[:, [3, 0, 1, 2]], world, body, rotates), NED_FRD)


@pytest.mark.parametrize(("unit", "scale"), [("deg", 1.0), ("rad", np.pi / 180), ("decideg", 10.0)])
def test_angles_have_a_unit(unit: str, scale: float) -> None:
    columns = {name: angle * scale for name, angle in ANGLES.items()}
    columns["r"] = np.where(np.arange(SIZE) == 3, nan, columns["r"])
    found = batches(f"time=t,{EULER},angle_unit={unit}", t=UTC_S + PAST_S, **columns)
    [samples] = found[source.AttitudeSamples]
    used = np.delete(np.arange(SIZE), 3)
    np.testing.assert_array_equal(samples.clock_s, (UTC_S + PAST_S)[used])
    assert agree(samples.q_body_ned, NED_FRD[used])
    assert (samples.source, samples.notes, set(samples.segment.tolist())) == ("table", (), {0})
    [clock] = found[source.ClockSamples]
    np.testing.assert_array_equal(clock.clock_s, UTC_S + PAST_S)
    np.testing.assert_array_equal(clock.utc_s, UTC_S + PAST_S)
    reversed_ = batches(
        f"time=t,roll=r,pitch=-p,yaw=y,angle_unit={unit}", t=UTC_S + PAST_S, **columns | {"p": -columns["p"]}
    )
    assert agree(reversed_[source.AttitudeSamples][0].q_body_ned, NED_FRD[used])


def components(scale: float = 1.0) -> dict[str, Float]:
    return {name: NED_FRD.as_quat()[:, k] * scale for name, k in (("a", 3), ("b", 0), ("c", 1), ("d", 2))}


@pytest.mark.parametrize(
    ("scale", "is_read"), [(1.0, True), (1.019, True), (1.021, False), (0.979, False), (0.981, True)]
)
def test_quaternions_have_a_scale_and_nearly_unit_length(scale: float, is_read: bool) -> None:
    words = "time=t,quaternion=a|b|c|d,quaternion_scale=32767"
    columns = components(32767.0)
    for name in columns:
        columns[name][4] *= scale
        columns[name][9] = 0.0
        columns[name][11] = nan
    if not is_read:
        cell = columns["a"][4]
        said = f"a.csv: line 14, column a: {cell} begins a quaternion that is not of unit length"
        assert refusal(batches, words, t=UTC_S + PAST_S, **columns) == said
        return
    [samples] = batches(words, t=UTC_S + PAST_S, **columns)[source.AttitudeSamples]
    assert agree(samples.q_body_ned, NED_FRD[np.delete(np.arange(SIZE), [9, 11])])
    np.testing.assert_allclose(np.linalg.norm(samples.q_body_ned, axis=-1), 1.0, rtol=0, atol=1e-12)


def test_a_quaternion_of_three_components_has_a_positive_fourth() -> None:
    words = "time=t,quaternion_xyz=b|c|d,quaternion_scale=2.0"
    columns = {name: of * 2.0 for name, of in components().items() if name != "a"}
    assert (NED_FRD.as_quat()[:, 3] > 0).all()
    assert agree(batches(words, t=UTC_S + PAST_S, **columns)[source.AttitudeSamples][0].q_body_ned, NED_FRD)
    for squared, is_read in ((1.019, True), (1.021, False)):
        half_turn = {"b": 2 * np.sqrt(squared), "c": 0.0, "d": 0.0}
        if is_read:
            q = batches(words, t=UTC_S + PAST_S, **half_turn)[source.AttitudeSamples][0].q_body_ned
            np.testing.assert_allclose(np.abs(q), np.tile([0.0, 1.0, 0.0, 0.0], (SIZE, 1)), rtol=0, atol=1e-9)
        else:
            said = f"a.csv: line 10, column b: {half_turn['b']} begins a quaternion longer than 1"
            assert refusal(batches, words, t=UTC_S + PAST_S, **half_turn) == said


def test_missing_columns_are_named_with_similar_ones() -> None:
    t = UTC_S + PAST_S
    assert refusal(reader, f"time=t,{EULER}", t=t, r=1, p=1, yy=1) == "a.csv: has no column y (is it named 'yy'?)"
    assert refusal(reader, f"time=u|v,{EULER}", t=t, **ANGLES) == "a.csv: has no column u or v"
    assert refusal(reader, f"utc=u,{EULER}", t=t, **ANGLES) == "a.csv: has no column u"
    assert (
        refusal(reader, "time=t", t=t)
        == "a.csv: has no attitude by this column map; name roll, pitch, yaw or quaternion"
    )
    assert refusal(reader, "time=t,quaternion=a|b|c|d", t=t, a=1, b=1, d=1).startswith("a.csv: has no column c")
    assert refusal(reader, f"time=t,time_epoch=week,gps_week=w,{EULER}", t=t, **ANGLES) == "a.csv: has no column w"
    names = {f"c{k}": 1.0 for k in range(8)}
    hint = "say with --columns what they mean (glstar manual logs)"
    assert refusal(reader, None, **names) == f"a.csv: is a table with columns c0, c1, c2, c3, c4, c5, ...; {hint}"
    own = reader(None, utc_s=t, qw=1.0, qx=0.0, qy=0.0, qz=0.0)
    assert (own._map.quaternion, own._map.rotates) == (("qw", "qx", "qy", "qz"), "world_to_body")
    assert reader(None, utc_s=t, roll_deg=1.0, pitch_deg=2.0, yaw_deg=3.0)._map.roll == ("roll_deg",)


def test_the_format_says_the_kind_of_the_file() -> None:
    own = {"t": list(map(str, UTC_S + PAST_S)), "r": ["1"] * SIZE, "p": ["1"] * SIZE, "y": ["1"] * SIZE}
    assert reader(f"time=t,{EULER}", kind=TableKind.CSV, **own).facts().format == "table"
    assert reader(f"time=t,{EULER},title=abc", t=UTC_S + PAST_S, **ANGLES).facts().format == "abc (Parquet)"
    assert reader(f"time=t,{EULER}", t=UTC_S + PAST_S, **ANGLES).one_clock
    assert not reader(f"time=t,time_epoch=start,{EULER}", t=PAST_S, **ANGLES).one_clock


# --- positions and rates --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("unit", "scale"), [("deg", 1.0), ("rad", np.pi / 180), ("1e-7deg", 1e7)])
def test_positions_have_a_unit(unit: str, scale: float) -> None:
    words = f"time=t,{EULER},latitude=la,longitude=lo,place_unit={unit},height=h"
    place = {"la": -34.5 * scale, "lo": np.where(np.arange(SIZE) < 20, 138.5, 221.5) * scale}
    place["h"] = np.where(np.arange(SIZE) == 2, nan, 50.5)
    [samples] = batches(words, t=UTC_S + PAST_S, **ANGLES, **place)[source.PositionSamples]
    np.testing.assert_allclose(np.rad2deg(samples.latitude_rad), -34.5, rtol=1e-12)
    np.testing.assert_allclose(np.rad2deg(samples.longitude_rad), [138.5] * 20 + [-138.5] * 20, rtol=1e-9)
    assert samples.height_m.tolist() == [0.0 if k == 2 else 50.5 for k in range(SIZE)]
    assert samples.source == "table"


@pytest.mark.parametrize(
    ("words", "height_m"),
    [("height=h,height_ft=f", 50.0), ("height=z,height_ft=f", 30.48), ("height_dm=h", 5.0), ("height=z", 0.0)],
)
def test_heights_are_in_metres_feet_or_tenths(words: str, height_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MappedTableReader, "_is_old_blackbox", False)
    columns = {"t": UTC_S + PAST_S, **ANGLES, "la": -34.5, "lo": 138.5, "h": 50.0, "f": 100.0}
    found = batches(f"time=t,{EULER},latitude=la,longitude=lo,{words}", **columns)
    np.testing.assert_allclose(found[source.PositionSamples][0].height_m, height_m, rtol=1e-12)
    taken = ("h has no unit and is taken in tenths of a metre",) if "dm" in words else ()
    assert found[source.AttitudeSamples][0].notes == taken
    monkeypatch.setattr(MappedTableReader, "_is_old_blackbox", True)
    found = batches(f"time=t,{EULER},latitude=la,longitude=lo,{words}", **columns)
    assert found[source.PositionSamples][0].height_m[0] == pytest.approx(50.0 if "dm" in words else height_m)


def test_why_a_table_has_no_position() -> None:
    columns = {"t": UTC_S + PAST_S, **ANGLES}
    [none] = batches(f"time=t,{EULER}", **columns)[source.PositionSamples]
    assert none.source == "it has no columns with latitude and longitude"
    for la, lo in ((0.0, 0.0), (nan, 138.5)):
        [none] = batches(f"time=t,{EULER},latitude=la,longitude=lo", **columns, la=la, lo=lo)[source.PositionSamples]
        assert (none.source, none.clock_s.size) == ("latitude and longitude are empty or 0", 0)


@pytest.mark.parametrize("body", ["FRD", "FLU"])
@pytest.mark.parametrize(("unit", "scale"), [("deg", 180 / np.pi), ("rad", 1.0)])
def test_rates_are_about_forward_right_down(body: str, unit: str, scale: float) -> None:
    words = f"time=t,{EULER},roll_rate=u,pitch_rate=v,yaw_rate=w,rate_unit={unit},body={body}"
    rates = {"u": 0.5 * scale, "v": np.where(np.arange(SIZE) == 4, nan, 0.6) * scale, "w": -0.7 * scale}
    rates["u"] = np.where(np.arange(SIZE) == 6, 5100 * scale, rates["u"])
    [samples] = batches(words, t=UTC_S + PAST_S, **ANGLES, **rates)[source.RateSamples]
    used = np.delete(np.arange(SIZE), [4, 6])
    np.testing.assert_array_equal(samples.clock_s, (UTC_S + PAST_S)[used])
    side = -1.0 if body == "FLU" else 1.0
    np.testing.assert_allclose(
        samples.rate_rad_per_s, np.tile([0.5, 0.6 * side, -0.7 * side], (SIZE - 2, 1)), rtol=1e-12
    )
    assert source.RateSamples not in batches(words, t=UTC_S + PAST_S, **ANGLES, u=1.0, v=1.0)


# --- times ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_have_a_unit_and_an_epoch(unit: str, scale: float) -> None:
    for words, columns in (
        ("time=t", {"t": UTC_S + PAST_S}),
        ("time=t,time_epoch=gps", {"t": GPS_S + PAST_S}),
        ("time=t,time_epoch=week,gps_week=w", {"t": SECOND_S + PAST_S, "w": WEEK}),
    ):
        scaled = columns | {"t": columns["t"] * scale}
        [samples] = batches(f"{words},time_unit={unit},{EULER}", **scaled, **ANGLES)[source.AttitudeSamples]
        np.testing.assert_allclose(samples.clock_s, UTC_S + PAST_S, rtol=0, atol=2e-6)


def test_times_before_the_fix_of_a_receiver_are_left_out() -> None:
    week = np.where(np.arange(SIZE) < 7, 0.0, WEEK)
    words = f"time=t,time_epoch=week,gps_week=w,{EULER}"
    found = batches(words, t=SECOND_S + PAST_S, w=week, **ANGLES)
    np.testing.assert_allclose(found[source.AttitudeSamples][0].clock_s, UTC_S + PAST_S[7:], rtol=0, atol=1e-6)
    [clock] = batches(words, t=SECOND_S + PAST_S, w=257.0, **ANGLES)[source.ClockSamples]
    assert (clock.source, clock.utc_s.size) == ("its GPS time says 1984: the receiver's week has rolled over", 0)


def test_times_of_no_flight_are_refused() -> None:
    late = np.where(np.arange(SIZE) == 3, 4.2e9, UTC_S + PAST_S)
    said = "a.csv: line 13, column t: 4.2e+09 s since 1970 is no UTC of a flight; check time_unit and time_epoch"
    assert refusal(batches, f"time=t,{EULER}", t=late, **ANGLES) == said
    assert refusal(batches, f"time=t,{EULER}", t=-1e6 + PAST_S, **ANGLES).startswith(
        "a.csv: line 10, column t: -1e+06 s"
    )
    cell = np.where(np.arange(SIZE) == 3, 5e9, PAST_S)
    said = "a.csv: line 13, column t: 5000000000.0 is no time since a start; check time_unit and time_epoch"
    assert refusal(batches, f"time=t,time_epoch=start,{EULER}", t=cell, **ANGLES) == said
    early = batches(f"time=t,{EULER}", t=1.4e9 + PAST_S, **ANGLES)[source.AttitudeSamples][0]
    assert any("time_epoch=gps" in note for note in early.notes)


def test_rows_that_repeat_a_time_and_impossible_ones_are_left_out() -> None:
    t = UTC_S + np.arange(SIZE) // 4 * 1.0
    t[21] += 5000
    [samples] = batches(f"time=t,{EULER}", t=t, **ANGLES)[source.AttitudeSamples]
    assert samples.notes == ("1 row has an impossible time and is left out",)
    assert agree(samples.q_body_ned, NED_FRD[[4, 8, 12, 16, 20, 24, 28, 32, 36]])


UTC_TEXT = [f"2024-03-10T11:00:{k // 10:02d}.{k % 10}Z" for k in range(SIZE)]


def test_a_clock_of_its_own_is_converted_by_a_column_with_utc() -> None:
    words = f"time=t,time_epoch=start,utc=u,{EULER}"
    found = batches(words, t=70 + PAST_S, u=UTC_TEXT, **ANGLES)
    [clock] = found[source.ClockSamples]
    np.testing.assert_allclose(clock.utc_s - clock.clock_s, UTC_S - 70, rtol=0, atol=1e-6)
    assert clock.utc_minus_clock_s == pytest.approx(UTC_S - 70, abs=1e-6)
    assert (clock.source, clock.cut) == ("table, u", 0)
    assert found[source.AttitudeSamples][0].notes == ()
    odd = [*UTC_TEXT[:5], "2024-03-10T12:00:00Z", *UTC_TEXT[6:]]
    found = batches(words, t=70 + PAST_S, u=odd, **ANGLES)
    assert found[source.ClockSamples][0].cut == 1
    assert (
        found[source.AttitudeSamples][0]
        .notes[0]
        .startswith("1 of its 40 cells of UTC disagrees with its clock by up to")
    )
    none = batches(f"time=t,time_epoch=start,{EULER}", t=70 + PAST_S, **ANGLES)[source.ClockSamples][0]
    assert none.source == "its time counts from its own start, and it has no column with UTC"
    whole = [f"2024-03-10T11:00:{k // 10:02d}Z" for k in range(SIZE)]
    notes = batches(words, t=70 + PAST_S, u=whole, **ANGLES)[source.AttitudeSamples][0].notes
    assert notes == ("its UTC has whole seconds: the time of an attitude is uncertain by one sample interval",)
    split = batches(f"utc=u,utc_date=d,{EULER}", u=[of[11:] for of in UTC_TEXT], d=["2024-03-10"] * SIZE, **ANGLES)
    np.testing.assert_allclose(split[source.AttitudeSamples][0].clock_s, UTC_S + PAST_S, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("rate", "note"),
    [
        (4.8e-5, ()),
        (5.2e-5, ("its clock gains -52 millionths on its UTC, which the times follow",)),
        (-5.2e-5, ("its clock gains 52 millionths on its UTC, which the times follow",)),
    ],
)
def test_a_clock_that_gains_on_its_utc_is_reported(rate: float, note: tuple[str, ...]) -> None:
    opened = reader(f"time=t,time_epoch=start,utc=u,{EULER}", t=70 + PAST_S, u=UTC_TEXT, **ANGLES)
    rows_used, cut = np.array([3, 7]), np.empty(0, dtype=np.int64)
    fit = ClockFit(rate, 71.0, 900.0, 40, rows_used, np.array([5.25, 6.25]), cut, 0.0)
    opened.__dict__["_fits"] = {1: fit}
    clock_s, clock, notes = opened._own_clock(source.Boot(1))
    np.testing.assert_allclose(clock_s, 70 + PAST_S + rate * (PAST_S - 1), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(clock.clock_s, clock_s[rows_used])
    assert (clock.utc_s.tolist(), clock.utc_minus_clock_s, notes) == ([5.25, 6.25], 900.0, note)


# --- glstar's own columns -------------------------------------------------------------------------------------------
def own(path: Path, text: str, **options: object) -> Batches:
    path.write_text(text)
    found: Batches = {}
    for batch in TableReader(path, **options).samples():
        found.setdefault(type(batch), []).append(batch)
    return found


HEADER = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"


def rows(*past_s: float, more: str = "") -> str:
    return "".join(f"{UTC_S + past:.2f},11,-23,{30 + past},-34.5,138.5{more}\n" for past in past_s)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "own.csv"


def test_glstars_own_columns(path: Path) -> None:
    header = f"{HEADER},height_m,roll_rate_deg_per_s,pitch_rate_deg_per_s,yaw_rate_deg_per_s,note\n"
    text = header + rows(0, 1, 2, more=",50.5,10,20,-30,x") + f"{UTC_S + 3},,,,,,,,,,y\n"
    found = own(path, text)
    [attitudes], [positions], [clock], [rates] = found.values()
    np.testing.assert_array_equal(attitudes.clock_s, UTC_S + np.arange(3))
    angles = np.column_stack([30.0 + np.arange(3), [-23.0] * 3, [11.0] * 3])
    assert agree(attitudes.q_body_ned, Rotation.from_euler("ZYX", angles, degrees=True))
    np.testing.assert_allclose(np.rad2deg(positions.latitude_rad), [-34.5] * 3, rtol=1e-12)
    np.testing.assert_allclose(np.rad2deg(positions.longitude_rad), [138.5] * 3, rtol=1e-12)
    assert positions.height_m.tolist() == [50.5] * 3
    np.testing.assert_array_equal(clock.utc_s, UTC_S + np.arange(4))
    np.testing.assert_allclose(np.rad2deg(rates.rate_rad_per_s), [[10, 20, -30]] * 3, rtol=1e-12)
    assert {samples.source for samples in (attitudes, positions, clock, rates)} == {"table"}
    quaternions = "utc_s,qw,qx,qy,qz\n" + f"{UTC_S},0.5,-0.5,0.5,0.5\n{UTC_S + 1},0.6,0,0.8,0\n"
    q = own(path, quaternions)[source.AttitudeSamples][0].q_body_ned
    np.testing.assert_array_equal(q, [[0.5, -0.5, 0.5, 0.5], [0.6, 0.0, 0.8, 0.0]])
    assert own(path, quaternions)[source.PositionSamples][0].source == "no columns latitude_deg, longitude_deg"
    zeros = f"{HEADER}\n{UTC_S},1,2,3,0,0\n{UTC_S + 1},1,2,3,,\n"
    empty = "latitude_deg and longitude_deg are empty, or 0 as without a GPS fix"
    assert own(path, zeros)[source.PositionSamples][0].source == empty


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("utc,roll_deg,pitch_deg\n", "line 1: no column yaw_deg"),
        ("utc,roll_deg,pitch_deg,yaw\n", "line 1: no column yaw_deg (is it named 'yaw'?)"),
        ("utc,qw,qx\n", "line 1: no column qy"),
        ("utc,roll_deg,qw,qx,qy\n", "line 1: no column qz"),
        ("utc,roll_deg,pitch_deg,qw\n", "line 1: no column yaw_deg"),
        ("# c\nutc,utc\n", "line 2: column utc appears twice"),
        ("roll_deg,utcs\n", "line 1: no column utc (ISO 8601) or utc_s (is it named 'utcs'?); it has roll_deg, utcs"),
        ("utc,x\n", "line 1: no attitude: neither roll_deg, pitch_deg, yaw_deg nor qw, qx, qy, qz; it has utc, x"),
        (
            "utc,roll_deg,pitch_deg,yaw_deg,qw,qx,qy,qz\n",
            "line 1: attitude twice, as roll_deg, pitch_deg, yaw_deg and as qw, qx, qy, qz; leave one out",
        ),
        ("utc,roll_deg,pitch_deg,yaw_deg,latitude_deg\n", "line 1: no column longitude_deg"),
        ("utc,roll_deg,pitch_deg,yaw_deg,yaw_rate_deg_per_s\n", "line 1: no column roll_rate_deg_per_s"),
        ("x\n", "line 1: no table of a flight: its header would name utc or utc_s, ...; this line has x"),
        (
            "x,\n",
            "line 1: no table of a flight: its header would name utc or utc_s, ...; this line has x, (nameless);"
            " say with --columns what they mean (glstar manual logs)",
        ),
        ("1,2\n", "line 1: no header but 2 numbers; say what they mean with --columns (glstar manual logs)"),
        (
            "1,2,3,4,5,6,7,8\n",
            "line 1: no header but 8 numbers; say what they mean: --columns tum, if it is a TUM trajectory"
            " (glstar manual logs)",
        ),
        ("# c\n", "has only blank lines and comments"),
        (f"{HEADER}\n{UTC_S},1,2\n{UTC_S},1,2,3,4,5\n", "line 2: 3 fields, where the header names 6"),
        (f"{HEADER}\n{UTC_S},1,2,3,4,5,6\n", "line 2: 7 fields, where the header names 6"),
        (
            f"{HEADER}\n63071999,1,2,3,4,5\n",
            "line 2, column utc_s: 63071999 is no UTC between 1972 and 2100, in seconds since 1970",
        ),
        (
            f"{HEADER}\n4102444800,1,2,3,4,5\n",
            "line 2, column utc_s: 4102444800 is no UTC between 1972 and 2100, in seconds since 1970",
        ),
        (f"{HEADER}\n{UTC_S},1,2,inf,4,5\n", "line 2, column yaw_deg: inf is no angle"),
        (f"{HEADER}\n{UTC_S},1,2,x,4,5\n", "line 2, column yaw_deg: 'x' is not a number"),
        (f"{HEADER};\n{UTC_S},1\n".replace(",", ";"), "line 2: 2 fields, where the header names 7"),
        (f"{HEADER}\n{UTC_S},1,2,3,91,5\n", "line 2, column latitude_deg: 91 is beyond a pole"),
        (f"{HEADER}\n{UTC_S},1,2,3,4,361\n", "line 2, column longitude_deg: 361 is more than a turn"),
        (
            f"utc_s,qw,qx,qy,qz\n{UTC_S},1.021,0,0,0\n",
            "line 2, column qw: 1.021 begins a quaternion that is not of unit length",
        ),
        (
            "utc,roll_deg,pitch_deg,yaw_deg\n2024-03-10T11:00:00Z,1,2,3\nnoon,1,2,3\n",
            "line 3, column utc: 'noon' is not an ISO 8601 time, such as 2024-03-10T11:00:00Z",
        ),
    ],
)
def test_a_wrong_table_is_refused_with_its_line(path: Path, text: str, message: str) -> None:
    if "2 fields, where the header names 7" in message:
        text += f"{UTC_S}\n"
    assert refusal(own, path, text) == f"{path}: {message}"


def test_numbers_within_their_limits_are_read(path: Path) -> None:
    edge = f"{HEADER}\n63072000,1,2,3,90,-360\n"
    assert own(path, edge)[source.PositionSamples][0].clock_s.tolist() == [63072000.0]
    assert own(path, f"utc_s,qw,qx,qy,qz\n{UTC_S},1.019,0,0,0\n")[source.AttitudeSamples][0].clock_s.size == 1
    cut = own(path, f"{HEADER}\n{rows(0, 1)}{UTC_S + 2},1")
    assert cut[source.AttitudeSamples][0].clock_s.size == 2
    comma = f"{HEADER}\n{UTC_S},1,2,3,4,5\n".replace(",", ";").replace(";3;", ";3,5;")
    message = "line 2, column yaw_deg: '3,5' is not a number; write decimals with a point"
    assert refusal(own, path, comma) == f"{path}: {message}"
    fast = f"{HEADER},roll_rate_deg_per_s,pitch_rate_deg_per_s,yaw_rate_deg_per_s\n"
    assert own(path, fast + rows(0, more=",4900,,"))[source.RateSamples][0].clock_s.size == 0
    said = "line 2, column roll_rate_deg_per_s: 5100 begins a turn faster than any gyro measures, 5000 deg/s"
    assert refusal(own, path, fast + rows(0, more=",5100,0,0")) == f"{path}: {said}"


def boots(path: Path, text: str) -> list[list[float]]:
    """Return the times of each boot, s after the start."""
    found = own(path, text)
    numbers = sorted({batch.boot for batch in found[source.AttitudeSamples]})
    return [
        [round(float(t - UTC_S), 2) for b in found[source.AttitudeSamples] if b.boot == number for t in b.clock_s]
        for number in numbers
    ]


def test_joined_tables_are_parts(path: Path) -> None:
    day = 86400.0
    many = [10.0 + 0.5 * k for k in range(6)]
    assert boots(path, f"{HEADER}\n{rows(*many)}") == [many]
    # A later part without overlap is of the same flight, and an earlier one too.
    assert boots(path, f"{HEADER}\n{rows(*many)}{HEADER}\n{rows(100, 101)}") == [[*many, 100, 101]]
    assert boots(path, f"{HEADER}\n{rows(*many)}{rows(2, 3, 4)}") == [[*many, 2, 3, 4]]
    # One that overlaps, or begins a day later, is another boot.
    assert boots(path, f"{HEADER}\n{rows(*many)}{rows(9, 9.5, 10)}") == [many, [9, 9.5, 10]]
    assert boots(path, f"{HEADER}\n{rows(*many)}{rows(12.5 + day - 1, 12.5 + day)}") == [
        [*many, 12.5 + day - 1, 12.5 + day]
    ]
    assert boots(path, f"{HEADER}\n{rows(*many)}{rows(12.5 + day + 1, 12.5 + day + 2)}") == [
        many,
        [12.5 + day + 1, 12.5 + day + 2],
    ]
    small = [10.0, 11.0, 12.0, 11.04, 13.0, 14.0]
    assert boots(path, f"{HEADER}\n{rows(*small)}") == [small]
    with pytest.raises(LogFormatError, match="the log has no boot 2"):
        own(path, f"{HEADER}\n{rows(*many)}", boot=2)
    assert set(own(path, f"{HEADER}\n{rows(*many)}{rows(9, 9.5, 10)}", boot=2)) >= {source.AttitudeSamples}


@pytest.mark.parametrize(("parts", "are_sorted"), [(20, True), (21, False)])
def test_many_parts_are_unsorted_rows(path: Path, parts: int, are_sorted: bool) -> None:
    text = "".join(rows(50.0, 51, 52, 53) + (f"{HEADER}\n" if k < parts - 1 else "") for k in range(parts))
    assert len(boots(path, f"{HEADER}\n{text}")) == (parts if are_sorted else 1)


def test_parts_are_numbered_by_overlap_and_distance() -> None:
    def part(first_s: float, last_s: float) -> native._Part:
        return native._Part(first_s=first_s, last_s=last_s)

    day = 86400.0
    assert native._numbered([part(10, 20), part(20, 30), part(21, 30), part(5, 9)]) == [1, 2, 1, 1]
    assert native._numbered([part(10, 20), part(20 + day, 30 + day), part(21 + day, 40 + day)]) == [1, 1, 2]
    assert native._numbered(
        [part(0, 5), part(9 * day, 9 * day + 5), part(day, day + 9), part(8 * day + 7, 9 * day - 1)]
    ) == [*(1, 2, 1, 2)]
