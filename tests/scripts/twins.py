"""Twins of real photographs: calibrate an image, simulate the same stars, and compare the two.

    python -m tests.scripts.twins IMAGE:EXPOSURE_S:FOV_DEG ... [--plain] [-o DIRECTORY]

Prints the Kolmogorov-Smirnov distance of the sky's values, the mean absolute error of the stars' peaks, the ratio of
their widths, and writes each pair side by side.  ``--plain`` simulates Gaussian stars instead of the measured shape.
"""

import argparse
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.calibrate import Calibration
from glstar.calibrate.shape import star_shapes
from glstar.camera.exposure import Exposure
from glstar.cli.calibrateoptions import CalibrateOptions
from glstar.cli.calibraterun import calibrate_images
from glstar.render.culling import DrawList
from glstar.render.opengl import GLRenderer
from glstar.render.pointing import Pointing
from glstar.render.scene import Scene
from glstar.render.trailmodels import SubExposures
from glstar.sky.site import Site

Float = NDArray[np.float64]


def calibrated(path: Path, exposure_s: float, fov_deg: float, directory: Path, *, shape: bool) -> Calibration:
    nowhere = {"--lat": None, "--lon": None}
    unknown = {"--yaw": None, "--pitch": None, "--roll": None}
    options = CalibrateOptions(
        None,
        fov_deg,
        [exposure_s],
        None,
        nowhere,
        unknown,
        None,
        None,
        "value",
        None,
        "median",
        "auto",
        False,
        False,
        shape,
    )
    return cast(Calibration, calibrate_images([path], options, directory / f"{path.stem}.toml", None))


def twin_of(calibration: Calibration, renderer: GLRenderer) -> Float:
    """Return the simulated image of the same stars, DN."""
    reference, solution = calibration.reference, calibration.matches.solution
    sensor, exposure_s = calibration.sensor, calibration.sensor.reference_exposure_s
    camera = solution.camera
    shown = np.sort(calibration.matches.predicted).astype(np.int32)
    peak_dn = sensor.peak_dn(reference.stars.camera_mag[shown], exposure_s)
    radius_px = camera.max_magnification * sensor.truncation_radius_px(peak_dn)

    def pointing(times: int) -> Pointing:
        C = np.repeat(solution.C_camera_eq[np.newaxis], times, axis=0)
        zenith, velocity = (
            np.repeat(one[np.newaxis], times, axis=0) for one in (reference.zenith_eq, reference.velocity_eq)
        )
        if not zenith.any():
            zenith = C[:, 2]  # without a horizon
        return Pointing(C, zenith, velocity, reference.refraction_scale)

    scene = Scene(
        stars=reference.stars,
        draw_list=DrawList(shown, radius_px),
        trails=SubExposures(pointing(1)),
        camera=camera,
        sensor=sensor,
        exposure=Exposure(0.0, exposure_s, trail="sprites"),
        site=Site(0.0, 0.0, 0.0),
        C_camera_body=np.eye(3),
        q_body_ned=np.array([1.0, 0.0, 0.0, 0.0]),
        shutter=pointing(3),
    )
    return renderer.render(scene, seed=1).pixels.astype(np.float64)


def compared(calibration: Calibration, twin: Float) -> dict[str, float]:
    """Return the differences of an image and its twin."""
    real, stars = calibration.image.pixels_dn, calibration.stars
    xy_px = calibration.detected.xy_px
    away = np.ones(real.shape, np.uint8)
    for x, y in np.rint(np.concatenate([xy_px, calibration.matches.predicted_xy_px])).astype(int):
        cv2.circle(away, (int(x), int(y)), 8, 0, -1)
    sky = [np.sort(image[away > 0]) for image in (real, twin)]
    levels = np.unique(np.concatenate([sky[0][::50], sky[1][::50]]))
    below = [np.searchsorted(one, levels, side="right") / len(one) for one in sky]
    used = calibration.brightness.used
    at = np.rint(
        calibration.matches.predicted_xy_px[np.isin(calibration.matches.predicted, calibration.matches.star[used])]
    )
    peaks = [peaks_dn(image, at.astype(int)) for image in (real, twin)]
    good = peaks[0] > 3 * calibration.sensor.sky_std_dn
    bright = at[good][np.argsort(-peaks[0][good])][:60]
    widths = []
    for image in (real, twin):
        above = image - np.median(image)
        xx, yy, _ = star_shapes(
            above, image < 0.98 * calibration.image.saturation_dn, bright, calibration.sensor.psf_sigma_px
        )
        widths.append(float(np.sqrt(np.median((xx + yy) / 2))) if len(xx) else np.nan)
    return {
        "stars": float(good.sum()),
        "sky KS": float(np.abs(below[0] - below[1]).max()),
        "peak error %": float(100 * np.mean(np.abs(peaks[1][good] / peaks[0][good] - 1))),
        "width ratio": widths[1] / widths[0],
        "of identified": float(len(stars)),
    }


def peaks_dn(image: Float, xy_px: NDArray[np.intp]) -> Float:
    """Return the largest pixel around each position above the median of its surroundings, DN."""
    found = []
    for x, y in xy_px:
        near = image[max(0, y - 12) : y + 13, max(0, x - 12) : x + 13]
        found.append(image[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].max() - np.median(near))
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", nargs="+")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("-o", "--output", type=Path, default=Path("twins"))
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    with GLRenderer.headless() as renderer:
        for image in given.images:
            name, exposure, fov = image.rsplit(":", 2)
            calibration = calibrated(Path(name), float(exposure), float(fov), given.output, shape=not given.plain)
            if not isinstance(calibration, Calibration):
                print(f"{name}: no sensor: {calibration.notes[0]}")
                continue
            twin = twin_of(calibration, renderer)
            facts = compared(calibration, twin)
            print(f"{Path(name).name}: " + ", ".join(f"{key} {value:.3g}" for key, value in facts.items()), flush=True)
            high = calibration.sensor.sky_mean_dn + 20 * calibration.sensor.sky_std_dn
            pair = np.hstack([calibration.image.pixels_dn, twin])
            low = calibration.sensor.sky_mean_dn - 3 * calibration.sensor.sky_std_dn
            shown = np.clip((pair - low) / (high - low), 0, 1) ** 0.6 * 255
            cv2.imwrite(str(given.output / f"{Path(name).stem}.png"), shown.astype(np.uint8))


if __name__ == "__main__":
    main()
