"""Beyond the limit of a lens the image is dark, whatever the light of the sky."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.config import Config
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.prepare import prepare_export
from glstar.render.effects.sky import beyond_lens
from glstar.render.scene.scene import Scene
from glstar.system.resources import asset

Settings = dict[str, Any]

LIMIT_DEG, FOCAL_PX, BLACK_DN = 88.0, 60.0, 200.0
SIZE: Settings = {"camera.width_px": 320, "camera.height_px": 240}
FISHEYE = SIZE | {
    "camera.fx_px": FOCAL_PX,
    "camera.fy_px": FOCAL_PX,
    "camera.lens": "fisheye",
    "camera.distortion": [0.0, 0.0, 0.0, 0.0],
    "camera.max_angle_deg": LIMIT_DEG,
}
# Its polynomial turns back at 1 / sqrt(0.9) of the focal length.
BARREL = SIZE | {
    "camera.fx_px": 150.0,
    "camera.fy_px": 150.0,
    "camera.lens": "plumb_bob",
    "camera.distortion": [-0.3, 0.0, 0.0, 0.0],
}
ELECTRONS: Settings = {
    "sensor.noise": "electrons",
    "sensor.vmag_0_e_per_s": 5e4,
    "sensor.sky_e_per_s": 3000.0,
    "sensor.bit_depth": 12,
    "sensor.black_level_dn": BLACK_DN,
}
NATURAL = ELECTRONS | {"sky.preset": "full"}
CLOUD: Settings = {"cloud.coverage": 0.5, "cloud.scale_m": 600.0}
SKYLINE = "0,10\n90,20\n180,5\n270,15\n"
BACKGROUNDS: dict[str, Settings] = {
    "paper": {"sensor.sky_mean_dn": 40.0},
    "electrons": ELECTRONS,
    "map": {"sensor.sky_mean_dn": 40.0, "sensor.sky_map": "map.npy"},
    "map of electrons": ELECTRONS | {"sensor.sky_map": "map.npy"},
    "natural": NATURAL,
    "twilight": NATURAL | {"flight.utc_start": "2023-07-02T08:40:00Z", "sensor.vmag_0_e_per_s": 500.0},
    "cloud": NATURAL | CLOUD,
    "flare": NATURAL
    | {
        "flare.scatter": 0.02,
        "flare.ghost_fraction": 1e-3,
        "flare.streak_fraction": 1e-3,
        "flare.lamp_mag": -12.0,
        "flare.lamp_altitude_deg": 60.0,
    },
    "skyline": NATURAL | {"sky.horizon": "skyline.csv"},
    "skyline and cloud": NATURAL | CLOUD | {"sky.horizon": "skyline.csv"},
}
VIGNETTINGS: dict[str, Settings] = {
    "none": {},
    "cos4": {"lens.vignetting": "cos4"},
    "polynomial": {"lens.vignetting": "polynomial", "lens.vignetting_r2": -0.3},
    "flat": {"lens.vignetting": "flat", "lens.vignetting_file": "flat.npy"},
}


def scene_of(settings: Settings, folder: Path) -> Scene:
    np.save(folder / "map.npy", np.ones((24, 32)))
    np.save(folder / "flat.npy", np.ones((240, 320)))
    (folder / "skyline.csv").write_text(f"azimuth_deg,altitude_deg\n{SKYLINE}")
    in_folder = {
        key: str(folder / value) if str(value).endswith((".npy", ".csv")) else value for key, value in settings.items()
    }
    config, flight = Config().override(**in_folder), asset("adelaide.BIN")
    options = ExportOptions(start_s=10.0, frames=1, seed=1)
    return prepare_export(config, flight, folder, options).task.frames.compose(0).scene


def is_beyond(scene: Scene) -> np.ndarray[Any, Any]:
    """Return which pixels are beyond the limit, by the distance from the principal point: (rows, columns)."""
    camera = scene.camera
    x, y = np.meshgrid(np.arange(camera.width_px) - camera.cx_px, np.arange(camera.height_px) - camera.cy_px)
    assert camera.lens is not None
    # Of the barrel lens, r - 0.3 r^3 is largest at r = 1 / sqrt(0.9).
    limit = np.deg2rad(LIMIT_DEG) if camera.lens.model == "fisheye" else 2 / 3 / np.sqrt(0.9)
    return np.asarray(np.hypot(x, y) > limit * camera.fx_px)


@pytest.mark.parametrize(
    ("sky", "vignetting", "lens"),
    [
        *((sky, "none", lens) for sky in BACKGROUNDS for lens in (FISHEYE, BARREL)),
        # Vignetting acts on the other backgrounds as it does on skyline and cloud; every pair of two is here.
        *(
            (sky, vignetting, (FISHEYE, BARREL)[(row + column) % 2])
            for row, sky in enumerate(("paper", "electrons", "skyline and cloud"))
            for column, vignetting in enumerate(("cos4", "polynomial", "flat"))
        ),
    ],
)
def test_no_light_is_beyond_the_image_circle(renderer, tmp_path, sky, vignetting, lens):
    scene = scene_of(lens | BACKGROUNDS[sky] | VIGNETTINGS[vignetting], tmp_path)

    renderer.develop(scene, seed=1, noiseless=True)
    pixels, beyond = renderer.read().frame().pixels, is_beyond(scene)

    dark_dn = BLACK_DN if scene.sensor.electrons else 0
    assert 1000 < beyond.sum() < beyond.size - 1000
    assert np.unique(pixels[beyond]).tolist() == [dark_dn]
    assert np.mean(pixels[~beyond] > dark_dn) > 0.99


@pytest.mark.parametrize("sky", ["electrons", "natural", "cloud"])
def test_the_sky_has_its_brightness_up_to_the_image_circle(renderer, tmp_path, sky):
    """It is that of a lens with a larger limit, but for pixels at the horizon, where sky and ground meet."""
    scene = scene_of(FISHEYE | BACKGROUNDS[sky] | {"sensor.bit_depth": 16}, tmp_path)
    larger = scene_of(FISHEYE | BACKGROUNDS[sky] | {"sensor.bit_depth": 16, "camera.max_angle_deg": 110.0}, tmp_path)

    images = []
    for each in (scene, larger):
        renderer.develop(each.with_visible(slice(0)), seed=1, noiseless=True)
        images.append(renderer.read().frame().pixels.astype(np.float64))

    ratio = images[0][~is_beyond(scene)] / images[1][~is_beyond(scene)]
    assert np.mean(np.abs(ratio - 1) < 0.03) > 0.999


LENSES = (
    Lens("plumb_bob", (-0.3, 0.0, 1e-3, -1e-3)),
    Lens("fisheye", (0.0, 0.0, 0.0, 0.0), max_angle_rad=1.2),
    Lens("plumb_bob", (0.1, 0.0, 0.0, 0.0)),
)
FOCAL_LENGTHS_PX = (100.0, 130.0, 170.0, 189.7, 189.8, 189.9, 300.0)


@pytest.mark.parametrize(
    ("focal_px", "centre_px", "lens"),
    [
        *((focal_px, (159.5, 119.5), lens) for focal_px in FOCAL_LENGTHS_PX for lens in LENSES),
        # Off the middle: every pair of two.
        *(
            (focal_px, centre_px, LENSES[(row + column) % 3])
            for row, focal_px in enumerate(FOCAL_LENGTHS_PX)
            for column, centre_px in enumerate([(20.0, 230.0), (-40.0, 60.0)])
        ),
    ],
)
def test_a_lens_that_shows_the_border_shows_all_pixels(focal_px, centre_px, lens):
    camera = Camera(320, 240, focal_px, focal_px, *centre_px, 0.0, lens)
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    unseen = np.isnan(camera.unit_vectors(np.stack([x, y], axis=-1))[..., 0])

    beyond = beyond_lens(camera)

    assert (beyond is None) == (not unseen.any())
    np.testing.assert_array_equal(np.zeros_like(unseen) if beyond is None else beyond, unseen)
