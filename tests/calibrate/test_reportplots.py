"""The plots of a report: the data that each one holds, read back from its axes."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from glstar.calibrate.identify.platesolution import sidereal_trails
from glstar.calibrate.photo.psf import draw_stars
from glstar.calibrate.sensor.misfit import Measurement, RadialProfile
from glstar.calibrate.sensor.misfitmeasurement import corner_distance
from glstar.calibrate.sensor.report import (
    _brightness,
    _labelled,
    _off_axis,
    _photograph,
    _profile,
    _residuals,
    _show,
    _shrunk,
    _surface,
    _width,
    draw_geometry,
    draw_report,
    simulated,
)
from tests.support.handmade import CAMERA, PLAIN, handmade, with_stars

OFF = np.random.default_rng(5).normal(0, 0.15, 40)


def axes():
    return Figure(figsize=(6, 4)).add_axes((0.1, 0.2, 0.5, 0.25))


def calibration():
    """Return stars of which some are saturated and some not used."""
    part = handmade(OFF)
    number = np.arange(40)
    part = with_stars(part, saturated=number % 7 == 0, blended=number % 9 == 4)
    used = (number % 7 != 0) & (number % 5 != 1)
    return replace(part, brightness=replace(part.brightness, used=used))


def data_of(line) -> np.ndarray:
    return np.array(line.get_data())


def test_stars_are_drawn_by_their_use_over_the_law() -> None:
    part = calibration()
    stars, fit = part.stars, part.brightness
    above, below = axes(), axes()
    _brightness(above, below, part)
    rest = ~fit.used & ~stars.saturated
    for plot, values in ((above, stars.peak_dn), (below, part.off_mag)):
        for line, some in zip(plot.get_lines()[:3], (rest, stars.saturated, fit.used), strict=True):
            np.testing.assert_allclose(data_of(line), [stars.vmag[some], values[some]], rtol=1e-12)
    law, slope, full, noise = above.get_lines()[3:]
    m, peak = data_of(law)
    assert (m[0], m[-1]) == pytest.approx((stars.vmag.min() - 0.3, stars.vmag.max() + 0.3))
    np.testing.assert_allclose(peak, fit.peak_dn(m), rtol=1e-12)
    expected = fit.reference_peak_dn * 10 ** (fit.slope_dex_per_mag * (m - fit.reference_vmag))
    np.testing.assert_allclose(data_of(slope), [m, expected], rtol=1e-9)
    assert [line.get_ydata()[0] for line in (full, noise)] == [4095 - 50, 4.0]
    limit = max(0.5, 1.1 * np.abs(part.off_mag[fit.used]).max())
    assert below.get_ylim() == pytest.approx((limit, -limit))
    assert above.get_yscale() == "log"
    none = replace(part, brightness=replace(fit, slope_dex_per_mag=np.nan))
    above = axes()
    _brightness(above, axes(), none)
    assert len(above.get_lines()) == 6
    far = with_stars(part, peak_dn=stars.peak_dn * np.where(np.arange(40) == 5, 0.3, 1.0))
    below = axes()
    _brightness(axes(), below, far)
    largest = np.abs(far.off_mag[fit.used]).max()
    assert largest > 1
    assert below.get_ylim() == pytest.approx((1.1 * largest, -1.1 * largest))


def test_widths_are_drawn_by_their_signal() -> None:
    part = calibration()
    noise = np.full(40, 4.0)
    noise[2], noise[3] = part.stars.peak_dn[2] / 9.9, part.stars.peak_dn[3] / 10.1
    part = with_stars(part, noise_dn=noise)
    stars = part.stars
    plot = axes()
    _width(plot, part)
    number = np.arange(40)
    good = (number % 7 != 0) & (number % 9 != 4) & (stars.peak_dn / noise >= 10)
    assert (good[2], good[3]) == (False, True)
    bad, shown, median = plot.get_lines()
    np.testing.assert_array_equal(data_of(bad), [stars.vmag[~good], stars.sigma_px[~good]])
    np.testing.assert_array_equal(data_of(shown), [stars.vmag[good], stars.sigma_px[good]])
    assert median.get_ydata()[0] == 1.35
    assert median.get_label() == "median 1.350 ± 0.020 px"
    assert plot.get_ylim() == pytest.approx((0, 4.05))


def test_brightness_and_width_are_drawn_against_the_distance_from_the_axis() -> None:
    part = calibration()
    misfit = replace(
        PLAIN, corner_loss_mag=Measurement(0.4, 0.05), corner_growth=Measurement(-0.2, 0.03), mean_loss_mag=0.1
    )
    part = replace(part, misfit=misfit)
    used = part.brightness.used
    brightness, width = axes(), axes()
    _off_axis(brightness, width, part)
    distance = corner_distance(part.image, part.matches, part.stars.xy_px)
    np.testing.assert_allclose(data_of(brightness.get_lines()[0]), [distance[used], -part.off_mag[used]], rtol=1e-12)
    np.testing.assert_allclose(
        data_of(width.get_lines()[0]), [distance[used], part.stars.sigma_px[used] / 1.35], rtol=1e-12
    )
    r, loss = data_of(brightness.get_lines()[2])
    np.testing.assert_allclose(loss, 0.1 - 0.4 * r**2, rtol=1e-12)
    assert (r[0], r[-1]) == (0, 1)
    assert brightness.get_lines()[2].get_label() == "corner -0.40 ± 0.05 mag"
    typical = 1 - 0.2 * np.median(distance[used] ** 2)
    np.testing.assert_allclose(data_of(width.get_lines()[2])[1], (1 - 0.2 * r**2) / typical, rtol=1e-12)
    assert width.get_lines()[2].get_label() == "corner -20 ± 3 %"
    bare = replace(part, misfit=replace(PLAIN, corner_loss_mag=None, corner_growth=None))
    brightness, width = axes(), axes()
    _off_axis(brightness, width, bare)
    assert (len(brightness.get_lines()), len(width.get_lines())) == (2, 2)


def test_the_profile_is_drawn_over_a_gaussian() -> None:
    stacked = RadialProfile(np.array([0.5, 1.5]), np.array([0.9, 0.4]))
    plot = axes()
    _profile(plot, replace(calibration(), misfit=replace(PLAIN, stacked=stacked)))
    r, gaussian = data_of(plot.get_lines()[0])
    np.testing.assert_allclose(gaussian, np.exp(-0.5 * r**2), rtol=1e-12)
    assert r[-1] == 8
    np.testing.assert_array_equal(data_of(plot.get_lines()[1]), [[0.5, 1.5], [0.9, 0.4]])
    plot = axes()
    _profile(plot, calibration())
    assert len(plot.get_lines()) == 1


class Space(SimpleNamespace):
    """Axes of three dimensions that keep their surfaces."""

    def __init__(self) -> None:
        super().__init__(title="", drawn=None, measured=None)

    def plot_surface(self, *grid: np.ndarray, **_: object) -> None:
        self.drawn = grid

    def plot_wireframe(self, *grid: np.ndarray, **_: object) -> None:
        self.measured = grid

    def set_title(self, title: str, **_: object) -> None:
        self.title = title

    def __getattr__(self, name: str):
        return lambda *_, **__: None


@pytest.mark.parametrize("moved", [False, True])
def test_a_bright_star_near_the_fit_is_drawn_beside_its_simulation(moved: bool) -> None:
    part = calibration()
    part.image.pixels_dn[:] = np.arange(300)[:, np.newaxis] + 1000 * np.arange(400)
    trail = np.zeros((40, 2))
    if moved:
        trail[:] = [3.0, 4.0]
    part = with_stars(part, trail_px=trail)
    space = Space()
    _surface(space, part)
    stars = part.stars
    used = np.flatnonzero(part.brightness.used)
    brightest = sorted(used, key=lambda k: -stars.peak_dn[k])[: len(used) // 4]
    k = min(brightest, key=lambda k: abs(part.off_mag[k]))
    half = int(np.ceil(4.5 * 1.35 + (2.5 if moved else 0)))
    x, y = np.rint(stars.xy_px[k]).astype(int)
    columns = np.arange(max(0, x - half), min(400, x + half + 1))
    rows = np.arange(max(0, y - half), min(300, y + half + 1))
    X, Y, measured = space.measured
    np.testing.assert_array_equal(measured, part.image.pixels_dn[np.ix_(rows, columns)])
    assert (X[0].tolist(), Y[:, 0].tolist()) == (columns.tolist(), rows.tolist())
    peak = part.sensor.peak_dn(stars.vmag[k : k + 1], 0.5)
    light = draw_stars((300, 400), stars.xy_px[k : k + 1], peak, 1.35, trail_px=trail[k : k + 1] if moved else None)
    np.testing.assert_allclose(space.drawn[2], 50 + light[np.ix_(rows, columns)], rtol=1e-9)
    assert space.title == f"S{k}, {stars.vmag[k]:.2f} mag: measured (red), simulated (blue)"
    nameless = with_stars(part, name=("",) * 40)
    _surface(space, nameless)
    assert space.title.startswith(f"HR {1000 + k}, ")


@pytest.mark.parametrize("edge", ["low", "high"])
def test_a_star_at_the_edge_is_drawn_as_far_as_the_image_goes(edge: str) -> None:
    part = handmade(np.zeros(3))
    place = [2.0, 3.0] if edge == "low" else [397.0, 298.0]
    part = with_stars(part, xy_px=np.tile(place, (3, 1)))
    space = Space()
    _surface(space, part)
    X, Y, _ = space.measured
    assert (X.min(), X.max(), Y.min(), Y.max()) == ((0, 9, 0, 10) if edge == "low" else (390, 399, 291, 299))


def test_a_narrow_star_has_a_stamp_of_its_own_size() -> None:
    part = handmade(np.zeros(3))
    part = with_stars(replace(part, sensor=replace(part.sensor, psf_sigma_px=0.5)), xy_px=np.full((3, 2), 100.0))
    space = Space()
    _surface(space, part)
    assert space.measured[0].shape == (9, 9)  # of a sigma of 0.8 px


def test_images_are_shown_from_two_sigma_below_the_sky_to_25_above() -> None:
    plot = axes()
    pixels = np.arange(20.0 * 30).reshape(20, 30)
    _show(plot, pixels, 50.0, 4.0)
    [image] = plot.get_images()
    assert image.get_extent() == [-0.5, 29.5, 19.5, -0.5]
    assert image.get_clim() == (42.0, 150.0)
    np.testing.assert_array_equal(image.get_array(), pixels)
    plot = axes()
    _show(plot, pixels, 50.0, 0.5)
    assert plot.get_images()[0].get_clim() == (48.0, 75.0)


def test_large_images_keep_the_largest_pixel_of_each_block() -> None:
    rng = np.random.default_rng(3)
    for shape, side in (((50, 1229), 1), ((50, 1231), 2), ((2051, 40), 3)):
        pixels = rng.random(shape)
        found = _shrunk(pixels)
        assert found.shape == (shape[0] // side, shape[1] // side)
        for row, column in ((0, 0), (found.shape[0] - 1, found.shape[1] - 1), (3, 5)):
            block = pixels[row * side : (row + 1) * side, column * side : (column + 1) * side]
            assert found[row, column] == block.max()


def test_labels_lie_at_equal_distances_from_the_axes() -> None:
    plot = axes()  # 3 by 1 inches
    _labelled(plot, across="x", up="y")
    assert plot.yaxis.get_label().get_position() == pytest.approx((-0.55 / 3, 0.5))
    assert plot.xaxis.get_label().get_position() == pytest.approx((0.5, -0.3))
    other = axes()
    _labelled(other, across=None, up="y")
    assert other.get_xlabel() == ""


def test_the_brightest_thirty_stars_are_marked_and_the_lone_ones_named() -> None:
    """A label keeps 3 % of the width of the image from those of brighter stars: 12 px."""
    part = handmade(np.zeros(40))
    places = np.column_stack([20 + 60 * (np.arange(40) % 6), 20 + 40 * (np.arange(40) // 6)]).astype(float)
    places[3] = places[1] + [11.9, 0.0]
    places[4] = places[2] + [0.0, 12.0]
    names = ["" if k == 5 else f"S{k}" for k in range(40)]
    detected = replace(part.detected, xy_px=places)
    stars = replace(part.reference.stars, name=tuple(names))
    geometry = replace(part, detected=detected, reference=replace(part.reference, stars=stars)).geometry
    geometry.image.pixels_dn[7, 9] = 90.0
    plot = axes()
    _photograph(plot, geometry)
    np.testing.assert_array_equal(data_of(plot.get_lines()[0]), places[:30].T)
    texts = [(text.get_text(), text.xy) for text in plot.texts]
    expected = [k for k in range(30) if k != 3]
    assert [text for text, _ in texts] == ["HR 1005" if k == 5 else f"S{k}" for k in expected]
    assert [at for _, at in texts] == [tuple(places[k]) for k in expected]
    # The background of 50 DN is made flat, at the level of the sky.
    shown = plot.get_images()[0].get_array()
    assert (shown[0, 0], shown[7, 9]) == (50.0, 90.0)


def test_residuals_are_arrows_of_positions() -> None:
    part = calibration()
    plot = axes()
    _residuals(plot, part.geometry)
    [arrows] = [one for one in plot.collections if hasattr(one, "U")]
    np.testing.assert_array_equal(arrows.XY, part.detected.xy_px)
    np.testing.assert_array_equal([arrows.U, arrows.V], part.matches.residual_px.T)
    assert arrows.scale == pytest.approx(20 * part.matches.rms_px)
    assert (plot.get_xlim(), plot.get_ylim()) == ((-0.5, 399.5), (299.5, -0.5))
    assert plot.get_title(loc="left") == "found minus predicted; f = 500.0 px\n40 matched, 0.0 expected by chance"
    known = replace(part, matches=replace(part.matches, standard_error={"fx_px": 0.25}, residual_px=np.zeros((40, 2))))
    plot = axes()
    _residuals(plot, known.geometry)
    assert "f = 500.0 ± 0.2 px" in plot.get_title(loc="left")
    [arrows] = [one for one in plot.collections if hasattr(one, "U")]
    assert arrows.scale == 0.2


def test_a_simulated_image_has_all_stars_of_the_catalogue_and_the_noise_of_the_sky() -> None:
    part = handmade(OFF)
    image = simulated(part)
    vmag = part.reference.stars.vmag
    light = draw_stars((300, 400), part.matches.predicted_xy_px, part.sensor.peak_dn(vmag, 0.5), 1.35)
    sky = np.random.default_rng(0).normal(50.0, 4.0, (300, 400))
    np.testing.assert_array_equal(image, np.clip(np.floor(light + sky + 0.5), 0, 4095))
    assert (simulated(part, seed=1) != image).any()
    turned = replace(part, sensor=replace(part.sensor, reference_exposure_s=20.0))
    turned = with_stars(turned, trail_px=np.ones((40, 2)))
    trail = sidereal_trails(turned.matches.solution, turned.matches.predicted_xy_px, 20.0)
    light = draw_stars(
        (300, 400), turned.matches.predicted_xy_px, turned.sensor.peak_dn(vmag, 20.0), 1.35, trail_px=trail
    )
    np.testing.assert_array_equal(simulated(turned), np.clip(np.floor(light + sky + 0.5), 0, 4095))
    bright = replace(part, sensor=replace(part.sensor, sky_mean_dn=4090.0))
    assert simulated(bright).max() == 4095
    dark = replace(part, sensor=replace(part.sensor, sky_mean_dn=0.0))
    assert simulated(dark).min() == 0


def test_a_page_has_the_width_of_15_inches_and_the_height_of_its_photograph() -> None:
    part = handmade(OFF)
    assert CAMERA.width_px == 400
    page = cv2.imdecode(np.frombuffer(draw_geometry(part.geometry), np.uint8), cv2.IMREAD_COLOR)
    assert page.shape[:2] == (704, 1650)  # 110 dots an inch; 5.4 inches of the photograph, and one


def test_plots_lie_on_the_page_beside_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    pages: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda page, *_, **__: pages.append(page))
    part = handmade(OFF)
    draw_report(part)
    draw_geometry(part.geometry)
    assert [len(page.axes) for page in pages] == [10, 2]
    assert pages[0].get_size_inches().tolist() == pytest.approx([15, 5.4 + 11.5 + 3.9])
    for page in pages:
        boxes = [one.get_position() for one in page.axes]
        for k, box in enumerate(boxes):
            assert min(box.x0, box.y0) > 0
            assert max(box.x1, box.y1) < 1
            assert not any(box.overlaps(other) for other in boxes[:k])
        # The title is 0.15 inches below the upper edge.
        assert page.get_suptitle().startswith("a.png: 40 stars identified (by hand)")
        assert (1 - page._suptitle.get_position()[1]) * page.get_size_inches()[1] == pytest.approx(0.15)
    # From the lower edge, inches: the lowest row, the two above it, and the images.
    bottoms = sorted({round(box.y0 * 20.8, 3) for box in (one.get_position() for one in pages[0].axes)})
    assert bottoms == [0.6, 4.1, 4.3, 9.0, 10.5, 14.8]
