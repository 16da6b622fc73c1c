"""Positions of detected stars against those of sep, the library form of Source Extractor."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from glstar.calibrate.photo.detection import DetectedStars, detect_stars
from glstar.calibrate.photo.photograph import Photograph, read_image
from glstar.camera.sensor.sensor import Sensor
from tests.support.starphotos import StarPhoto

sep = pytest.importorskip("sep")

# Farther from any other detection than this a star is isolated, px.
ISOLATED_PX = 12.0
REAL = Path(__file__).parents[3] / "shared" / "images" / "cisne_02sec.jpg"


def sep_positions(image: Photograph) -> tuple[np.ndarray, np.ndarray]:
    """Return sep's windowed positions (n, 2), px, and its fluxes (n,), of objects above five times the noise."""
    pixels = np.ascontiguousarray(image.pixels_dn)
    background = sep.Background(pixels)
    above = pixels - background
    objects = sep.extract(above, 5.0, err=background.globalrms)
    sigma_px = 2.0 / 2.35 * np.sqrt(np.median(objects["npix"]) / np.pi)
    x, y, _ = sep.winpos(above, objects["x"], objects["y"], sigma_px)
    return np.column_stack([x, y]), objects["flux"]


def distances_px(detected: DetectedStars, image: Photograph, *, min_snr: float) -> tuple[np.ndarray, float]:
    """Return the distances of bright isolated detections from sep's objects, and the fraction that sep has too."""
    xy, _ = sep_positions(image)
    # Close pairs are left out: sep measures their common centroid.
    isolated = KDTree(detected.xy_px).query(detected.xy_px, k=2)[0][:, 1] > ISOLATED_PX
    bright = (detected.signal_to_noise > min_snr) & ~detected.saturated & isolated
    distance_px, _ = KDTree(xy).query(detected.xy_px[bright])
    near = distance_px < 1.5
    return distance_px[near], float(near.mean())


def test_positions_on_a_rendered_frame_agree_with_sep() -> None:
    drawn = StarPhoto.of(Sensor(reference_peak_dn=1500.0, psf_sigma_px=1.2))

    distance_px, fraction = distances_px(detect_stars(drawn.image), drawn.image, min_snr=30)

    assert len(distance_px) > 60
    assert fraction > 0.95
    assert np.median(distance_px) < 0.03  # px
    assert np.quantile(distance_px, 0.95) < 0.1  # px


@pytest.mark.skipif(not REAL.exists(), reason="the photographs are not on this machine")
def test_positions_on_a_real_photograph_agree_with_sep() -> None:
    image = read_image(REAL)

    distance_px, fraction = distances_px(detect_stars(image), image, min_snr=30)

    assert len(distance_px) > 60
    assert fraction > 0.9
    assert np.median(distance_px) < 0.12  # px
    assert np.quantile(distance_px, 0.95) < 0.3  # px
