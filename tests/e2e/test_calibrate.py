"""``glstar camera calibrate`` recovers the sensor of exported frames."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from glstar.cli import app
from glstar.cli.calibration.output import write_files
from glstar.config import Config
from glstar.errors import CalibrationError
from tests.support.plainphotos import all_sky

pytestmark = pytest.mark.usefixtures("kept_patterns")
SETTINGS = """
[camera]
width_px = 800
height_px = 600
fx_px = 1000.0
fy_px = 1000.0
[sensor]
reference_peak_dn = 1200.0
psf_sigma_px = 1.1
sky_mean_dn = 22.0
sky_std_dn = 3.0
[sky]
vmag_limit = 8.0
"""
PLACE = ["--lat", "-34.93", "--lon", "138.60"]
ATTITUDE = ["--yaw", "70", "--pitch", "3", "--roll", "-4"]
UTC = "2024-03-10T11:00:05.25Z"


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with a flight without motion, its one frame and the settings of the frame."""
    directory = tmp_path_factory.mktemp("ground")
    (directory / "camera.toml").write_text(SETTINGS, encoding="utf-8")
    rows = [f"{1710068400 + k * 0.1:.1f},-4,3,70,-34.93,138.60" for k in range(101)]
    header = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"
    (directory / "still.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
    drawn = run(
        *("export", directory / "still.csv", "-o", directory / "frames", "-c", directory / "camera.toml"),
        *("--start", "5", "--frames", "1", "--exposure", "0.5"),
    )
    assert drawn.exit_code == 0, drawn.output
    return directory


def calibrated(ground: Path, output: Path, *arguments: str | Path) -> dict:
    result = run(
        "camera",
        "calibrate",
        ground / "frames" / "frame_000000.png",
        "-o",
        output,
        "--exposure",
        "0.5",
        "--json",
        *arguments,
    )
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def check(ground: Path, output: Path, found: dict) -> None:
    """Compare a calibration with the settings of the frame, and its stars with the frame's truth."""
    true = Config.load(ground / "camera.toml").sensor()
    sensor = Config.load(output).sensor()
    assert sensor.peak_dn([3.0], 0.5)[0] == pytest.approx(true.peak_dn([3.0], 0.5)[0], rel=0.01)
    assert sensor.psf_sigma_px == pytest.approx(1.1, rel=0.01)
    assert sensor.sky_mean_dn == pytest.approx(22.0, abs=0.1)  # DN
    assert sensor.sky_std_dn == pytest.approx(3.0, rel=0.02)
    assert found["identification"]["fx_px"] == pytest.approx(1000.0, rel=1e-3)
    assert found["identification"]["expected_by_chance"] < 1.5
    assert 0 < found["identification"]["standard_error"]["fx_px"] < 0.5
    error = found["sensor_standard_error"]
    assert abs(sensor.psf_sigma_px - 1.1) < 4 * error["psf_sigma_px"] < 0.05
    assert 0 < error["reference_peak_dn"] < 0.02 * found["sensor"]["reference_peak_dn"]
    assert output.read_text(encoding="utf-8").count("# Standard errors: ") == 2
    truth = json.loads((ground / "frames" / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    place = {star["star_id"]: (star["centroid_x_px"], star["centroid_y_px"]) for star in truth["stars"]}
    with output.with_suffix(".stars.csv").open(encoding="utf-8", newline="") as file:
        stars = list(csv.DictReader(file))
    used = [star for star in stars if star["used"] == "1" and float(star["signal_to_noise"]) > 25]
    off_px = [
        np.hypot(float(s["x_px"]) - place[int(s["star_id"])][0], float(s["y_px"]) - place[int(s["star_id"])][1])
        for s in used
    ]
    assert len(used) > 50
    assert np.sqrt(np.mean(np.square(off_px))) < 0.05
    assert max(off_px) < 0.15
    assert json.loads(output.with_suffix(".json").read_text(encoding="utf-8")) == found
    assert cv2.imread(str(output.with_suffix(".png"))).shape[1] == 1650


def test_the_sensor_of_an_exported_frame_is_recovered(ground: Path, tmp_path: Path) -> None:
    flight = ("-c", ground / "camera.toml", "--flight", ground / "still.csv", "--utc", UTC)
    found = calibrated(ground, tmp_path / "flight.toml", *flight)
    check(ground, tmp_path / "flight.toml", found)
    assert found["identification"]["method"] == "by attitude"
    assert found["identification"]["altitude_deg"] == pytest.approx(85.0, abs=0.1)
    assert found["notes"] == []


def test_a_turn_during_the_readout_of_a_rolling_shutter_is_noted(ground: Path, tmp_path: Path) -> None:
    rows = [f"{1710068400 + k * 0.1:.1f},-4,3,{70 + 0.5 * (k * 0.1 - 5.25)},-34.93,138.60" for k in range(101)]
    header = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"
    (tmp_path / "turning.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
    (tmp_path / "rolling.toml").write_text(SETTINGS + "[exposure]\nreadout_s = 0.08\n", encoding="utf-8")
    flight = ("-c", tmp_path / "rolling.toml", "--flight", tmp_path / "turning.csv", "--utc", UTC)
    found = calibrated(ground, tmp_path / "rolling.toml.out.toml", *flight, "--geometry-only")
    (note,) = [note for note in found["notes"] if "turned by" in note]
    assert "turned by 0.04 deg while the rolling shutter read the image (80 ms)" in note
    assert "camera and attitude are those of the middle row" in note


def test_the_twin_of_a_frame_is_like_the_frame(ground: Path, tmp_path: Path) -> None:
    flight = ("-c", ground / "camera.toml", "--flight", ground / "still.csv", "--utc", UTC, "--twin")
    found = calibrated(ground, tmp_path / "twin.toml", *flight)
    assert found["twin"]["sky_ks"] < 0.01
    assert found["twin"]["width_ratio"] == pytest.approx(1.0, abs=0.01)
    assert found["twin"]["peak_error"] < 1.5 * found["twin"]["peak_noise"]
    assert found["twin"]["profile_error"] < 0.03
    assert cv2.imread(str(tmp_path / "twin.twin.png")).shape == cv2.imread(str(found_frame(ground))).shape
    assert (tmp_path / "twin.pair.png").exists()
    assert not (tmp_path / "twin.sky.tiff").exists()  # its sky is even


@pytest.mark.parametrize("other", ["--geometry-only", "--shape"])
def test_the_twin_and_options_that_contradict_it_are_refused(ground: Path, tmp_path: Path, other: str) -> None:
    result = run(
        "camera", "calibrate", found_frame(ground), "-o", tmp_path / "c.toml", "--exposure", "0.5", "--twin", other
    )
    assert result.exit_code != 0
    assert "--twin" in result.output + result.stderr
    assert not (tmp_path / "c.toml").exists()


@pytest.mark.parametrize(("gamma", "images"), [("film", 1), ("fit", 2)])
def test_a_gamma_that_is_none_or_cannot_be_fitted_is_refused(
    ground: Path, tmp_path: Path, gamma: str, images: int
) -> None:
    frames = [found_frame(ground)] * images
    result = run("camera", "calibrate", *frames, "-o", tmp_path / "c.toml", "--exposure", "0.5", "--gamma", gamma)
    assert result.exit_code != 0
    assert "--gamma" in result.output + result.stderr
    assert not (tmp_path / "c.toml").exists()


def found_frame(ground: Path) -> Path:
    return ground / "frames" / "frame_000000.png"


def test_the_offset_of_the_camera_s_clock_is_applied(ground: Path, tmp_path: Path) -> None:
    """The camera is an hour ahead: its 12:00 is the flight's 11:00."""
    settings = tmp_path / "ahead.toml"
    settings.write_text(f"{SETTINGS}[flight]\ntime_offset_s = 3600.0\n", encoding="utf-8")
    flight = ("-c", settings, "--flight", ground / "still.csv", "--utc", UTC.replace("T11:", "T12:"))
    found = calibrated(ground, tmp_path / "flight.toml", *flight)
    check(ground, tmp_path / "flight.toml", found)
    assert found["notes"] == []


def test_an_attitude_with_an_error_of_three_degrees_suffices_and_is_reported(ground: Path, tmp_path: Path) -> None:
    off = ("--utc", UTC, *PLACE, "--yaw", "72", "--pitch", "1", "--roll", "-6")
    found = calibrated(ground, tmp_path / "off.toml", "-c", ground / "camera.toml", *off)
    check(ground, tmp_path / "off.toml", found)
    assert any("deg away from the camera's direction" in note for note in found["notes"])


def test_an_approximate_field_of_view_suffices_with_an_attitude(ground: Path, tmp_path: Path) -> None:
    found = calibrated(ground, tmp_path / "fov.toml", "--fov", "40", "--utc", UTC, *PLACE, *ATTITUDE)
    check(ground, tmp_path / "fov.toml", found)


def test_an_approximate_field_of_view_suffices_with_the_solver(ground: Path, tmp_path: Path) -> None:
    pytest.importorskip("tetra3rs")
    found = calibrated(ground, tmp_path / "lost.toml", "--fov", "40")
    check(ground, tmp_path / "lost.toml", found)
    assert found["identification"]["method"] == "by their pattern"


@pytest.mark.parametrize("column", ["star_id", "hr"])  # ``hr`` in files of glstar 0.2 and before
def test_labels_suffice_without_attitude_or_time(column: str, ground: Path, tmp_path: Path) -> None:
    truth = json.loads((ground / "frames" / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    known = [star for star in truth["stars"] if star["in_frame"] == 1.0 and star["vmag"] < 5][:5]
    rows = [f"{star['star_id']},{star['x_px']:.0f},{star['y_px']:.0f}" for star in known]
    (tmp_path / "labels.csv").write_text("\n".join([f"{column},x_px,y_px", *rows]), encoding="utf-8")
    found = calibrated(ground, tmp_path / "labels.toml", "--labels", tmp_path / "labels.csv")
    check(ground, tmp_path / "labels.toml", found)


def test_the_paper_s_criterion_names_one_star(ground: Path, tmp_path: Path) -> None:
    options = ("-c", ground / "camera.toml", "--flight", ground / "still.csv", "--utc", UTC)
    found = calibrated(ground, tmp_path / "paper.toml", *options, "--criterion", "paper")
    with (tmp_path / "paper.stars.csv").open(encoding="utf-8", newline="") as file:
        stars = {(star["vmag"], star["peak_dn"]) for star in csv.DictReader(file)}
    reference = found["sensor"]["reference_vmag"], found["sensor"]["reference_peak_dn"]
    assert (f"{reference[0]:.2f}", f"{reference[1]:.4f}") in stars


def test_the_summary_names_results_and_files(ground: Path, tmp_path: Path) -> None:
    flight = ("-c", ground / "camera.toml", "--flight", ground / "still.csv", "--utc", UTC)
    image = ground / "frames" / "frame_000000.png"
    summary = run("camera", "calibrate", image, "-o", tmp_path / "summary.toml", "--exposure", "0.5", *flight)
    assert summary.exit_code == 0
    for text in ("stars found", "identified by attitude", "expected by chance", "px rms", "sigma 1.", "report: "):
        assert text in summary.output


def photograph(path: Path, pixels: np.ndarray) -> Path:
    cv2.imwrite(str(path), np.clip(pixels, 0, 255).astype(np.uint8))
    return path


def clouds(size: tuple[int, int] = (600, 800)) -> np.ndarray:
    rng = np.random.default_rng(4)
    return cv2.GaussianBlur(rng.normal(0, 900, size), (0, 0), 25) + 90 + rng.normal(0, 3, size)


def daylight(size: tuple[int, int] = (600, 800)) -> np.ndarray:
    """Return a roof, a wall with windows and trees under a bright sky."""
    rng = np.random.default_rng(9)
    scene = np.full((*size, 3), 235.0)
    cv2.fillPoly(scene, [np.array([[100, 300], [400, 150], [700, 300]], dtype=np.int32)], (40, 60, 120))
    cv2.rectangle(scene, (120, 300), (680, 600), (150, 170, 180), -1)
    for x in range(150, 650, 90):
        cv2.rectangle(scene, (x, 350), (x + 40, 420), (60, 50, 40), -1)
    for x, y in rng.uniform((0, 400), (800, 600), (400, 2)).astype(int):
        cv2.circle(scene, (int(x), int(y)), int(rng.integers(2, 14)), rng.uniform(20, 120, 3).tolist(), -1)
    return scene + rng.normal(0, 4, scene.shape)


@pytest.mark.parametrize("kind", ["nothing", "clouds", "saturated", "daylight"])
@pytest.mark.parametrize("method", ["pattern", "attitude"])
def test_an_image_without_stars_is_refused_with_the_number_needed(tmp_path: Path, kind: str, method: str) -> None:
    pytest.importorskip("tetra3rs")
    rng = np.random.default_rng(2)
    pixels = {
        "nothing": rng.normal(20, 3, (600, 800)),
        "clouds": clouds(),
        "saturated": np.full((600, 800), 255.0),
        "daylight": daylight(),
    }[kind]
    image = photograph(tmp_path / "none.png", pixels)
    known = ["--utc", UTC, *PLACE, *ATTITUDE] if method == "attitude" else []
    result = run("camera", "calibrate", image, "--fov", "43", "--exposure", "1", "-o", tmp_path / "none.toml", *known)
    assert result.exit_code == 1
    assert result.stderr.startswith("glstar: ")
    assert result.stderr.count("\n") == 1
    assert "stars were found" in result.stderr
    assert not (tmp_path / "none.toml").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "has no known field of view; give --fov"),
        (("--fov", "43"), "give --exposure"),
        (("--fov", "43", "--exposure", "0"), "--exposure must be a positive number"),
        (("--fov", "43", "--exposure", "1", "--yaw", "3"), "--pitch and --roll missing"),
        (("--fov", "43", "--exposure", "1", "--lat", "3"), "--lon missing"),
        (("--fov", "43", "--exposure", "1", *ATTITUDE), "an attitude needs --utc, --lat and --lon"),
        (("--fov", "43", "--exposure", "1", "--flight", "FLIGHT"), "--flight needs --utc"),
        (("--fov", "43", "--exposure", "1", "--labels", "LABELS"), "line 2 is no label"),
        (("--exposure", "1", "-c", "CAMERA"), "not the same camera"),
        (("--fov", "43", "--exposure", "1", "--bit-depth", "4"), "4 bits cannot"),
    ],
)
def test_what_cannot_be_meant_gets_one_line(
    ground: Path, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    (tmp_path / "labels.csv").write_text("x,y,star_id\n3,4\n", encoding="utf-8")
    (tmp_path / "camera.toml").write_text("[camera]\nwidth_px = 100\nheight_px = 99\nfx_px = 90.0\nfy_px = 90.0\n")
    files = {"FLIGHT": ground / "still.csv", "LABELS": tmp_path / "labels.csv", "CAMERA": tmp_path / "camera.toml"}
    given = [files.get(argument, argument) for argument in arguments]
    result = run("camera", "calibrate", ground / "frames" / "frame_000000.png", "-o", tmp_path / "no.toml", *given)
    if not arguments:
        result = run(
            "camera", "calibrate", ground / "frames" / "frame_000000.png", "-o", tmp_path / "no.toml", "--exposure", "1"
        )
    assert result.exit_code == 1
    assert words in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_wrong_field_of_view_is_refused(ground: Path, tmp_path: Path) -> None:
    pytest.importorskip("tetra3rs")
    # Its middle, 17 deg wide: the solver tries all patterns of the stars on it.
    middle = cv2.imread(str(ground / "frames" / "frame_000000.png"), cv2.IMREAD_UNCHANGED)[188:413, 250:550]
    image = photograph(tmp_path / "middle.png", middle)
    for known in ([], ["--utc", UTC, *PLACE, *ATTITUDE]):
        result = run(
            "camera", "calibrate", image, "--fov", "30", "--exposure", "0.5", "-o", tmp_path / "no.toml", *known
        )
        assert (result.exit_code, result.stderr.count("\n")) == (1, 1), result.output
        assert "stars were found" in result.stderr
    assert not (tmp_path / "no.toml").exists()


def shaken(ground: Path, tmp_path: Path, length_px: int) -> Path:
    """Return the frame blurred by a rotation of the camera to the right during the exposure."""
    frame = cv2.imread(str(ground / "frames" / "frame_000000.png"), cv2.IMREAD_UNCHANGED).astype(float)
    steps = range(-(length_px // 2), length_px // 2 + 1)
    return photograph(tmp_path / "shaken.png", np.mean([np.roll(frame, step, axis=1) for step in steps], axis=0) + 0.5)


@pytest.mark.parametrize("length_px", [5, 9])
def test_a_blurred_image_gives_camera_and_attitude_but_no_sensor(ground: Path, tmp_path: Path, length_px: int) -> None:
    pytest.importorskip("tetra3rs")
    given = ("--fov", "43", "--exposure", "0.5", "-o", tmp_path / "c.toml", "--json")

    result = run("camera", "calibrate", shaken(ground, tmp_path, length_px), *given)

    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["sensor"] is None
    assert "camera and attitude only, no sensor: the stars are trails of about" in found["notes"][0]
    assert found["identification"]["fx_px"] == pytest.approx(1000.0, rel=2e-3)
    truth = json.loads((ground / "frames" / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    C = np.array(found["identification"]["C_camera_icrs"]) @ np.array(truth["C_camera_icrs"]).T
    # The printed numbers are rounded: the trace of the identity may exceed 3.
    assert np.rad2deg(np.arccos(min((np.trace(C) - 1) / 2, 1.0))) < 0.1  # deg; a pixel is 0.057 deg
    assert {path.name for path in tmp_path.glob("c.*")} == {"c.toml", "c.json", "c.stars.csv", "c.png"}
    text = (tmp_path / "c.toml").read_text(encoding="utf-8")
    assert "[camera]" in text
    assert "[sensor]" not in text
    assert Config.load(tmp_path / "c.toml").camera().fx_px == pytest.approx(1000.0, rel=2e-3)


def test_geometry_alone_needs_no_exposure(ground: Path, tmp_path: Path) -> None:
    pytest.importorskip("tetra3rs")
    image = ground / "frames" / "frame_000000.png"

    result = run("camera", "calibrate", image, "--fov", "43", "--geometry-only", "-o", tmp_path / "c.toml")

    assert result.exit_code == 0, result.output
    assert "the optical axis points at right ascension" in result.stdout
    assert "sigma" not in result.stdout
    assert cv2.imread(str(tmp_path / "c.png")).shape[1] == 1650
    with (tmp_path / "c.stars.csv").open(encoding="utf-8", newline="") as file:
        assert len(list(csv.DictReader(file))) > 300
    several = run("camera", "calibrate", image, image, "--fov", "43", "--geometry-only", "-o", tmp_path / "d.toml")
    assert (several.exit_code, several.stderr.count("\n")) == (1, 1)
    assert "--geometry-only of several images needs --fit-lens" in several.stderr


def test_a_photograph_without_time_and_site_shows_its_zenith(ground: Path, tmp_path: Path) -> None:
    pytest.importorskip("tetra3rs")
    still = (ground / "still.csv").read_text(encoding="utf-8")
    (tmp_path / "low.csv").write_text(still.replace(",-4,3,70,", ",-4,65,70,"), encoding="utf-8")
    frames = ("export", tmp_path / "low.csv", "-o", tmp_path / "frames", "-c", ground / "camera.toml", "--frames", "1")
    assert run(*frames, "--start", "5", "--exposure", "0.5").exit_code == 0
    words = ("camera", "calibrate", tmp_path / "frames/frame_000000.png", "--fov", "43", "--geometry-only", "--json")

    result = run(*words, "-o", tmp_path / "low.toml")

    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    [note] = (note for note in found["notes"] if "refraction shows the zenith" in note)
    place, [truth] = found["identification"], (tmp_path / "frames/truth.jsonl").read_text().splitlines()
    up = json.loads(truth)["up_camera"]
    assert 0 < place["zenith_error_deg"] < 5
    assert place["altitude_deg"] == pytest.approx(np.rad2deg(np.arcsin(up[2])), abs=4 * place["zenith_error_deg"])
    assert place["fx_px"] == pytest.approx(1000.0, rel=2e-4)
    latitude_deg = float(note.split("declination ")[1].split(" deg")[0])
    assert latitude_deg == pytest.approx(-34.93, abs=4 * place["zenith_error_deg"] + 0.5)


def test_an_all_sky_camera_is_never_fitted_as_a_pinhole(tmp_path: Path) -> None:
    pytest.importorskip("tetra3rs")
    image = photograph(tmp_path / "allsky.png", all_sky().image.pixels_dn)
    # The photograph has no air, whose refraction would be sought for half of the time.
    (tmp_path / "airless.toml").write_text("[sky]\nrefraction = false\n", encoding="utf-8")
    given = (
        *("camera", "calibrate", image, "-c", tmp_path / "airless.toml", "--fov", "140", "--exposure", "30"),
        *("-o", tmp_path / "sky.toml"),
    )

    refused = run(*given, "--lens", "none")
    assert (refused.exit_code, refused.stderr.count("\n")) == (1, 1), refused.output
    assert "use --lens auto" in refused.stderr
    assert not list(tmp_path.glob("sky*"))

    result = run(*given, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["identification"]["lens"] == "fisheye"
    assert found["identification"]["median_px"] < 0.36
    assert found["identification"]["centroid_noise_px"] == pytest.approx(0.07, abs=0.03)
    assert found["identification"]["field_of_view_deg"] == pytest.approx(180, abs=1)
    assert found["identification"]["max_angle_deg"] == pytest.approx(90, abs=0.5)
    assert Config.load(tmp_path / "sky.toml").sensor().psf_sigma_px == pytest.approx(1.2, rel=0.02)


def test_a_camera_in_portrait_orientation_matches_the_rotated_config(ground: Path, tmp_path: Path) -> None:
    frame = cv2.imread(str(ground / "frames" / "frame_000000.png"), cv2.IMREAD_UNCHANGED)
    upright = photograph(tmp_path / "upright.png", cv2.rotate(frame, cv2.ROTATE_90_CLOCKWISE))
    known = ("--utc", UTC, *PLACE, *ATTITUDE, "-c", ground / "camera.toml", "--exposure", "0.5")
    result = run("camera", "calibrate", upright, "-o", tmp_path / "found.toml", "--json", *known)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert any("turned by" in note for note in found["notes"])
    assert found["identification"]["fx_px"] == pytest.approx(1000.0, rel=1e-3)


def test_several_images_are_identified_by_the_flight_s_attitudes(ground: Path, tmp_path: Path) -> None:
    frame = (ground / "frames" / "frame_000000.png").read_bytes()
    images = [tmp_path / "one.png", tmp_path / "two.png"]
    for image in images:
        image.write_bytes(frame)
    result = run(
        *("camera", "calibrate", *images, "-c", ground / "camera.toml", "--exposure", "0.5", "-o", tmp_path / "c.toml"),
        *("--flight", ground / "still.csv", "--utc", UTC, "--utc", UTC, "--extinction", "0.2"),
    )
    assert result.exit_code == 0, result.output
    combined = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert combined["extinction"]["zenith_extinction_mag"] == 0.2
    assert result.output.count("above the air: 0.200 mag per air mass (as given") == 1
    for image in images:
        report = json.loads((tmp_path / f"c.{image.stem}.json").read_text(encoding="utf-8"))
        assert report["identification"]["method"] == "by attitude"
        assert report["identification"]["altitude_deg"] == pytest.approx(85.0, abs=1)


def test_a_calibration_has_the_name_that_was_asked_for(tmp_path: Path) -> None:
    written = write_files(tmp_path / "C.TOML", {"C.toml": b"sensor", "C.png": b"report"})

    assert written == [tmp_path / "C.TOML", tmp_path / "C.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["C.TOML", "C.png"]


def test_a_photograph_with_the_name_of_the_report_is_not_replaced(tmp_path: Path) -> None:
    image = tmp_path / "sky.png"
    image.write_bytes(b"as it was")

    with pytest.raises(CalibrationError, match="would be replaced by the report of"):
        write_files(tmp_path / "sky.toml", {"sky.toml": b"", "sky.json": b"", "sky.png": b"the report"}, [image])

    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"sky.png": b"as it was"}
