"""Calibration from several photographs of one camera: the common sensor, and the brightness of each star."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.sensor.calibration import Calibration, calibrate
from glstar.calibrate.sensor.combine import (
    Observations,
    _error_mag,
    _measured_well,
    combine,
    draw_combined,
    solve_brightness,
)
from glstar.camera.sensor.sensor import Sensor
from glstar.cli import app
from glstar.config import Config
from glstar.errors import CalibrationError
from tests.support.reference import light_of
from tests.support.starphotos import EXPOSURE_S, StarPhoto

SENSOR = Sensor(reference_peak_dn=1500.0, psf_sigma_px=1.1, sky_mean_dn=20.0)
# Standard deviation of the stars' camera magnitudes minus V.
SPREAD_MAG = 0.3


def colours(count: int) -> np.ndarray:
    return np.random.default_rng(7).normal(0, SPREAD_MAG, count)


def part(number: int, sensor: Sensor = SENSOR, *, fov_deg: float = 40.0) -> tuple[StarPhoto, Calibration]:
    """Return one of several photographs, separated by a few degrees, of stars whose brightness differs from V."""
    drawn = StarPhoto.of(
        sensor,
        seed=number,
        fov_deg=fov_deg,
        yaw_rad=1.2 + 0.05 * number,
        roll_rad=0.05 - 0.03 * number,
        colours=colours,
    )
    drawn = replace(drawn, image=replace(drawn.image, path=Path(f"ground{number}.png")))
    stars = detect_stars(drawn.image)
    matches = identify_near(stars, drawn.reference, drawn.solution)
    return drawn, calibrate(drawn.image, stars, drawn.reference, matches, method="by attitude", exposure_s=EXPOSURE_S)


@cache
def three() -> tuple[tuple[StarPhoto, Calibration], ...]:
    # The third image has a haze that absorbs a quarter of the flux, and a sky 1.5 times as bright.
    hazy = replace(SENSOR, reference_peak_dn=0.75 * SENSOR.reference_peak_dn, sky_mean_dn=30.0)
    return part(1), part(2), part(3, hazy)


def test_star_effects_and_image_effects_are_separated() -> None:
    rng = np.random.default_rng(3)
    stars, images = 300, 5
    off_mag, zero_mag = rng.normal(0, 0.25, stars), np.array([0.0, 0.4, -0.1, 0.0, 0.05])
    image, star = (array.ravel() for array in np.meshgrid(np.arange(images), np.arange(stars), indexing="ij"))
    seen = rng.random(image.size) < 0.6
    image, star = image[seen], star[seen]
    error_mag = np.full(image.size, 0.05)
    measured = off_mag[star] + zero_mag[image] + rng.normal(0, error_mag)

    off, error, zero, spread = solve_brightness(Observations(image, star, measured, error_mag), stars, images)

    count = np.bincount(star, minlength=stars)
    np.testing.assert_allclose(zero - zero[0], zero_mag - zero_mag[0], rtol=0, atol=0.015)  # mag
    assert spread == pytest.approx(0.25, rel=0.15)
    often = count >= 4
    left = off[often] - off_mag[often]
    assert np.std(left) < 0.03  # mag, of 0.25
    assert np.std(left / error[often]) == pytest.approx(1.0, abs=0.2)
    assert (off[count == 0] == 0).all()


def test_a_star_measured_badly_gets_a_small_weight() -> None:
    star = np.arange(40)
    measured = np.where(star < 39, np.random.default_rng(1).normal(0, 0.1, 40), 1.0)
    error_mag = np.where(star < 39, 0.02, 0.5)
    off, error, _, spread = solve_brightness(Observations(np.zeros(40, dtype=int), star, measured, error_mag), 40, 1)
    assert abs(off[39]) < 0.1
    assert error[39] == pytest.approx(spread, rel=0.1)


def test_several_images_give_one_sensor_and_a_camera_magnitude_per_star() -> None:
    combined = combine(tuple(found for _, found in three()))
    sensor = combined.sensor
    assert sensor.peak_dn([3.0], EXPOSURE_S)[0] == pytest.approx(1500, rel=0.06)  # of stars that differ by 0.3 mag
    assert sensor.psf_sigma_px == pytest.approx(1.1, rel=0.01)
    assert sensor.sky_mean_dn == pytest.approx(20, abs=0.1)  # DN
    np.testing.assert_allclose(
        combined.fainter_mag - combined.fainter_mag[0], [0, 0, -2.5 * np.log10(0.75)], rtol=0, atol=0.02
    )
    assert combined.spread_mag == pytest.approx(SPREAD_MAG, rel=0.15)
    assert combined.repeat_mag < 0.08
    assert any("ground3.png is 0.3" in note.text and "fainter" in note.text for note in combined.notes)
    assert any("ground3.png has a sky of 30" in note.text for note in combined.notes)

    drawn = three()[0][0]
    true_mag = dict(
        zip(drawn.scene.stars.star_id.tolist(), (drawn.scene.stars.camera_mag - drawn.scene.stars.vmag), strict=True)
    )
    table = combined.table
    left = table.off_mag - np.array([true_mag[star_id] for star_id in table.star_id.tolist()])
    left -= np.median(left)
    assert np.std(left[table.images > 1]) < 0.06  # mag; V is wrong by 0.3
    # The stated errors are slightly too wide, because they include pixel differences of 0.02 mag that are absent here.
    assert 0.5 < np.std(left[table.images > 1] / table.error_mag[table.images > 1]) < 1.1


def test_the_stated_error_of_a_star_is_how_its_brightness_scatters_from_image_to_image() -> None:
    drawn = StarPhoto.of(SENSOR, size=(500, 400), fov_deg=30)
    light_dn = light_of(drawn.scene)
    measured: dict[int, list[tuple[float, float]]] = {}
    for seed in range(8):
        noise_dn = np.random.default_rng(100 + seed).normal(SENSOR.sky_mean_dn, SENSOR.sky_std_dn, light_dn.shape)
        image = drawn.with_pixels(np.floor(np.clip(light_dn + noise_dn, 0, 255) + 0.5))
        stars = detect_stars(image)
        found = calibrate(
            image,
            stars,
            drawn.reference,
            identify_near(stars, drawn.reference, drawn.solution),
            method="",
            exposure_s=0.5,
        )
        for k in np.flatnonzero(_measured_well(found)):
            mag = -2.5 * np.log10(found.stars.peak_dn[k])
            measured.setdefault(int(found.stars.star_id[k]), []).append((mag, _error_mag(found)[k]))

    scatter, stated = [], []
    for pairs in measured.values():
        mag, error_mag = np.array(pairs).T
        # The error due to noise, without the 0.02 mag of pixel differences.
        noise_mag = np.sqrt(max(np.mean(error_mag**2) - 0.02**2, 0.0))
        if len(mag) == 8 and noise_mag > 0.02:
            scatter.append(np.var(mag, ddof=1))
            stated.append(noise_mag**2)
    assert len(scatter) > 40
    # z-scores, root mean square; their standard error is 0.03.
    assert np.sqrt(np.mean(np.array(scatter) / np.array(stated))) == pytest.approx(1.05, abs=0.15)


def test_the_simulator_takes_the_table_and_draws_each_star_as_the_camera_saw_it(tmp_path: Path) -> None:
    combined = combine(tuple(found for _, found in three()))
    (tmp_path / "c.toml").write_text(combined.to_toml("c.brightness.csv"), encoding="utf-8")
    (tmp_path / "c.brightness.csv").write_text(combined.table.to_csv(), encoding="utf-8")
    config = Config.load(tmp_path / "c.toml")
    drawn, found = three()[0]
    brightness = config.star_brightness()
    assert brightness is not None
    magnitudes = brightness.magnitudes("bsc5", drawn.scene.stars.star_id, drawn.scene.stars.vmag)
    row = {int(star_id): k for k, star_id in enumerate(drawn.scene.stars.star_id)}
    used = found.brightness.used
    simulated = config.sensor().peak_dn(
        [magnitudes[row[int(star_id)]] for star_id in found.stars.star_id[used]], EXPOSURE_S
    )
    by_v = config.sensor().peak_dn(found.stars.vmag[used], EXPOSURE_S)

    def scatter_mag(peak_dn: np.ndarray) -> float:
        return float(np.std(2.5 * np.log10(found.stars.peak_dn[used] / peak_dn)))

    assert scatter_mag(by_v) == pytest.approx(SPREAD_MAG, rel=0.2)
    assert scatter_mag(simulated) < SPREAD_MAG / 4


def test_the_report_of_several_images_is_an_image_file() -> None:
    page = cv2.imdecode(
        np.frombuffer(draw_combined(combine(tuple(found for _, found in three()))), dtype=np.uint8), cv2.IMREAD_COLOR
    )
    assert page.shape[1] == 1650
    assert page.std() > 20


def test_two_cameras_are_not_combined() -> None:
    one = three()[0][1]
    other = part(4, fov_deg=44.0)[1]
    with pytest.raises(CalibrationError, match="not one lens"):
        combine((one, other))
    deeper = replace(other, image=replace(other.image, bit_depth=12))
    with pytest.raises(CalibrationError, match="not one camera"):
        combine((one, deeper))


def test_the_command_takes_several_images(tmp_path: Path, kept_patterns: None) -> None:
    pytest.importorskip("tetra3rs")
    images = []
    for drawn, found in three()[:2]:
        images.append(str(tmp_path / found.image.path.name))
        cv2.imwrite(images[-1], drawn.image.pixels_dn.astype(np.uint8))
    output = tmp_path / "c.toml"

    def run(*more: str) -> tuple[int, str, str]:
        result = CliRunner().invoke(app, ["camera", "calibrate", *images, "--fov", "40", "-o", str(output), *more])
        return result.exit_code, result.stdout, result.stderr

    code, output_text, error = run("--exposure", "0.5")
    assert code == 0, error
    assert "stars differ from V by" in output_text
    for name in ("c.brightness.csv", "c.png", "c.json", "c.ground1.png", "c.ground2.stars.csv"):
        assert (tmp_path / name).exists(), name
    assert len(json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))["images"]) == 2
    assert Config.load(output).star_brightness() is not None

    for more, words in (
        (("--exposure", "0.5", "--utc", "2024-03-10T11:00:05Z"), "--utc is given 1 times for 2 images"),
        (("--exposure", "0.5", "--labels", "stars.csv"), "--labels belong to one image"),
        (("--exposure", "0.5", "--criterion", "paper"), "takes one image"),
        (("--exposure", "1", "--exposure", "2", "--exposure", "3"), "given 3 times for 2 images"),
        ((), f"{images[0]}: does not state its exposure"),
    ):
        code, _, error = run(*more)
        assert (code, error.count("\n")) == (1, 1)
        assert words in error
