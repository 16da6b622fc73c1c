"""False identifications on hazy, noisy wide-field images: ``poe bench false-stars``.

Images are drawn by `tests.plainphotos.hazy` (50 deg, barrel distortion, patchy haze, hot pixels) over many seeds and
calibrated as `glstar camera calibrate --fov 50` does, or from an attitude with an error of two degrees.  Prints a line
for each image with stars more than 3 px from their positions by the true camera, then the sum.

    --images N     images of each kind, 40 by default
    --attitude     from a rough attitude instead of the pattern
"""

import argparse

import numpy as np

from glstar.calibrate.geometry.lensfit import fit_lens
from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.identify.lost import identify_lost
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.photo.detection import detect_stars
from glstar.errors import CalibrationError
from glstar.rotation import about_x, about_y, about_z
from tests.support.plainphotos import REFERENCE, focal_px, hazy, pinhole_camera
from tests.support.starphotos import ALL_STARS

# Limiting magnitude without haze, and hot pixels: about an eighth of them are detected as stars.
KINDS = ((4.5, 1000), (5.0, 2000), (5.5, 4000), (6.2, 4000))
FALSE_PX = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--attitude", action="store_true")
    given = parser.parse_args()
    for kind, (limit_vmag, false_stars) in enumerate(KINDS):
        solved = stars = false = 0
        expected, focal_error = 0.0, []
        for seed in range(1000 * kind, 1000 * kind + given.images):
            photo = hazy(seed, limit_vmag=limit_vmag, false_stars=false_stars)
            detected, camera = detect_stars(photo.image), pinhole_camera(photo, 50)
            try:
                if given.attitude:
                    a, b, c = np.deg2rad(np.random.default_rng(seed).uniform(-2, 2, 3))
                    near = PlateSolution(camera, about_z(c) @ about_y(b) @ about_x(a) @ photo.C_camera_eq)
                    found = identify_near(detected, REFERENCE, near, focal_known=False)
                else:
                    found = identify_lost(detected, REFERENCE, ALL_STARS, camera)
                matches = fit_lens(detected, REFERENCE, found)
            except CalibrationError:
                continue
            far = int((photo.off_px(matches) > FALSE_PX).sum())
            solved, stars, false = solved + 1, stars + len(matches), false + far
            expected += matches.expected_by_chance
            focal_error.append(matches.solution.camera.fx_px / focal_px(photo) - 1)
            if far:
                print(f"seed {seed}: {far} of {len(matches)} stars false, {matches.rms_px:.2f} px rms", flush=True)
        error = 100 * np.array(focal_error or [np.nan])
        print(
            f"limit {limit_vmag} mag, {false_stars} hot pixels: {solved} of {given.images} images solved, {false} of"
            f" {stars} stars false ({expected:.1f} expected), f off by {np.sqrt(np.mean(error**2)):.3f} % rms,"
            f" {np.abs(error).max():.3f} % at most",
            flush=True,
        )


if __name__ == "__main__":
    main()
