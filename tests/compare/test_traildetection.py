"""Detected trails against the truth of rendered frames, and on images made pixel by pixel."""

import numpy as np
import pytest
from scipy.special import erf

import glstar as gs

SIGMA_PX, SKY_DN, NOISE_DN = 1.2, 16.0, 3.0


def line_image(ends_px, flux_dn, *, bend_px=0.0, seed=0, shape=(240, 320)):
    """Return a uniform trail along a parabola, from ten thousand points integrated over pixels."""
    (x0, y0), (x1, y1) = ends_px
    t = (np.arange(10_000) + 0.5) / 10_000
    normal = np.array([-(y1 - y0), x1 - x0]) / max(np.hypot(x1 - x0, y1 - y0), 1e-9)
    x = x0 + t * (x1 - x0) + 4 * bend_px * t * (1 - t) * normal[0]
    y = y0 + t * (y1 - y0) + 4 * bend_px * t * (1 - t) * normal[1]
    edges = [np.arange(side + 1) - 0.5 for side in shape]
    root = np.sqrt(2) * SIGMA_PX
    columns = np.diff(erf((edges[1][:, np.newaxis] - x) / root), axis=0) / 2
    rows = np.diff(erf((edges[0][:, np.newaxis] - y) / root), axis=0) / 2
    signal = flux_dn / t.size * rows @ columns.T
    noise = np.random.default_rng(seed).normal(SKY_DN, NOISE_DN, shape)
    return np.clip(np.rint(signal + noise), 0, 4095).astype(np.uint16)


@pytest.mark.parametrize(
    "ends", [((60.3, 80.7), (131.2, 113.4)), ((200.0, 40.0), (200.0, 150.0)), ((50, 60), (80, 60))]
)
def test_the_ends_of_a_straight_trail_are_found(ends):
    flux_dn = 90.0 * np.hypot(*np.subtract(*ends))

    trails = gs.detect_trails(line_image(ends, flux_dn), psf_sigma_px=SIGMA_PX)

    assert len(trails) == 1
    found = trails.ends_px[0]
    is_reversed = np.linalg.norm(found[0] - ends[0]) > np.linalg.norm(found[0] - ends[1])
    np.testing.assert_allclose(found[::-1] if is_reversed else found, ends, rtol=0, atol=0.25)
    np.testing.assert_allclose(trails.middle_px[0], np.mean(ends, axis=0), rtol=0, atol=0.15)
    assert trails.flux_dn[0] == pytest.approx(flux_dn, rel=0.04)


def test_the_middle_of_a_bent_trail_lies_on_it_and_its_centroid_does_not():
    trails = gs.detect_trails(line_image(((60.0, 120.0), (180.0, 120.0)), 15_000.0, bend_px=4.0), psf_sigma_px=SIGMA_PX)

    assert len(trails) == 1
    # A parabola's sagitta of 4 px: the mean is 2/3 of it.
    np.testing.assert_allclose(trails.middle_px[0], [120.0, 124.0], rtol=0, atol=0.25)
    np.testing.assert_allclose(trails.centroid_px[0], [120.0, 120.0 + 8 / 3], rtol=0, atol=0.25)


def test_a_round_star_is_a_point():
    trails = gs.detect_trails(line_image(((100.3, 90.6), (100.3, 90.6)), 900.0), psf_sigma_px=SIGMA_PX)

    assert len(trails) == 1
    np.testing.assert_allclose(trails.centroid_px[0], [100.3, 90.6], rtol=0, atol=0.1)
    assert trails.length_px[0] == 0
    assert trails.flux_dn[0] == pytest.approx(900.0, rel=0.08)


def test_noise_alone_has_no_trails():
    found = [len(gs.detect_trails(line_image(((9, 9), (9, 9)), 0.0, seed=seed))) for seed in range(4)]

    assert sum(found) <= 1


def test_a_trail_that_leaves_the_image_is_marked():
    trails = gs.detect_trails(line_image(((250.0, 100.0), (360.0, 140.0)), 12_000.0), psf_sigma_px=SIGMA_PX)

    assert trails.at_edge.tolist() == [True]


def test_trails_of_a_turning_camera_are_where_the_truth_has_them():
    with gs.Environment(gs.Config().override(**{"mount.pitch_deg": 40.0}), "fly:spin?yaw_rate_deg_per_s=8") as fly:
        frame, _, truth = fly.reset(1)

    trails = gs.detect_trails(frame.pixels)
    bright = [star for star in truth["stars"] if star["flux_dn"] > 1500 and star["in_frame"] == 1]
    assert len(bright) >= 3
    for star in bright:
        middle = np.array([star["x_px"], star["y_px"]])
        distance_px = np.linalg.norm(trails.middle_px - middle, axis=1)
        nearest = distance_px.argmin()
        assert distance_px[nearest] < 1.0
        true_length_px = np.hypot(*np.subtract(star["end"], star["start"]))
        assert trails.length_px[nearest] == pytest.approx(true_length_px, rel=0, abs=2.0)
