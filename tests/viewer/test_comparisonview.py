"""Real images beside simulated ones: the picture of each mode, and the simulated exposure of a real image."""

import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.errors import ExportError
from glstar.images import RealImage, fit
from glstar.images.times import ImageTime, TimeReference
from glstar.viewer.picture.comparison import (
    LESS_RGB,
    MORE_RGB,
    ComparisonMode,
    ComparisonState,
    compose,
    outside,
    save_view,
)
from glstar.viewer.picture.view import Stretch, StretchKind
from tests.support.viewerdoubles import Clock

ASINH = Stretch(StretchKind.ASINH)
UTC_S = 1564433246.0  # 2019-07-29 20:47:26
SIMULATED = np.random.default_rng(1).integers(0, 256, (24, 32), dtype=np.uint8)
REAL = np.random.default_rng(2).integers(0, 256, (24, 32), dtype=np.uint8)


def grey(dn: np.ndarray) -> np.ndarray:
    return np.dstack([dn, dn, dn])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for second in (26, 29, 32):
        cv2.imwrite(str(tmp_path / f"20190729_2047{second}.png"), REAL)
    return tmp_path


@pytest.fixture
def state(folder: Path):
    state = ComparisonState(Clock())
    state.open(folder)
    wait_for(state)
    yield state
    state.close()


def wait_for(state: ComparisonState) -> None:
    """Poll as the window does, until the folder is open or refused."""
    last = time.monotonic() + 20
    while state.opening is not None:
        assert time.monotonic() < last
        state.poll()
        time.sleep(0.005)


@pytest.mark.parametrize("mode", ComparisonMode)
def test_without_a_real_image_the_simulated_one_is_shown(mode: ComparisonMode) -> None:
    np.testing.assert_array_equal(compose(SIMULATED, None, mode, phase=0.7), grey(SIMULATED))


def test_off_shows_no_real_image() -> None:
    np.testing.assert_array_equal(compose(SIMULATED, REAL, ComparisonMode.OFF), grey(SIMULATED))


@pytest.mark.parametrize(
    ("phase", "shown"), [(0, SIMULATED), (0.49, SIMULATED), (0.5, REAL), (0.99, REAL), (1, SIMULATED)]
)
def test_blinking_shows_each_image_for_half_of_the_period(phase: float, shown: np.ndarray) -> None:
    np.testing.assert_array_equal(compose(SIMULATED, REAL, ComparisonMode.BLINK, phase=phase), grey(shown))


@pytest.mark.parametrize(("wipe", "columns"), [(0.0, 0), (0.25, 8), (0.5, 16), (1.0, 32)])
def test_the_line_of_a_wipe_has_the_simulated_image_to_its_left(wipe: float, columns: int) -> None:
    picture = compose(SIMULATED, REAL, ComparisonMode.WIPE, wipe=wipe)

    np.testing.assert_array_equal(picture[:, :columns], grey(SIMULATED)[:, :columns])
    np.testing.assert_array_equal(picture[:, columns:], grey(REAL)[:, columns:])


def test_side_by_side_is_the_simulated_image_left_and_the_real_one_right() -> None:
    picture = compose(SIMULATED, REAL, ComparisonMode.SIDE_BY_SIDE)

    np.testing.assert_array_equal(picture, np.hstack([grey(SIMULATED), grey(REAL)]))


def test_equal_pixels_are_black_in_the_difference() -> None:
    assert not compose(REAL, REAL, ComparisonMode.DIFFERENCE, stretch=ASINH).any()


def test_a_missing_star_is_red_and_an_additional_one_is_blue() -> None:
    simulated, real = np.full((24, 32), 20, np.uint8), np.full((24, 32), 20, np.uint8)
    real[5, 7] = 220  # in the sky, not in the simulation
    simulated[15, 17] = 220

    picture = compose(simulated, real, ComparisonMode.DIFFERENCE)

    np.testing.assert_array_equal(picture[5, 7], np.rint(200 * np.array(MORE_RGB)))
    np.testing.assert_array_equal(picture[15, 17], np.rint(200 * np.array(LESS_RGB)))
    assert np.count_nonzero(picture.any(axis=-1)) == 2


def test_both_images_have_the_same_stretch() -> None:
    picture = compose(REAL, REAL, ComparisonMode.WIPE, stretch=ASINH)

    np.testing.assert_array_equal(picture, compose(REAL, None, ComparisonMode.OFF, stretch=ASINH))
    assert (picture[..., 0] >= REAL).all()


def test_no_black_level_is_subtracted_from_a_difference() -> None:
    brighter = np.minimum(REAL.astype(int) + 10, 255).astype(np.uint8)
    dark_sky = Stretch(StretchKind.LINEAR, boost=4.0, black=0.1)

    picture = compose(REAL, brighter, ComparisonMode.DIFFERENCE, stretch=dark_sky)

    np.testing.assert_array_equal(
        picture, compose(REAL, brighter, ComparisonMode.DIFFERENCE, stretch=replace(dark_sky, black=0.0))
    )
    assert picture[REAL < 245].any(axis=-1).all()


def test_images_of_other_depths_are_scaled_to_the_same_white() -> None:
    twelve_bits = (REAL.astype(np.float64) / 255 * 4095 + 0.5).astype(np.uint16)
    sixteen_bits = REAL.astype(np.uint16) * 257

    picture = compose(twelve_bits, sixteen_bits, ComparisonMode.SIDE_BY_SIDE, saturation_dn=4095)

    assert np.abs(picture[:, :32].astype(int) - picture[:, 32:]).max() <= 1
    np.testing.assert_array_equal(picture[:, 32:], grey(REAL))


def test_black_and_gain_change_the_real_image_only() -> None:
    real = np.full((24, 32), 60, np.uint8)

    picture = compose(SIMULATED, real, ComparisonMode.WIPE, real_black=10 / 255, real_gain=3.0)

    np.testing.assert_array_equal(picture[:, :16], grey(SIMULATED)[:, :16])
    assert (picture[:, 16:] == 150).all()


def test_a_gain_beyond_white_stays_white() -> None:
    picture = compose(SIMULATED, np.full((24, 32), 200, np.uint8), ComparisonMode.BLINK, phase=0.5, real_gain=1000)

    assert (picture == 255).all()


def test_nothing_is_subtracted_outside_the_real_image() -> None:
    picture = compose(
        np.full((24, 32), 90, np.uint8), np.zeros((24, 24), np.uint8), ComparisonMode.DIFFERENCE, real_black=-0.5
    )

    assert not picture[:, :4].any()
    assert not picture[:, 28:].any()
    assert picture[:, 4:28].any(axis=-1).all()


def test_a_real_image_of_another_size_is_fitted() -> None:
    large = np.random.default_rng(3).integers(0, 256, (48, 64), dtype=np.uint8)

    picture = compose(SIMULATED, large, ComparisonMode.BLINK, phase=0.5)

    np.testing.assert_array_equal(picture, grey(fit(large, 32, 24).pixels))


@pytest.mark.parametrize("caption", ["", "simulated\nreal: 20190729_204726.png, by name, and so on for very long"])
def test_a_view_is_saved_as_it_is_composed(tmp_path: Path, caption: str) -> None:
    picture = np.tile(compose(SIMULATED, REAL, ComparisonMode.DIFFERENCE), (10, 10, 1))

    save_view(tmp_path / "view.png", picture, caption)

    saved = cv2.imread(str(tmp_path / "view.png"))[..., ::-1]
    np.testing.assert_array_equal(saved[:240], picture)
    assert saved.shape[1] == 320
    assert (saved.shape[0] > 240) == bool(caption)
    assert saved[240:].any() == bool(caption)
    # The caption is not cut off at the right.
    assert not saved[240:, -2:].any()


def test_a_failed_save_of_a_view_is_reported_with_its_reason(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="missing"):
        save_view(tmp_path / "missing" / "view.png", grey(REAL))


def test_a_folder_opens_between_two_frames_and_begins_to_blink(folder: Path) -> None:
    state = ComparisonState(Clock())
    state.open(folder)
    assert (state.opening, state.active) == (folder, False)

    wait_for(state)

    assert state.active
    assert (state.mode, state.error, state.phase) == (ComparisonMode.BLINK, "", 0.0)
    state.close()
    state.close()


def test_a_folder_that_cannot_be_used_leaves_the_images_that_are_shown(state: ComparisonState, tmp_path: Path) -> None:
    shown = state.images

    state.open(tmp_path / "missing")
    wait_for(state)

    assert state.images is shown
    assert state.error == f"{tmp_path / 'missing'}: is not a folder of images: No such file or directory"


def test_the_second_of_two_requested_folders_is_shown(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    other = tmp_path_factory.mktemp("other")
    cv2.imwrite(str(other / "20190729_204700.png"), REAL)
    state = ComparisonState(Clock())

    state.open(folder)
    state.open(other)
    wait_for(state)

    assert state.images is not None
    assert state.images.folder == other
    state.close()


def test_the_blink_follows_its_clock(state: ComparisonState) -> None:
    clock = state._clock
    assert isinstance(clock, Clock)
    state.blink_period_s = 2.0

    phases = []
    for delay_s in (0.0, 0.5, 1.0, 1.75, 2.0):
        clock.now_s = 100.0 + delay_s
        phases.append(state.phase)

    assert phases == [0.0, 0.25, 0.5, 0.875, 0.0]


def test_a_key_pressed_twice_ends_the_comparison(state: ComparisonState) -> None:
    state.toggle(ComparisonMode.WIPE)
    assert state.mode is ComparisonMode.WIPE
    state.toggle(ComparisonMode.WIPE)
    assert (state.mode, state.active, state.image_at(UTC_S)) == (ComparisonMode.OFF, False, None)


def test_a_camera_clock_ahead_shows_an_earlier_time_of_the_log(state: ComparisonState) -> None:
    # 29 s by the camera's clock is 26.5 s by the log's.
    state.offset_s = 2.5

    image = state.image_at(UTC_S + 0.4)

    assert image is not None
    assert image.path.name == "20190729_204729.png"
    assert state.log_utc_s(image) == UTC_S + 0.5
    assert state.exposure(image, Exposure(0.0, 0.5)).start_utc_s == UTC_S + 0.5


def test_the_panel_s_offset_is_added_to_the_flight_s(state: ComparisonState) -> None:
    state.flight_offset_s, state.offset_s = -3600.0, 2.5

    image = state.image_at(UTC_S + 3600.4)

    assert image is not None
    assert image.path.name == "20190729_204729.png"
    assert state.log_utc_s(image) == UTC_S + 3600.5
    assert state.exposure(image, Exposure(0.0, 0.5)).start_utc_s == UTC_S + 3600.5
    assert "camera clock - log clock = -3597.500 s" in state.describe(image, Exposure(UTC_S, 0.5))


@pytest.mark.parametrize(
    ("moment", "begins_s"), [(TimeReference.START, 0.0), (TimeReference.MIDDLE, -1.0), (TimeReference.END, -2.0)]
)
def test_a_real_image_s_time_stamp_refers_to_an_instant_of_its_exposure(moment: TimeReference, begins_s: float) -> None:
    image = RealImage(Path("a.jpg"), ImageTime(UTC_S, "EXIF, zone +00:00", 2.0))
    state = ComparisonState()
    state.time_reference = moment

    assert state.exposure(image, Exposure(0.0, 0.5, 100.0)) == Exposure(UTC_S + begins_s, 2.0, 100.0)
    state.match_exposure = False
    assert state.exposure(image, Exposure(0.0, 0.5)) == Exposure(UTC_S + begins_s, 0.5)
    state.close()


def test_an_unknown_duration_is_taken_from_the_settings() -> None:
    image = RealImage(Path("a.png"), ImageTime(UTC_S, "name"))
    state = ComparisonState()
    state.time_reference = TimeReference.MIDDLE

    assert state.exposure(image, Exposure(0.0, 0.5)) == Exposure(UTC_S - 0.25, 0.5)
    state.close()


def test_the_frames_of_an_export_begin_at_the_times_of_their_truth() -> None:
    image = RealImage(Path("frame_000000.png"), ImageTime(UTC_S, "truth.jsonl", 0.5, is_start=True))
    state = ComparisonState()
    state.time_reference = TimeReference.END

    assert state.exposure(image, Exposure(0.0, 3.0)) == Exposure(UTC_S, 0.5)
    state.close()


@pytest.mark.parametrize(
    ("start_s", "words"),
    [
        (99.0, "the real image begins 1.000 s before the flight"),
        (100.0, ""),
        (109.5, ""),
        (110.25, "the real image ends 0.750 s after the flight"),
        (100.0 - 9.5 * 3600, "the real image begins 9.5 h before the flight"),
        (110.0 + 86400 * 365, "the real image ends 365.0 days after the flight"),
    ],
)
def test_a_real_image_outside_the_flight_is_reported(start_s: float, words: str) -> None:
    assert outside(Exposure(start_s, 0.5), 100.0, 110.0) == words


def test_the_caption_has_both_clocks(state: ComparisonState) -> None:
    state.offset_s = -0.25
    image = state.image_at(UTC_S)
    assert image is not None

    assert state.describe(image, state.exposure(image, Exposure(0.0, 0.5))) == (
        "simulated: 2019-07-29T20:47:26.250Z, 0.5 s; camera clock - log clock = -0.250 s; simulated image shown\n"
        "real: 20190729_204726.png, 2019-07-29T20:47:26.000Z by name"
    )


def test_the_caption_describes_changes_of_the_real_image() -> None:
    image = RealImage(Path("a.jpg"), ImageTime(UTC_S, "EXIF, zone +00:00", 0.125))
    state = ComparisonState()
    state.real_black, state.real_gain = 0.03, 2.0

    caption = state.describe(image, Exposure(UTC_S, 0.5), fit(np.zeros((48, 64), np.uint8), 32, 24))

    assert caption.splitlines()[1] == (
        "real: a.jpg, 2019-07-29T20:47:26.000Z by EXIF, zone +00:00, 0.125 s;"
        " 64 x 48 px, scaled by 0.5 to fit 32 x 24 px, centred; (fraction of white - 0.03) x 2"
    )
    state.close()


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        (ComparisonMode.OFF, "simulated image shown"),
        (ComparisonMode.BLINK, "real image shown"),
        (ComparisonMode.WIPE, "simulated left of 25.0%, real right"),
        (ComparisonMode.DIFFERENCE, "real - simulated, red more, blue less"),
        (ComparisonMode.SIDE_BY_SIDE, "simulated left, real right"),
    ],
)
def test_the_caption_names_the_position_of_each_image(mode: ComparisonMode, words: str) -> None:
    clock = Clock()
    state = ComparisonState(clock)
    state.mode, state.wipe = mode, 0.25
    clock.now_s += 0.6

    caption = state.describe(RealImage(Path("a.png"), ImageTime(UTC_S, "name")), Exposure(UTC_S, 0.5))

    assert caption.splitlines()[0].endswith(f"; {words}")
    state.close()


def test_a_real_image_of_12_bits_in_16_is_as_bright_as_the_simulated_one():
    pixels = np.random.default_rng(8).integers(0, 4096, (30, 40)).astype(np.uint16)
    real = fit(pixels, 40, 30).with_full_scale(4095)
    alone = compose(pixels, None, ComparisonMode.OFF, saturation_dn=4095)
    np.testing.assert_array_equal(compose(pixels, real, ComparisonMode.BLINK, phase=0.7, saturation_dn=4095), alone)


@pytest.mark.parametrize(
    ("pixels", "full_scale_dn", "white_dn"),
    [
        (np.uint16([[0, 4095]]), 4095, 4095),
        (np.uint16([[0, 4096]]), 4095, 65535),  # of a camera of more bits
        (np.uint16([[0, 200]]), 255, 65535),
        (np.uint8([[0, 200]]), 4095, 255),
    ],
)
def test_the_white_of_a_real_image_is_the_sensor_s_if_no_pixel_exceeds_it(pixels, full_scale_dn, white_dn):
    assert fit(pixels, 2, 1).with_full_scale(full_scale_dn).white_dn == white_dn
