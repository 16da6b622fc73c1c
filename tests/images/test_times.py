"""The time of a real image, from its name, EXIF, a table or the truth of an export."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glstar.camera.exposure import Exposure
from glstar.errors import ImagesError
from glstar.images.times import (
    ImageTime,
    TimeReference,
    exposure_of,
    local_zone_s,
    read_exif,
    read_table,
    read_truth,
    time_notes,
    time_of,
    utc_from_name,
    with_common_grains,
    zone_hint,
    zone_note,
)
from glstar.sky.place.timescale import format_utc, parse_utc
from tests.support.exif import (
    DATE_TIME_ORIGINAL,
    EXPOSURE_TIME,
    GPS_DATE_STAMP,
    GPS_TIME_STAMP,
    OFFSET_TIME_ORIGINAL,
    SUB_SEC_TIME_ORIGINAL,
    Value,
    jpeg_with_exif,
)

NIGHT = np.full((12, 16), 7, np.uint8)
# 2019-07-29 20:47:26 UTC, by date(1): the two star tracker images of ESA.
ESA_UTC_S = 1564433246.0


def photo(path: Path, exif: dict[int, Value], gps: dict[int, Value] | None = None) -> Path:
    path.write_bytes(jpeg_with_exif(NIGHT, exif, gps))
    return path


@pytest.mark.parametrize(
    ("reference", "before_s"), [(TimeReference.START, 0.0), (TimeReference.MIDDLE, 1.0), (TimeReference.END, 2.0)]
)
def test_the_start_of_an_exposure_is_derived_from_its_middle_or_end(reference: TimeReference, before_s: float) -> None:
    """The real exposure of 2 s counts even if only half a second of it is simulated."""
    wanted, taken = Exposure(0.0, 0.5), ImageTime(ESA_UTC_S, "name", exposure_s=2.0)

    whole = exposure_of(taken, wanted, reference=reference)
    part = exposure_of(taken, wanted, reference=reference, own_length=False)

    assert (whole.start_utc_s, whole.duration_s) == (ESA_UTC_S - before_s, 2.0)
    assert (part.start_utc_s, part.duration_s) == (ESA_UTC_S - before_s, 0.5)


@pytest.mark.parametrize(
    ("name", "delay_s"),
    [
        ("2019-07-29T204726_Alt40_Azi135_Try1.tiff", 0.0),
        ("2019-07-29T204726_Alt60_Azi-45_Try1.tiff", 0.0),
        ("20190729_204726.png", 0.0),
        ("20190729_204726_123.png", 0.123),
        ("IMG_20190729_204726.jpg", 0.0),
        ("PXL_20190729_204726123.jpg", 0.123),
        ("DJI_20190729204726_0001_W.JPG", 0.0),
        ("2019-07-29T20:47:26.5Z.png", 0.5),
        ("2019-07-29T20:47:26.png", 0.0),
        ("2019-07-29 20.47.26.png", 0.0),
        ("2019-07-29_20-47-26.jpg", 0.0),
        ("2019-07-30T06:17:26+09:30.png", 0.0),
        ("20190729T154726.25-05:00.png", 0.25),
        ("night_20190729T204726Z.tif", 0.0),
        ("1564433246.png", 0.0),
        ("1564433246.5.png", 0.5),
        ("1564433246.25.png", 0.25),
        ("1564433246.25000.png", 0.25),
        ("frame_1564433246500.png", 0.5),
        ("1564433246250000.png", 0.25),
        ("1564433246250000000.png", 0.25),
    ],
)
def test_the_time_is_read_from_a_file_name(name: str, delay_s: float) -> None:
    assert utc_from_name(name) == pytest.approx(ESA_UTC_S + delay_s, abs=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        "frame_000123.png",
        "vega_05sec.jpg",
        "20191329_204726.png",
        "20190229_204726.png",
        "IMG_0001.jpg",
        "123456789.png",
        # A counter before 1990, and one from 2100 on.
        "631151999.png",
        "4102444800.png",
    ],
)
def test_a_name_without_a_time_gives_none(name: str) -> None:
    assert utc_from_name(name) is None


@given(st.integers(631152000000, 4102444799999))
def test_any_millisecond_between_1990_and_2100_is_recovered_from_a_name(milliseconds: int) -> None:
    utc_s = milliseconds / 1000
    compact = format_utc(utc_s).replace("-", "").replace(":", "").replace("T", "_")[:19].replace(".", "_")

    assert utc_from_name(f"{compact}.png") == pytest.approx(utc_s, abs=1e-4)
    assert utc_from_name(f"{format_utc(utc_s)}.png") == pytest.approx(utc_s, abs=1e-4)


def test_exif_with_a_zone_gives_utc_to_the_millisecond(tmp_path: Path) -> None:
    path = photo(
        tmp_path / "a.jpg",
        {
            DATE_TIME_ORIGINAL: "2019:07:30 06:17:26",
            SUB_SEC_TIME_ORIGINAL: "125",
            OFFSET_TIME_ORIGINAL: "+09:30",
            EXPOSURE_TIME: [(1, 8)],
        },
    )

    found = time_of(path)

    assert found is not None
    assert found.utc_s == pytest.approx(ESA_UTC_S + 0.125, abs=1e-6)
    assert (found.source, found.exposure_s) == ("EXIF, zone +09:30", 0.125)


def test_the_gps_time_determines_the_zone_of_the_exif_time(tmp_path: Path) -> None:
    # The fix is two seconds old, so it determines the zone but not the time.
    gps: dict[int, Value] = {GPS_DATE_STAMP: "2019:07:29", GPS_TIME_STAMP: [(20, 1), (47, 1), (24, 1)]}

    found = time_of(photo(tmp_path / "a.jpg", {DATE_TIME_ORIGINAL: "2019:07:30 06:17:26"}, gps))

    assert found is not None
    assert (found.utc_s, found.source) == (ESA_UTC_S, "EXIF, zone +9.5 h by its GPS time")


def test_a_gps_time_of_an_older_fix_determines_no_zone(tmp_path: Path) -> None:
    gps: dict[int, Value] = {GPS_DATE_STAMP: "2019:07:29", GPS_TIME_STAMP: [(20, 1), (40, 1), (0, 1)]}

    found = time_of(photo(tmp_path / "a.jpg", {DATE_TIME_ORIGINAL: "2019:07:29 20:47:26"}, gps))

    assert found is not None
    assert found.source == "EXIF without a zone, taken as UTC"


def test_a_time_in_the_name_takes_precedence_over_exif_without_a_zone(tmp_path: Path) -> None:
    exif: dict[int, Value] = {DATE_TIME_ORIGINAL: "2019:07:30 06:17:26", EXPOSURE_TIME: [(1, 2)]}

    found = time_of(photo(tmp_path / "20190729_204726.jpg", exif))

    assert found is not None
    assert (found.utc_s, found.source, found.exposure_s) == (ESA_UTC_S, "name", 0.5)


def test_fractional_seconds_take_precedence_when_name_and_exif_agree(tmp_path: Path) -> None:
    whole: dict[int, Value] = {DATE_TIME_ORIGINAL: "2019:07:29 20:47:26"}

    by_exif = time_of(photo(tmp_path / "20190729_204726.jpg", whole | {SUB_SEC_TIME_ORIGINAL: "75"}))
    by_name = time_of(photo(tmp_path / "20190729_204726_500.jpg", whole))

    assert by_exif is not None
    assert by_name is not None
    assert (by_exif.utc_s, by_name.utc_s) == (ESA_UTC_S + 0.75, ESA_UTC_S + 0.5)


@pytest.mark.parametrize(
    ("sub_seconds", "grain_s"),
    [(None, 1.0), ("00", 1.0), ("000", 1.0), ("5", 0.1), ("75", 0.01), ("750", 1e-3), ("x", 1.0)],
)
def test_exif_has_the_unit_of_its_sub_seconds(tmp_path: Path, sub_seconds: str | None, grain_s: float) -> None:
    exif = {DATE_TIME_ORIGINAL: "2019:07:29 20:47:26"} | ({SUB_SEC_TIME_ORIGINAL: sub_seconds} if sub_seconds else {})
    for zone in ({}, {OFFSET_TIME_ORIGINAL: "+00:00"}):
        found = time_of(photo(tmp_path / "a.jpg", exif | zone))
        assert found is not None
        assert found.grain_s == pytest.approx(grain_s)
        assert found.is_zoneless == (not zone)


@pytest.mark.parametrize(
    ("name", "grain_s", "is_zoneless"),
    [
        ("20190729_204726.png", 1.0, True),
        ("20190729_204726_123.png", 1e-3, True),
        ("2019-07-29T20:47:26.5Z.png", 0.1, False),
        ("2019-07-30T06:17:26+09:30.png", 1.0, False),
        ("1564433246.png", 1.0, False),
        ("1564433246.25.png", 0.01, False),
        ("1564433246500.png", 1e-3, False),
    ],
)
def test_names_have_the_unit_of_their_last_digit(tmp_path: Path, name: str, grain_s: float, is_zoneless: bool) -> None:
    (tmp_path / name).write_bytes(b"")
    found = time_of(tmp_path / name)
    assert found is not None
    assert (found.grain_s, found.is_zoneless) == (pytest.approx(grain_s), is_zoneless)


def test_a_source_has_the_finest_unit_of_its_times(tmp_path: Path) -> None:
    table = tmp_path / "images.csv"
    table.write_text("file,utc\na.png,2019-07-29T20:47:26Z\nb.png,2019-07-29T20:47:26.5Z\n", encoding="utf-8")
    times, _ = read_table(table)
    named = ImageTime(ESA_UTC_S, "name", grain_s=1.0)
    assert [time.grain_s for time in (times["a.png"], times["b.png"])] == [1.0, 0.1]
    assert [time.grain_s for time in with_common_grains([*times.values(), named])] == [0.1, 0.1, 1.0]


@pytest.mark.parametrize(("zone_s", "said"), [(34200.0, "+09:30"), (-12600.0, "-03:30"), (0.0, "+00:00")])
def test_the_hint_for_local_time_names_zone_and_option(zone_s: float, said: str) -> None:
    assert said in zone_hint(zone_s)
    assert f"--time-offset {zone_s:.0f}" in zone_hint(zone_s)


@pytest.mark.parametrize("date", ["0000:00:00 00:00:00", "    :  :     :  :  ", "2019:13:45 99:99:99", ""])
def test_a_camera_with_an_unset_clock_gives_no_time(tmp_path: Path, date: str) -> None:
    path = photo(tmp_path / "a.jpg", {DATE_TIME_ORIGINAL: date, EXPOSURE_TIME: [(1, 4)]})

    assert time_of(path) is None
    assert read_exif(path).exposure_s == 0.25


@pytest.mark.parametrize("ratio", [(0, 1), (1, 0)])
def test_an_invalid_exposure_time_is_not_reported(tmp_path: Path, ratio: tuple[int, int]) -> None:
    path = photo(tmp_path / "a.jpg", {DATE_TIME_ORIGINAL: "2019:07:29 20:47:26", EXPOSURE_TIME: [ratio]})

    found = time_of(path)

    assert found is not None
    assert (found.utc_s, found.exposure_s) == (ESA_UTC_S, None)


@settings(deadline=None)
@given(place=st.integers(2, 300), change=st.integers(0, 255))
def test_damaged_exif_raises_no_exception(tmp_path_factory: pytest.TempPathFactory, place: int, change: int) -> None:
    whole = bytearray(jpeg_with_exif(NIGHT, {DATE_TIME_ORIGINAL: "2019:07:29 20:47:26", EXPOSURE_TIME: [(1, 8)]}))
    whole[place] = change
    path = tmp_path_factory.mktemp("exif") / "a.jpg"
    path.write_bytes(whole)

    found = time_of(path)

    assert found is None or found.utc_s > 0


@pytest.mark.parametrize(("reference", "before_s"), [("start", 0.0), ("middle", 0.24), ("end", 0.48)])
def test_the_time_of_a_stacked_image_is_that_of_all_short_exposures(reference: str, before_s: float) -> None:
    stack = Exposure(0.0, 0.1, frames=3, gap_s=0.05, readout_s=0.08)
    taken = ImageTime(1e9, "EXIF", exposure_s=0.3)
    shutter = exposure_of(taken, stack, reference=TimeReference(reference))
    assert shutter.start_utc_s == pytest.approx(1e9 - before_s, rel=0, abs=1e-6)
    assert (shutter.frames, shutter.duration_s) == (3, 0.1)


def test_a_table_gives_files_their_times(tmp_path: Path) -> None:
    table = tmp_path / "images.csv"
    table.write_text(
        "# the camera's own list\nFile; utc; exposure_s; gain\n"
        "a.png; 2019-07-29T20:47:26Z; 0.5; 3\nb.png; 2019-07-30T06:17:27+09:30; ; 3\n"
    )

    times, problems = read_table(table)

    assert problems == []
    assert {name: (found.utc_s, found.exposure_s) for name, found in times.items()} == {
        "a.png": (ESA_UTC_S, 0.5),
        "b.png": (ESA_UTC_S + 1, None),
    }
    assert times["a.png"].source == "images.csv"


def test_a_row_without_a_valid_time_is_reported(tmp_path: Path) -> None:
    table = tmp_path / "times.csv"
    table.write_text("file,utc_s\na.png,1564433246.5\nb.png,12.5\nc.png,noon\nd.png\n")

    times, problems = read_table(table)

    assert {name: found.utc_s for name, found in times.items()} == {"a.png": ESA_UTC_S + 0.5}
    assert problems == [
        "times.csv: b.png: '12.5' is not a utc_s of 1990 to 2100",
        "times.csv: c.png: 'noon' is not a utc_s of 1990 to 2100",
        "times.csv: d.png: '' is not a utc_s of 1990 to 2100",
    ]


@pytest.mark.parametrize("content", [b"name,utc\na.png,2019-07-29T20:47:26Z\n", b"file\na.png\n", b"", b"\xff\xfe\x00"])
def test_a_table_without_the_expected_columns_is_rejected(tmp_path: Path, content: bytes) -> None:
    table = tmp_path / "images.csv"
    table.write_bytes(content)

    with pytest.raises(ImagesError, match=r"columns file and utc|is not UTF-8 text"):
        read_table(table)


@pytest.mark.parametrize("schema", ["glstar-truth-1", "glstar-truth-2"])
def test_the_truth_of_an_export_gives_the_start_times_of_its_frames(tmp_path: Path, schema: str) -> None:
    line = {"schema": schema, "file": "frame_000000.png", "utc_start": format_utc(ESA_UTC_S + 0.25)}
    whole = json.dumps(line | {"duration_s": 0.5})
    truth = tmp_path / "truth.jsonl"
    truth.write_text(f"{whole}\n{json.dumps(line | {'file': 'b.png', 'duration_s': None})}\n[]\n7\n{whole[:40]}")

    times = read_truth(truth)

    assert list(times) == ["frame_000000.png"]
    found = times["frame_000000.png"]
    assert (found.utc_s, found.exposure_s, found.is_start) == (parse_utc("2019-07-29T20:47:26.25Z"), 0.5, True)


def test_the_frames_of_an_export_are_named_by_the_camera_s_clock(tmp_path: Path) -> None:
    line = {"schema": "glstar-truth-1", "file": "frame_000000.png", "duration_s": 0.5}
    line |= {"utc_start": format_utc(ESA_UTC_S), "camera_utc_start": format_utc(ESA_UTC_S - 3600.5)}
    (tmp_path / "truth.jsonl").write_text(json.dumps(line))

    (time,) = read_truth(tmp_path / "truth.jsonl").values()

    assert time.utc_s == pytest.approx(ESA_UTC_S - 3600.5, rel=0, abs=1e-6)


@pytest.mark.parametrize(("grain_s", "is_coarse"), [(0.02, True), (0.0199, False), (1.0, True)])
def test_times_in_steps_of_frames_are_named_with_the_largest_step(grain_s: float, is_coarse: bool) -> None:
    times = [ImageTime(ESA_UTC_S, "name", grain_s=grain_s), ImageTime(ESA_UTC_S, "name", grain_s=0.001)]
    expected = f"the times of 1 of 2 images are in steps of {grain_s:g} s" if is_coarse else ""
    assert "; ".join(time_notes(times, 0.0)).startswith(expected)
    assert bool(time_notes(times, 0.0)) == is_coarse
    local = [replace(one, is_zoneless=True) for one in times]
    assert time_notes(local, -34200.0)[-1] == (
        "the times of 2 of 2 images have no zone and were taken as UTC; if the camera shows local time, such as that "
        "of -09:30, add --time-offset -34200"
    )


@pytest.mark.parametrize(
    ("longitude_deg", "hours"),
    [(0.0, 0), (7.4, 0), (7.6, 1), (138.6, 9), (-7.6, -1), (-172.4, -11), (187.6, -11), (352.4, -1), (352.6, 0)],
)
def test_the_zone_of_a_longitude_has_whole_hours(longitude_deg: float, hours: int) -> None:
    assert local_zone_s(np.deg2rad(longitude_deg)) == 3600.0 * hours
    assert local_zone_s(np.deg2rad(longitude_deg + 360.0)) == 3600.0 * hours


def test_a_time_is_exact_has_a_zone_and_is_that_of_the_users_choice_unless_it_says_otherwise() -> None:
    time = ImageTime(ESA_UTC_S, "name")

    assert (time.exposure_s, time.is_start, time.grain_s, time.is_zoneless) == (None, False, 0.0, False)
    assert [time.fraction_before(reference) for reference in TimeReference] == [0.0, 0.5, 1.0]
    started = replace(time, is_start=True)
    assert [started.fraction_before(reference) for reference in TimeReference] == [0.0, 0.0, 0.0]


def test_an_exposure_has_the_images_own_length_and_starts_at_its_time_by_the_logs_clock() -> None:
    wanted = Exposure(0.0, 0.5)
    own, unknown = ImageTime(ESA_UTC_S, "EXIF", exposure_s=2.0), ImageTime(ESA_UTC_S, "EXIF")

    assert exposure_of(own, wanted) == replace(wanted, start_utc_s=ESA_UTC_S, duration_s=2.0)
    assert exposure_of(unknown, wanted) == replace(wanted, start_utc_s=ESA_UTC_S)
    late = exposure_of(unknown, wanted, reference=TimeReference.END, ahead_s=0.75)
    assert late == replace(wanted, start_utc_s=ESA_UTC_S - 1.25)


@pytest.mark.parametrize(
    ("zone_s", "likely_s", "said"),
    [
        (34200.0, 36000.0, "+09:30"),
        (-43200.0, -39600.0, "-12:00"),
        (50400.0, 50400.0, "+14:00"),
        (-2700.0, 0.0, "-00:45"),
    ],
)
def test_a_time_without_a_zone_may_be_local_if_a_zone_brings_it_into_the_flight(
    zone_s: float, likely_s: float, said: str
) -> None:
    time = ImageTime(ESA_UTC_S, "name", is_zoneless=True)
    within_s = (ESA_UTC_S - zone_s - 100.0, ESA_UTC_S - zone_s + 10.0)

    note = zone_note(time, ESA_UTC_S, within_s, likely_s)

    assert note == (
        f"; its time has no zone and was taken as UTC: if the camera shows local time, such as that of {said}, add"
        f" --time-offset {zone_s:g}, with which it lies in the flight"
    )
    assert zone_note(replace(time, is_zoneless=False), ESA_UTC_S, within_s, likely_s) == ""
    # Between two quarters of an hour, and beyond the last zones.
    assert zone_note(time, ESA_UTC_S, (within_s[0] + 300, within_s[1] + 300), likely_s) == ""
    for outside_s in (-43200.0 - 900.0, 50400.0 + 900.0):
        within_s = (ESA_UTC_S - outside_s - 10.0, ESA_UTC_S - outside_s + 10.0)
        assert zone_note(time, ESA_UTC_S, within_s, likely_s) == ""


def test_the_likely_zone_is_named_of_several() -> None:
    time = ImageTime(ESA_UTC_S, "name", is_zoneless=True)
    within_s = (ESA_UTC_S - 8 * 3600.0, ESA_UTC_S - 5 * 3600.0)

    for likely_s, said in ((0.0, "+05:00"), (22000.0, "+06:00"), (36000.0, "+08:00")):
        assert f"such as that of {said}," in zone_note(time, ESA_UTC_S, within_s, likely_s)


def test_columns_of_a_table_are_separated_by_commas_semicolons_or_tabs(tmp_path: Path) -> None:
    table = tmp_path / "images.csv"
    for separator in ",;\t":
        rows = [["Exposure_S ", "utc_s", "File"], ["0.25", "1564433246.5", "b.png"], ["-1", "1564433247", "c.png"]]
        table.write_text("# a comment\n\n" + "\n".join(separator.join(row) for row in rows) + "\n")
        times, problems = read_table(table)
        assert problems == []
        assert times == {
            "b.png": ImageTime(ESA_UTC_S + 0.5, "images.csv", 0.25, grain_s=0.1),
            "c.png": ImageTime(ESA_UTC_S + 1, "images.csv", None, grain_s=1.0),
        }
    table.write_text("file,utc_s\na.png,631151999.9\nb.png,631152000\nc.png,4102444799\nd.png,4102444800\n")
    times, problems = read_table(table)
    assert list(times) == ["b.png", "c.png"]
    assert len(problems) == 2
