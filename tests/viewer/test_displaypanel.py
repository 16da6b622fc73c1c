"""Stretch, colours, histogram and pixel grid of the display."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.viewer.picture.view import ColourMap, Histogram, Stretch, StretchKind
from glstar.viewer.ui.theme import accent
from tests.support.windowinput import press, screen

RNG = np.random.default_rng(7)


def test_grey_is_the_brightness_and_other_maps_are_opencv_s():
    brightness = np.linspace(0, 1, 256, dtype=np.float32)[np.newaxis]
    levels = np.arange(256, dtype=np.uint8)[np.newaxis]
    np.testing.assert_array_equal(ColourMap.GREY.picture(brightness), np.stack([levels] * 3, axis=-1))
    expected = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1]
    np.testing.assert_array_equal(ColourMap.INFERNO.picture(brightness), expected)


@pytest.mark.parametrize("colour_map", [each for each in ColourMap if each is not ColourMap.TURBO])
def test_maps_grow_brighter(colour_map):
    lightness = cv2.cvtColor(colour_map.colours[np.newaxis], cv2.COLOR_RGB2LAB)[0, :, 0].astype(int)
    assert np.diff(lightness[::8]).min() > 0


def test_the_fitted_stretch_darkens_the_sky_and_shows_faint_stars():
    pixels = RNG.normal(200.0, 6.0, (400, 500)).round().astype(np.uint16)
    pixels[::40, ::40] = 900
    stretch = Stretch().fitted(pixels, 4095)
    assert stretch.black * 4095 == pytest.approx(194.0, abs=0.5)
    assert stretch.white * 4095 == pytest.approx(900.0, abs=1.0)
    faint = np.array([200.0 + 5 * 6.0, 200.0], np.float32) / np.float32(4095)
    star, sky = stretch(faint)
    assert sky < 0.1
    assert star > sky + 0.1


def test_the_fitted_stretch_of_an_image_without_stars_does_not_amplify_its_noise_to_white():
    pixels = RNG.normal(200.0, 6.0, (400, 500)).round().astype(np.uint16)
    stretch = Stretch(StretchKind.LINEAR).fitted(pixels, 4095)
    assert stretch(pixels / np.float32(4095)).max() < 0.4


def test_a_stretch_that_follows_shows_a_moonlit_sky_black_and_a_usual_one_as_the_sensor_s():
    usual = Stretch(boost=5.0, black=16 / 255)
    dark = RNG.normal(16.0, 3.0, (400, 500)).round().clip(0, 255).astype(np.uint8)
    assert usual.following(dark, 255, usual) == usual
    moonlit = RNG.normal(140.0, 4.0, (400, 500)).round().astype(np.uint8)
    followed = usual.following(moonlit, 255, usual)
    assert followed.black * 255 == pytest.approx(140.0, abs=0.1)
    assert np.mean(followed(moonlit / np.float32(255))) < 0.25
    assert followed.following(RNG.permutation(moonlit), 255, usual) == followed
    assert followed.following(dark, 255, usual) == usual


def test_a_saturated_sky_is_bright():
    saturated = np.full((400, 500), 255, np.uint8)
    assert Stretch().following(saturated, 255, Stretch(boost=5.0))(saturated / np.float32(255)).min() > 0.7


@pytest.mark.parametrize("hold", [lambda s: s.brighter(2.0), lambda s: s.between(0.1, 0.2)], ids=["key", "handles"])
def test_a_stretch_that_the_user_chose_is_held(hold):
    chosen = hold(Stretch(boost=5.0))
    assert chosen.held
    assert chosen.following(np.full((40, 50), 200, np.uint8), 255, Stretch()) == chosen


def test_limits_are_the_levels_shown_black_and_white():
    stretch = Stretch(StretchKind.LINEAR).between(0.2, 0.6)
    np.testing.assert_allclose(stretch(np.array([0.2, 0.4, 0.6], np.float32)), [0.0, 0.5, 1.0], rtol=0, atol=1e-6)
    assert stretch.white == pytest.approx(0.6)


@pytest.mark.parametrize("high", [3, 255, 5000])
def test_the_histogram_counts_every_pixel_once(high):
    pixels = RNG.integers(0, high + 1, (300, 200)).astype(np.uint16)
    histogram = Histogram.of(pixels)
    assert histogram.fraction.sum() == pytest.approx(1.0)
    mean = histogram.level_dn @ histogram.fraction
    width = histogram.level_dn[1] - histogram.level_dn[0]
    assert mean == pytest.approx(pixels.mean(), abs=width)


def test_the_histogram_of_a_flat_image_is_one_bin():
    histogram = Histogram.of(np.full((20, 30), 7, np.uint8))
    assert histogram.level_dn[histogram.fraction > 0].tolist() == [7.0]


def test_keys_fit_the_stretch_and_change_the_colours(viewer):
    session = viewer.session
    press(viewer, "Shift+A")
    assert session.stretch == Stretch().fitted(session.image.pixels, 255)
    press(viewer, "Shift+C")
    assert session.stretch.colours is ColourMap.VIRIDIS
    press(viewer, "H")
    shown = screen(viewer).reshape(-1, 3).astype(int)
    np.testing.assert_array_equal(ColourMap.VIRIDIS.colours[0], [68, 1, 84])
    assert (np.abs(shown - [68, 1, 84]).max(axis=1) <= 40).mean() > 0.3
    press(viewer, "N")
    assert screen(viewer)[..., 1:].max() == 0


def test_magnified_pixels_have_borders_and_numbers(viewer):
    session = viewer.session
    session.shown_overlays = set()
    press(viewer, "H")
    for zoom in (7.0, 12.0, 48.0):
        session.view.one_to_one()
        session.view.zoom_at(session.view.middle, zoom)
        session.view.pixel_grid = True
        viewer.frame(0.0)
        with_grid = screen(viewer).copy()
        press(viewer, "J")
        assert not session.view.pixel_grid
        changed = (screen(viewer) != with_grid).any(axis=-1)
        if zoom < 8:
            assert not changed.any()
            continue
        rows = changed.mean(axis=1) > 0.9
        assert rows.sum() == pytest.approx(viewer._surface.size[1] / zoom, abs=2)
        # Numbers fill a part of each magnified pixel.
        assert (changed[~rows].mean() > 1.5 / zoom) == (zoom >= 40)


def test_the_white_level_is_dragged_in_the_histogram(viewer):
    session, io = viewer.session, imgui.get_io()
    imgui.set_window_focus("View")
    session.stretch = Stretch().between(0.1, 0.5)
    for _ in range(4):
        viewer.frame(0.0)
    # The lines of the levels are the two columns of the accent's colour; the right one is white.
    rows = screen(viewer)[::-1][70:120, 600:].astype(int)
    is_line = (np.abs(rows - np.array(list(accent())[:3]) * 255).max(axis=-1) < 30).all(axis=0)
    x, y = 600 + float(np.flatnonzero(is_line)[-1]), 100.0
    before = session.stretch
    for at, down in ((x, None), (x, True), (x - 60, None), (x - 60, False)):
        io.add_mouse_pos_event(at, y)
        if down is not None:
            io.add_mouse_button_event(0, down)
        viewer.frame(0.0)
    viewer.frame(0.0)
    assert session.stretch.white < before.white - 0.1
    assert session.stretch.black == pytest.approx(before.black)


def test_the_window_s_sky_stays_dark_under_the_moon_unless_the_stretch_is_held(make_viewer):
    """The full Moon of 2024-03-25 lights the image of a 12-bit sensor to thrice its usual range."""
    flight = (
        "fly:still?utc_start=2024-03-25T13:00:00Z&latitude_deg=-34.9&longitude_deg=138.6&heading_deg=30&pitch_deg=-30"
    )
    camera = {"sky.preset": "full", "camera.preset": "imx477:1332x990", "camera.lens_mm": 6.0, "camera.f_number": 1.2}
    viewer = make_viewer(Path(flight), config=Config().override(**camera))
    session = viewer.session

    def brightness() -> float:
        return float(np.median(session.stretch(session.image.pixels / np.float32(session.scene.white_dn))))

    assert brightness() < 0.2
    press(viewer, "Up")
    held = session.stretch
    assert held.held
    session.head.seek_by(20.0)
    viewer.frame(0.0)
    assert session.stretch == held
    session.stretch = Stretch.for_sensor(session.scene.sensor)
    assert brightness() > 0.4
    session.head.playing = True
    for _ in range(30):
        viewer.frame(1.0)
    assert brightness() < 0.2


@pytest.mark.parametrize("levels", [[7] * 10, [0, 0, 1, 3, 3, 3], [10, 265], [10, 266], [100, 100 + 2 * 256 - 1]])
def test_the_bins_of_a_histogram_hold_whole_digital_numbers(levels):
    pixels = np.array([levels], dtype=np.uint16)
    histogram = Histogram.of(pixels)
    first, last = min(levels), max(*levels, min(levels) + 1)
    width = -(-(last + 1 - first) // 256)  # at most 256 bins
    begins = histogram.level_dn - (width - 1) / 2
    np.testing.assert_array_equal(begins, first + width * np.arange(len(begins)))
    assert len(begins) <= 256
    expected = [np.mean([begin <= level < begin + width for level in levels]) for begin in begins]
    np.testing.assert_allclose(histogram.fraction, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("rows", "step"), [(1000, 1), (1001, 2), (2000, 2), (2001, 3)])
def test_the_histogram_counts_at_most_a_thousand_rows(rows, step):
    pixels = np.repeat(np.arange(rows, dtype=np.uint16)[:, np.newaxis], 2, axis=1)
    pixels[pixels >= 200] = 200
    found = Histogram.of(pixels)
    # Rows 0, `step`, 2 `step` ... below 200: one bin each.
    counted = len(range(0, rows, step))
    assert found.fraction[0] == pytest.approx(1 / counted)
    assert np.count_nonzero(found.fraction) == len(range(0, 200, step)) + 1


def test_the_black_of_a_flat_sky_is_its_own_level():
    usual = Stretch(boost=5.0, black=0.1)
    for sky_dn in (100, 3000, 40000):
        stretch = usual.following(np.full((300, 400), sky_dn, np.uint16), 65535, usual)
        assert stretch.black * 65535 == pytest.approx(sky_dn, abs=0.01)
