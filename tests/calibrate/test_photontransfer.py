"""Photon transfer: gain, read noise and maps from dark frames and flat fields of known statistics."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.sensor.photontransfer import photon_transfer
from glstar.cli import app
from glstar.config import Config
from glstar.errors import CalibrationError

GAIN, READ_E, BLACK_DN = 1.7, 4.0, 200.0
SHAPE = (600, 800)
HOT, DEAD = (slice(50, 51), slice(60, 70)), (slice(80, 81), slice(100, 105))


def frames(light_e: float, count: int, seed: int, prnu: float = 0.01) -> list[np.ndarray]:
    """Return frames of Poisson counts with Gaussian read noise, hot and dead pixels."""
    of_camera, rng = np.random.default_rng(1), np.random.default_rng(seed)
    mean_e = light_e * (1 + prnu * of_camera.standard_normal(SHAPE))
    mean_e[DEAD] = 0.0
    offset_e = np.zeros(SHAPE)
    offset_e[HOT] = 300.0
    counts = [rng.poisson(np.maximum(mean_e, 0)) + offset_e + rng.normal(0, READ_E, SHAPE) for _ in range(count)]
    return [np.clip(np.rint(BLACK_DN + GAIN * each), 0, 4095).astype(np.uint16) for each in counts]


def photographs(images: list[np.ndarray]) -> list[Photograph]:
    return [Photograph(Path(f"{k}.png"), image.astype(float), 12, "grey", None) for k, image in enumerate(images)]


def flats() -> list[np.ndarray]:
    return [image for k, level_e in enumerate((300, 800, 1500)) for image in frames(level_e, 2, 100 + k)]


def test_gain_noise_and_defects_are_found() -> None:
    found = photon_transfer(photographs(frames(0.0, 8, 7)), photographs(flats()))

    assert found.dn_per_e == pytest.approx(GAIN, rel=0.005)
    assert abs(found.dn_per_e - GAIN) < 4 * found.dn_per_e_error
    assert found.read_noise_e == pytest.approx(READ_E, rel=0.01)
    assert found.black_level_dn == pytest.approx(BLACK_DN, abs=1.0)
    assert found.hot == 10
    assert found.is_dead[DEAD].all()
    assert found.is_dead.sum() == 5
    assert found.prnu_fraction == pytest.approx(0.01, rel=0.05)
    np.testing.assert_allclose(found.dark_frame_dn[HOT], BLACK_DN + GAIN * 300, rtol=0, atol=6 * GAIN * READ_E)


@pytest.mark.parametrize(("response", "is_dead"), [(0.4, True), (0.6, False)])
def test_a_pixel_is_dead_below_half_of_the_response_of_its_surroundings(response: float, is_dead: bool) -> None:
    images = flats()
    for image in images:
        image[300, 400] = np.rint(BLACK_DN + response * (image[300, 380:420].mean() - BLACK_DN))

    found = photon_transfer(photographs(frames(0.0, 8, 7)), photographs(images))

    assert found.is_dead[300, 400] == is_dead


@pytest.mark.parametrize("brighter_dn", [-80, 8, 120])
def test_a_dark_frame_of_another_exposure_or_gain_is_refused(brighter_dn: int) -> None:
    darks = photographs(frames(0.0, 8, 7))
    darks[3] = replace(darks[3], pixels_dn=darks[3].pixels_dn + brighter_dn)

    with pytest.raises(CalibrationError, match=r"one exposure time, gain and temperature: the level of .*3\.png"):
        photon_transfer(darks)


def test_dark_frames_whose_files_state_different_exposures_are_refused() -> None:
    darks = [replace(dark, exposure_s=0.5) for dark in photographs(frames(0.0, 4, 7))]
    darks[1] = replace(darks[1], exposure_s=1.0)

    with pytest.raises(CalibrationError, match=r"0\.5 s, 1\.png has 1 s"):
        photon_transfer(darks)


def test_a_small_drift_of_the_black_level_is_allowed() -> None:
    darks = photographs(frames(0.0, 8, 7))
    darks[3] = replace(darks[3], pixels_dn=darks[3].pixels_dn + 1)

    assert photon_transfer(darks).black_level_dn == pytest.approx(BLACK_DN, abs=1.0)


def test_dark_frames_alone_have_no_gain() -> None:
    found = photon_transfer(photographs(frames(0.0, 2, 7)))

    assert found.dn_per_e is None
    assert found.read_noise_dn == pytest.approx(GAIN * READ_E, rel=0.01)
    assert "gain_dn_per_e" not in found.keys


@pytest.mark.parametrize(
    ("darks", "lit", "message"),
    [
        (frames(0.0, 1, 7), [], "needs two dark frames or more, and there is 1"),
        (frames(0.0, 2, 7), [np.full((10, 10), 900)], "must be of one size"),
        (
            frames(0.0, 2, 7),
            [frames(200, 1, 5)[0], frames(900, 1, 6)[0]],
            "no two flat fields have the same brightness",
        ),
        (frames(0.0, 2, 7), frames(2200, 2, 5), "no two flat fields have the same brightness below 80 %"),
    ],
)
def test_images_that_cannot_be_used_are_refused(darks: list, lit: list, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        photon_transfer(photographs(darks), photographs(lit))


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    for name, images in (("darks", frames(0.0, 6, 7)), ("flats", flats())):
        (tmp_path / name).mkdir()
        for k, image in enumerate(images):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), image)
    return tmp_path / "darks", tmp_path / "flats"


def test_the_command_writes_keys_and_maps_that_a_config_uses(folders: tuple[Path, Path], tmp_path: Path) -> None:
    darks, lit = map(str, folders)
    output = tmp_path / "sensor.toml"
    args = ["camera", "calibrate", "--darks", darks, "--flats", lit, "-o", str(output), "--bit-depth", "12", "--json"]

    result = CliRunner().invoke(app, args)

    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout.splitlines()[-1])
    assert facts["hot_pixels"] == 10
    assert facts["gain_dn_per_e"] == pytest.approx(GAIN, rel=0.005)
    night = tmp_path / "night.toml"
    night.write_text(
        '[camera]\nwidth_px = 800\nheight_px = 600\nfx_px = 500.0\nfy_px = 500.0\n[sensor]\nfile = "sensor.toml"\n'
    )
    sensor = Config.load(night).sensor()
    assert sensor.electrons.dn_per_e == facts["gain_dn_per_e"]
    assert sensor.effects["sensor.dark_frame"] == str(tmp_path / "sensor.dark.tiff")
    assert sensor.effects["sensor.defect_map"] == str(tmp_path / "sensor.defects.png")


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--flats", "x"], "needs --darks too"),
        (["--darks", "x", "photo.jpg"], "calibrate them separately"),
        ([], "give photographs of the stars, or --darks"),
        (["--darks", "nowhere"], "is no directory of images"),
    ],
)
def test_options_that_do_not_fit_are_refused(args: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["camera", "calibrate", *args])

    assert result.exit_code != 0
    said = " ".join(f"{result.output} {result.exception}".replace("│", " ").split())
    assert message in said
