"""The other commands: output, and messages about missing libraries and files."""

import ast
import csv
import importlib
import inspect
import io
import json
import os
import re
import subprocess
import sys
from math import degrees, radians, tan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import erfa
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import glstar
from glstar.cli import COMMANDS, app
from glstar.cli.images import demo as demo_command
from glstar.config import Config
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.system.resources import asset

ARCSEC_DEG = 1 / 3600
COLUMNS = [
    "catalogue",
    "star_id",
    "name",
    "vmag",
    "ra_deg",
    "dec_deg",
    "azimuth_deg",
    "altitude_deg",
    "apparent_altitude_deg",
]
LATITUDE_DEG, LONGITUDE_DEG = -34.93, 138.60
ADELAIDE = ("--lat", LATITUDE_DEG, "--lon", LONGITUDE_DEG)
TEN_PAST_NINE_AT_NIGHT = ("--utc", "2024-03-10T11:00:00Z")
SIRIUS, CANOPUS, POLARIS = 2491, 2326, 424
PACKAGES = "apt-get install libgl1 libegl1"


def invoke(*words: object) -> SimpleNamespace:
    """Run the command line in this process; it must not crash."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return SimpleNamespace(rc=result.exit_code, out=result.stdout, err=result.stderr)


def run(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "glstar", *map(str, words)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
        timeout=120,
    )


def the_line(err: str) -> str:
    """Return the one line of standard error, which is a message of glstar."""
    [line] = err.splitlines()
    assert line.startswith("glstar: ")
    return line


def sky(*words: object) -> list[dict[str, Any]]:
    """Return the rows of ``glstar sky`` over Adelaide."""
    result = invoke("sky", *ADELAIDE, *TEN_PAST_NINE_AT_NIGHT, *words, "--format", "json")
    assert result.rc == 0, result.err
    rows: list[dict[str, Any]] = json.loads(result.out)
    return rows


def erfa_places_deg(hr: int, *, dut1_s: float = 0.0) -> tuple[float, float, float, float]:
    """Return right ascension and declination of date, azimuth and altitude without refraction, by ERFA."""
    star = StarCatalogue.open("bsc5").by_id([hr])
    ra, dec = float(star.ra_rad[0]), float(star.dec_rad[0])
    pm_ra = float(star.pm_ra_cosdec_rad_per_yr[0]) / np.cos(dec)
    pm_dec = float(star.pm_dec_rad_per_yr[0])
    utc = erfa.dtf2d("UTC", 2024, 3, 10, 11, 0, 0.0)
    tt = erfa.taitt(*erfa.utctai(*utc))
    ra_cirs, dec_cirs, equation_of_origins = erfa.atci13(ra, dec, pm_ra, pm_dec, 0.0, 0.0, *tt)
    azimuth, zenith_distance, *_ = erfa.atco13(
        *(ra, dec, pm_ra, pm_dec, 0.0, 0.0, *utc, dut1_s),
        *(radians(LONGITUDE_DEG), radians(LATITUDE_DEG), 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.55),  # no air
    )
    ra_of_date = float(erfa.anp(ra_cirs - equation_of_origins))
    return degrees(ra_of_date), degrees(dec_cirs), degrees(azimuth), 90 - degrees(zenith_distance)


# --- help -------------------------------------------------------------------------------------------------------------


def commands(group: Any, *path: str) -> list[tuple[tuple[str, ...], Any]]:
    """Return every command of the command line by its arguments."""
    found = []
    for name, command in group.commands.items():
        found.append(((*path, name), command))
        if hasattr(command, "commands"):
            found += commands(command, *path, name)
    return found


ALL_COMMANDS = commands(typer.main.get_command(app))


def test_the_command_line_has_these_commands() -> None:
    names = [" ".join(path) for path, _ in ALL_COMMANDS]

    assert sorted(names) == [
        *("bench", "bench make", "bench run", "bench sets", "bench table"),
        *("camera", "camera calibrate", "camera charuco", "camera chessboard", "camera presets"),
        *("camera rectify", "camera show", "compare", "config", "convert", "demo", "doctor", "doctor bench"),
        *("export", "fly", "info", "live", "live answer", "live replay", "manual", "score", "sky", "sky catalogue"),
        *("sky catalogue build", "sky catalogue info", "view"),
    ]


def test_help_states_the_purpose_of_glstar_and_a_first_command() -> None:
    for flag in ("--help", "-h"):
        result = invoke(flag)

        assert result.rc == 0
        assert "camera fixed to an aircraft" in result.out
        assert "Try: glstar demo" in result.out
        for name, command in COMMANDS.items():
            assert (name in result.out) == bool(command.panel) or name == "demo"


@pytest.mark.parametrize(("path", "command"), ALL_COMMANDS, ids=[" ".join(path) for path, _ in ALL_COMMANDS])
def test_the_help_of_every_command_states_its_purpose(path: tuple[str, ...], command: Any) -> None:
    result = invoke(*path, "--help")

    assert result.rc == 0
    assert "Usage: " in result.out
    purpose = command.help.split("\n")[0]
    assert purpose.endswith(".")
    assert " ".join(purpose.split()[:4]) in result.out
    for parameter in getattr(command, "params", []):
        assert parameter.name == "help" or getattr(parameter, "help", ""), f"{parameter.name} has no help"


@pytest.mark.parametrize("name", ["export", "sky"])
def test_the_help_of_a_command_with_many_arguments_has_an_example(name: str) -> None:
    assert f"Try: glstar {name} " in invoke(name, "--help").out


def test_the_example_of_sky_runs() -> None:
    assert "Sirius" in invoke("sky", *ADELAIDE, "--vmag", 2, "--all").out


def test_version_is_that_of_the_package() -> None:
    assert invoke("--version").out == f"glstar {glstar.__version__}\n"


def test_glstar_runs_as_a_module() -> None:
    result = run("--version")

    assert (result.returncode, result.stdout, result.stderr) == (0, f"glstar {glstar.__version__}\n", "")


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (["export"], "or a [sweep] in the config"),
        (["camera", "calibrate"], "for [camera] file"),
        (["camera", "charuco"], "[camera] file, ROS, OpenCV"),
    ],
)
def test_help_prints_text_in_brackets(path: list[str], words: str) -> None:
    assert words in " ".join(invoke(*path, "--help").out.replace("│", " ").split())


def test_without_arguments_help_is_printed_and_the_exit_status_is_2() -> None:
    result = invoke()

    assert result.rc == 2
    assert "Try: glstar demo" in result.out + result.err


# --- sky --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("astrometry", "within_arcsec"), [("paper", 0.7), ("erfa", 0.05)])
@pytest.mark.parametrize("hr", [SIRIUS, CANOPUS])
def test_a_star_over_adelaide_has_the_position_of_erfa(hr: int, astrometry: str, within_arcsec: float) -> None:
    [row] = sky("--star-id", hr, "--astrometry", astrometry, "--dut1", 0)

    ra_deg, dec_deg, azimuth_deg, altitude_deg = erfa_places_deg(hr)
    on_sky = np.cos(radians(dec_deg))
    assert (row["ra_deg"] - ra_deg) * on_sky == pytest.approx(0, abs=within_arcsec * ARCSEC_DEG)
    assert row["dec_deg"] == pytest.approx(dec_deg, abs=within_arcsec * ARCSEC_DEG)
    on_sky = np.cos(radians(altitude_deg))
    assert (row["azimuth_deg"] - azimuth_deg) * on_sky == pytest.approx(0, abs=within_arcsec * ARCSEC_DEG)
    assert row["altitude_deg"] == pytest.approx(altitude_deg, abs=within_arcsec * ARCSEC_DEG)


def test_dut1_rotates_the_sky_as_in_erfa() -> None:
    [row] = sky("--star-id", SIRIUS, "--astrometry", "erfa", "--dut1", 0.4)

    _, _, azimuth_deg, altitude_deg = erfa_places_deg(SIRIUS, dut1_s=0.4)
    assert row["azimuth_deg"] == pytest.approx(azimuth_deg, abs=0.15 * ARCSEC_DEG)
    assert row["altitude_deg"] == pytest.approx(altitude_deg, abs=0.05 * ARCSEC_DEG)


@pytest.mark.parametrize(("pressure_hpa", "temperature_c"), [(1010, 10), (700, -20)])
def test_refraction_raises_the_apparent_altitude(pressure_hpa: float, temperature_c: float) -> None:
    [row] = sky("--star-id", SIRIUS, "--pressure", pressure_hpa, "--temperature", temperature_c)

    altitude_deg = row["altitude_deg"]
    # Saemundsson's formula in arcmin, with Meeus's term that makes refraction vanish at the zenith.
    lift_arcmin = 1.02 / tan(radians(altitude_deg + 10.3 / (altitude_deg + 5.11))) + 0.0019279
    lift_deg = lift_arcmin / 60 * pressure_hpa / 1010 * 283 / (273 + temperature_c)
    assert row["apparent_altitude_deg"] - altitude_deg == pytest.approx(lift_deg, abs=0.01 * ARCSEC_DEG)


def test_without_air_there_is_no_refraction() -> None:
    rows = sky("--vmag", 3, "--pressure", 0)

    assert rows
    assert all(row["apparent_altitude_deg"] == row["altitude_deg"] for row in rows)


def test_a_star_has_these_columns_in_json_and_csv() -> None:
    rows = sky("--vmag", 2)
    result = invoke("sky", *ADELAIDE, *TEN_PAST_NINE_AT_NIGHT, "--vmag", 2, "--format", "csv")

    assert all(list(row) == COLUMNS for row in rows)
    assert result.out.splitlines()[0] == ",".join(COLUMNS)
    table = list(csv.DictReader(io.StringIO(result.out)))
    for column in ("catalogue", "name"):
        assert [row[column] for row in table] == [row[column] for row in rows]
    assert {row["catalogue"] for row in rows} == {"bsc5"}
    for column in [name for name in COLUMNS if name not in {"catalogue", "name"}]:
        np.testing.assert_allclose(
            [float(row[column]) for row in table], [row[column] for row in rows], rtol=0, atol=1e-8
        )
    assert result.err == ""


def test_a_table_has_the_same_values_as_json() -> None:
    result = invoke("sky", *ADELAIDE, *TEN_PAST_NINE_AT_NIGHT, "--star-id", SIRIUS, "--star-id", CANOPUS)

    assert all(column in result.out for column in COLUMNS[2:])
    assert "2024-03-10T11:00:00" in result.out
    for row in sky("--star-id", SIRIUS, "--star-id", CANOPUS):
        [line] = [line for line in result.out.splitlines() if f" {row['name']} " in line]
        assert f" HR {row['star_id']} " in line
        for column in COLUMNS[4:]:
            assert f"{row[column]:.5f}" in line


@pytest.mark.parametrize(
    ("flags", "label"),
    [(("--dut1", 0.25), r"UT1 - UTC = \+0\.2500 s as given by --dut1"), ((), r"UT1 (- UTC = [+-]0\.\d{4} s by|= UTC)")],
)
def test_a_table_names_the_ut1_that_was_used(flags: tuple[object, ...], label: str) -> None:
    result = invoke("sky", *ADELAIDE, *TEN_PAST_NINE_AT_NIGHT, "--star-id", SIRIUS, *flags)

    assert re.search(label, " ".join(result.out.split()))


def test_stars_below_the_horizon_are_listed_only_on_request() -> None:
    shown, everything = sky("--vmag", 3), sky("--vmag", 3, "--all")

    assert all(row["apparent_altitude_deg"] >= 0 for row in shown)
    assert [row for row in everything if row["apparent_altitude_deg"] >= 0] == shown
    assert len(everything) == len(StarCatalogue.open("bsc5").brighter_than(3.0))
    assert {row["vmag"] <= 3 for row in everything} == {True}
    assert 0 < len(shown) < len(everything)


def test_a_note_reports_that_polaris_never_rises_over_adelaide() -> None:
    result = invoke("sky", *ADELAIDE, *TEN_PAST_NINE_AT_NIGHT, "--star-id", POLARIS, "--format", "json")

    assert (result.rc, json.loads(result.out)) == (0, [])
    assert "below the horizon" in the_line(result.err)
    assert "--all" in result.err
    [row] = sky("--star-id", POLARIS, "--all")
    assert row["altitude_deg"] == pytest.approx(LATITUDE_DEG, abs=0.7)


def test_a_catalogue_can_be_given_by_its_path() -> None:
    assert sky("--star-id", SIRIUS, "--catalogue", asset("bsc5.sqlite")) == sky("--star-id", SIRIUS)


def test_without_a_time_the_current_time_is_used() -> None:
    result = invoke("sky", *ADELAIDE, "--star-id", SIRIUS, "--all", "--format", "csv")

    assert result.rc == 0
    assert len(result.out.splitlines()) == 2


def test_sky_and_export_accept_a_leap_second(tmp_path: Path) -> None:
    asked = (*ADELAIDE, "--vmag", 1, "--all", "--format", "csv", "--utc")
    leap, after = (invoke("sky", *asked, utc).out for utc in ("2016-12-31T23:59:60Z", "2017-01-01T00:00:00Z"))
    assert leap == after != ""

    config = tmp_path / "leap.toml"
    config.write_text('[flight]\nutc_start = "2016-12-31T23:59:60Z"\n', encoding="utf-8")
    assert Config.load(config).flight.start_utc_s == 1483228800.0


@pytest.mark.parametrize("utc", ["2300-01-01", "1750-01-01", "2200-01-01", "1799-12-31T23:59:59Z"])
def test_sky_and_export_refuse_the_same_dates(utc: str, tmp_path: Path) -> None:
    for words in (("sky", *ADELAIDE, "--utc", utc), ("export", "-o", tmp_path / "frames", "--utc-start", utc)):
        result = invoke(*words)
        assert result.rc == 1
        assert "the years 1800 to 2200" in the_line(result.err)
    assert not (tmp_path / "frames").exists()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--lat", 95, "--lon", 0), "latitude"),
        (("--lat", "nan", "--lon", 0), "finite"),
        ((*ADELAIDE, "--utc", "2024-13-01"), "ISO 8601"),
        ((*ADELAIDE, "--utc", "yesterday"), "ISO 8601"),
        ((*ADELAIDE, "--star-id", 9999), "HR 9999"),
        ((*ADELAIDE, "--catalogue", "messier"), "messier"),
        ((*ADELAIDE, "--catalogue", __file__), "SQLite"),
        ((*ADELAIDE, "--pressure", -5), "pressure"),
        ((*ADELAIDE, "--temperature", -300), "temperature"),
        ((*ADELAIDE, "--height", "nan"), "finite"),
        ((*ADELAIDE, "--pressure", 1e9), "a pressure of 1e+09 hPa is not possible; it must be from 0 to 1200 hPa"),
        ((*ADELAIDE, "--height", 1e12), "a height of 1e+12 m is not possible; it must be from -1000 to 100000 m"),
        ((*ADELAIDE, "--temperature", 500), "must be from -120 to 100 deg C"),
        ((*ADELAIDE, "--utc", "2300-01-01"), "the years 1800 to 2200"),
        ((*ADELAIDE, "--utc", "1750-01-01"), "the years 1800 to 2200"),
        ((*ADELAIDE, "--utc", "2024-03-10T11:00:60Z"), "a leap second is 23:59:60 of UTC"),
        ((*ADELAIDE, "--vmag", "nan"), "vmag"),
        ((*ADELAIDE, "--dut1", "nan"), "dut1"),
        ((*ADELAIDE, "--dut1", 37), "dut1"),  # TAI - UTC, most likely
    ],
)
def test_an_invalid_sky_is_refused(arguments: tuple[object, ...], reason: str) -> None:
    result = invoke("sky", *arguments)

    assert (result.rc, result.out) == (1, "")
    assert reason in the_line(result.err)


# --- catalogue --------------------------------------------------------------------------------------------------------


def test_catalogue_info_counts_the_bright_stars() -> None:
    facts = json.loads(invoke("sky", "catalogue", "info", "--json").out)

    assert facts["stars"] == 9096
    assert facts["brightest_star"]["number"] == SIRIUS
    assert "9096" in invoke("sky", "catalogue", "info").out


# --- doctor -----------------------------------------------------------------------------------------------------------


def test_doctor_reports_the_renderer_of_this_machine() -> None:
    result = invoke("doctor", "--json")

    facts = json.loads(result.out)
    assert result.rc == 0
    assert facts["glstar"] == glstar.__version__
    assert facts["opengl"]["renderer"]
    assert facts["opengl"]["version"]
    assert all(facts["libraries"].values())
    assert facts["catalogues"]["bsc5"].startswith("9096 stars")
    assert set(facts["catalogues"]) == {"bsc5", "hipparcos", "tycho2", "gaia"}
    for device in facts["egl_devices"]:
        assert device["vendor"]
    software = any(word in facts["opengl"]["renderer"].lower() for word in ("llvmpipe", "softpipe"))
    assert software == any("in software" in sentence for sentence in facts["amiss"])


def test_doctor_runs_the_libraries_that_it_lists(tmp_path: Path) -> None:
    """As after the removal of another OpenCV: the folder of the module is there, and its library is not."""
    (tmp_path / "cv2").mkdir()
    (tmp_path / "cv2" / "__init__.py").touch()
    other = tmp_path / "opencv_python-4.9.0.80.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: opencv-python\nVersion: 4.9.0.80\n")
    (other / "top_level.txt").write_text("cv2\n")

    result = run("doctor", "--json", PYTHONPATH=f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")

    broken, twice = json.loads(result.stdout)["amiss"][-2:]
    assert broken.startswith("opencv-contrib-python-headless ")
    assert "does not run (AttributeError: module 'cv2' has no attribute 'imencode')" in broken
    assert "--force-reinstall --no-deps opencv-contrib-python-headless" in broken
    assert twice.startswith("opencv-python writes to the folder of opencv-contrib-python-headless too")
    assert "pip uninstall opencv-python && pip install" in twice


def test_doctor_reports_the_same_as_text() -> None:
    facts, result = json.loads(invoke("doctor", "--json").out), invoke("doctor")

    assert result.rc == 0
    flat = " ".join(result.out.split())
    for fact in (
        facts["glstar"],
        facts["python"],
        facts["libraries"]["moderngl"],
        *facts["opengl"]["renderer"].split(),
    ):
        assert fact in flat
    assert flat.endswith(facts["amiss"][-1] if facts["amiss"] else "all is well")


# --- a machine without OpenGL -----------------------------------------------------------------------------------------

# The library reads it once in a process.
NO_VENDOR = "__EGL_VENDOR_LIBRARY_FILENAMES"
MISSING = [
    ({"GLCONTEXT_LINUX_LIBEGL": "libnothere.so"}, PACKAGES),
    ({"GLCONTEXT_LINUX_LIBGL": "libnothere.so"}, PACKAGES),
    ({NO_VENDOR: "/nonexistent"}, "glstar doctor"),
    ({"GLSTAR_DEVICE": "99"}, "glstar doctor"),
    ({"GLSTAR_DEVICE": "the fast one"}, "glstar doctor"),
]
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="these are the names of libraries on Linux")


@on_linux
@pytest.mark.parametrize(
    ("command", "environment", "remedy"),
    [*(("export", *missing) for missing in MISSING), *(("demo", *missing) for missing in MISSING[:2])],
)
def test_without_opengl_one_line_names_the_remedy(
    command: str, environment: dict[str, str], remedy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if NO_VENDOR in environment:
        child = run(command, "-o", tmp_path / "frames", **environment)
        result = SimpleNamespace(rc=child.returncode, out=child.stdout, err=child.stderr)
    else:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        result = invoke(command, "-o", tmp_path / "frames")

    assert (result.rc, result.out) == (1, "")
    assert remedy in the_line(result.err)
    assert list(tmp_path.iterdir()) == [], "nothing half-written"


@on_linux
@pytest.mark.parametrize(("environment", "remedy"), [MISSING[0], MISSING[2]])
def test_doctor_reports_problems_and_exits_with_1(environment: dict[str, str], remedy: str) -> None:
    as_json, shown = run("doctor", "--json", **environment), run("doctor", **environment)

    facts = json.loads(as_json.stdout)
    assert (as_json.returncode, shown.returncode) == (1, 1)
    assert (as_json.stderr, shown.stderr) == ("", "")
    assert remedy in facts["opengl"]["error"]
    assert facts["amiss"]
    assert "OpenGL" in shown.stdout
    assert facts["amiss"][0] in " ".join(shown.stdout.split())


@on_linux
def test_sky_needs_no_opengl() -> None:
    words = ("sky", *ADELAIDE, *TEN_PAST_NINE_AT_NIGHT, "--star-id", SIRIUS, "--format", "csv")

    result = run(*words, GLCONTEXT_LINUX_LIBEGL="libnothere.so", GLCONTEXT_LINUX_LIBGL="libnothere.so")

    assert (result.returncode, result.stderr) == (0, "")
    assert "Sirius" in result.stdout


# --- demo -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """The demo, run once."""
    directory = tmp_path_factory.mktemp("demo") / "glstar-demo"
    result = run("demo", "-o", directory)
    assert result.returncode == 0, result.stderr
    return SimpleNamespace(directory=directory, out=result.stdout, err=result.stderr)


def test_demo_draws_some_frames_and_a_contact_sheet(demo: SimpleNamespace) -> None:
    frames = sorted(path.name for path in demo.directory.glob("frame_*.png"))

    assert len(frames) == 6
    assert sorted(path.name for path in demo.directory.iterdir()) == sorted(
        [*frames, "contact-sheet.png", "manifest.json", "truth.jsonl"]
    )
    sheet = cv2.imread(str(demo.directory / "contact-sheet.png"), cv2.IMREAD_UNCHANGED)
    assert sheet is not None
    assert sheet.dtype == np.uint8
    height_px, width_px = sheet.shape[:2]
    assert width_px / 3 == pytest.approx(height_px / 2 * 1014 / 760, rel=0.01)
    for row in range(2):
        for column in range(3):
            tile = sheet[row * height_px // 2 :, column * width_px // 3 :][: height_px // 2, : width_px // 3]
            assert tile.std() > 5  # DN: the sheet is not empty


def test_demo_names_its_contact_sheet_in_one_sentence(demo: SimpleNamespace) -> None:
    [sentence] = demo.out.splitlines()

    assert sentence.startswith(f"Look at {demo.directory / 'contact-sheet.png'}: ")
    assert sentence.endswith(".")
    assert demo.err == ""


def test_the_trails_of_the_demo_are_visible_and_curved(demo: SimpleNamespace) -> None:
    lines = [json.loads(line) for line in (demo.directory / "truth.jsonl").read_text(encoding="utf-8").splitlines()]

    lengths_px, sagittas_px = [], []
    for line in lines:
        stars = [star for star in line["stars"] if star["in_frame"] == 1 and star["vmag"] < 3]
        assert stars
        for star in stars:
            start, middle, end = (np.array(at) for at in (star["start"], [star["x_px"], star["y_px"]], star["end"]))
            lengths_px.append(np.hypot(*(end - start)))
            sagittas_px.append(np.hypot(*(middle - (start + end) / 2)))
    assert np.max(lengths_px) > 50
    assert np.max(sagittas_px) > 3


def test_each_frame_of_the_demo_shows_stars_and_the_brightest_is_named(demo: SimpleNamespace) -> None:
    lines = [json.loads(line) for line in (demo.directory / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    names = demo_command._names(lines)

    for line in lines:
        seen = [star for star in line["stars"] if star["snr"] > 12 and star["in_frame"] > 0.6]
        assert len(seen) >= 20
        assert demo_command._brightest(line)[0] == min(seen, key=lambda star: star["vmag"])
    assert {"Sirius", "Rigil Kentaurus", "gamma Cen"} <= set(names.values())
    assert not [name for name in names.values() if name.startswith("HR")]


@pytest.mark.parametrize(
    ("name", "spelled"), [("γ² Vel", "gamma2 Vel"), ("61 Cyg", "61 Cyg"), ("", ""), ("ω Car", "omega Car")]
)
def test_greek_letters_are_spelled_out(name: str, spelled: str) -> None:
    assert demo_command._spelled_out(name) == spelled


@pytest.mark.parametrize(
    ("start", "end", "at"), [([0, 0], [9, 9], (9, 9)), (None, [9, 9], (9, 9)), (None, None, (6, 6))]
)
def test_a_trail_is_named_at_an_end_in_the_frame_or_at_its_middle(start: object, end: object, at: object) -> None:
    star = {"start": start, "end": end, "centroid_x_px": 6, "centroid_y_px": 6}

    assert demo_command._brighter_end(star) == at


def test_a_second_demo_changes_no_file(demo: SimpleNamespace) -> None:
    before = {path.name: path.read_bytes() for path in demo.directory.iterdir()}

    result = invoke("demo", "-o", demo.directory)

    assert result.rc == 0
    assert {path.name: path.read_bytes() for path in demo.directory.iterdir()} == before


def test_the_summary_of_each_command_is_the_beginning_of_its_help():
    for name, command in COMMANDS.items():
        module = importlib.import_module(f"glstar.cli.{command.module}")
        described = getattr(module, command.name)
        text = described.info.help if command.name == "app" else inspect.cleandoc(described.__doc__).split("\n\n")[0]
        assert text.replace("\n", " ") == command.summary, name


@pytest.mark.parametrize("words", ["--help", "--version"])
def test_the_list_of_commands_imports_none_of_them(words):
    program = "import sys, glstar.cli as cli\ntry:\n    cli.main()\nfinally:\n    print(sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program, words], capture_output=True, text=True, check=False)
    modules = ast.literal_eval(done.stdout.splitlines()[-1])
    assert "glstar.cli" in modules
    assert not {"numpy", "pydantic", "glstar.cli.images.export", "glstar.cli.flights.view"} & set(modules)


def test_a_command_imports_no_other_one():
    program = "import sys, glstar.cli as cli\ntry:\n    cli.main()\nfinally:\n    print(sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program, "manual"], capture_output=True, text=True, check=True)
    modules = ast.literal_eval(done.stdout.splitlines()[-1])
    commands = {f"glstar.cli.{command.module}" for command in COMMANDS.values()}
    assert commands & set(modules) == {"glstar.cli.machine.manual"}


def test_a_shell_completes_the_options_of_a_command():
    done = subprocess.run(
        [sys.executable, "-c", "import sys, glstar.cli as cli; sys.argv = ['glstar']; cli.main()"],
        env=os.environ | {"_GLSTAR_COMPLETE": "complete_bash", "COMP_WORDS": "glstar export --ever", "COMP_CWORD": "2"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "--every" in done.stdout + done.stderr


def test_the_demo_of_a_night_goes_from_sunset_to_moonset(tmp_path: Path) -> None:
    result = run("demo", "--night", "-o", tmp_path / "night")
    assert result.returncode == 0, result.stderr

    lines = [json.loads(line) for line in (tmp_path / "night" / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    assert len(lines) == 12
    assert -1 < lines[0]["sun_altitude_deg"] < 1
    assert -1 < lines[-1]["moon_altitude_deg"] < 1
    brightness = [line["sky_mag_arcsec2"] for line in lines[:4]]
    assert brightness == sorted(brightness)  # mag/arcsec2: each darker than the one before
    assert {body["name"] for line in lines for body in line["bodies"]} >= {"Moon", "Jupiter"}
    assert cv2.imread(str(tmp_path / "night" / "contact-sheet.png")) is not None
