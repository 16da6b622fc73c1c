"""Which segments an exposure is drawn in and truth follows, by stand-ins for the division and the fit."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene import exposuremotion
from glstar.render.scene.attenuation import NO_ATTENUATION, Attenuation
from glstar.render.scene.exposuremotion import ExposureListing, ExposureMotion
from glstar.render.scene.transmission import Sources
from tests.support.scenes import ADELAIDE, camera, star_field

START_S = 1000.0
SENSOR = Sensor(psf_sigma_px=1.4)
FITTED = {tolerance_px: object() for tolerance_px in (0.01, 0.03)}


def motion_of(samples_s: np.ndarray) -> SimpleNamespace:
    def pointings(times_s: np.ndarray) -> list[Pointing]:
        count = len(times_s)
        zenith = np.column_stack([times_s - START_S, np.zeros(count), np.ones(count)])
        return [Pointing(np.tile(np.eye(3), (count, 1, 1)), zenith, np.zeros((count, 3)), 0.0)]

    return SimpleNamespace(
        flight=SimpleNamespace(attitude=SimpleNamespace(utc_s=samples_s)), pointings=pointings,
        at=lambda *times: [("at", *each.tolist()) for each in times],
    )  # fmt: skip


def exposure_motion(
    monkeypatch: pytest.MonkeyPatch,
    *,
    few: bool,
    fits: bool = True,
    tolerance_px: float = 0.01,
    readout_s: float = 0.0,
    attenuation: Attenuation = NO_ATTENUATION,
) -> tuple[ExposureMotion, list[tuple[object, ...]]]:
    """Return the motion of an exposure of 0.5 s whose division into few segments succeeds or does not."""
    asked: list[tuple[object, ...]] = []

    def segment_times(_motion: object, nodes_s: np.ndarray, _lens: object, sigma_px: float, *, most: int | None,
                      position_px: float) -> np.ndarray | None:  # fmt: skip
        asked.append(("segments", most, sigma_px, position_px, nodes_s.tolist()))
        if most is not None and not few:
            return None
        ends_s = np.array([0.0, 0.1, 0.5 + readout_s]) if most else np.array([0.0, 0.1, 0.2, 0.3, 0.5 + readout_s])
        times_s = np.interp(np.arange(2 * len(ends_s) - 1) / 2, np.arange(len(ends_s)), ends_s)
        return START_S + times_s

    def fitted_segments(_motion: object, nodes_s: np.ndarray, _lens: object, sigma_px: float, within_px: float,
                        **of: float) -> object:  # fmt: skip
        asked.append(("fit", sigma_px, within_px, of, nodes_s.tolist()))
        return FITTED[within_px] if fits else None

    monkeypatch.setattr(exposuremotion, "segment_times", segment_times)
    monkeypatch.setattr(exposuremotion, "fitted_segments", fitted_segments)
    samples_s = START_S + np.array([-0.1, 1.9e-5, 0.2, 0.3, 0.5 + readout_s - 1.9e-5, 0.9])
    exposure = Exposure(START_S, 0.5, path_tolerance_px=tolerance_px, readout_s=readout_s)
    stars = star_field(np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    return ExposureMotion(motion_of(samples_s), exposure, camera(), SENSOR, stars, None, attenuation), asked


def test_a_steady_motion_is_drawn_in_few_segments_whatever_the_tolerance(monkeypatch: pytest.MonkeyPatch) -> None:
    for tolerance_px in (0.01, 0.03):
        one, asked = exposure_motion(monkeypatch, few=True, tolerance_px=tolerance_px)
        assert one.drawn_segments is one.true_segments
        assert one.drawn_segments is one._few_segments
        # The samples of the log within 20 us of both ends do not divide it.
        nodes_s = [START_S, START_S + 0.2, START_S + 0.3, START_S + 0.5]
        assert asked == [("segments", 12, SENSOR.core.effective_sigma_px, 0.02, nodes_s)]
    segments = one.true_segments
    np.testing.assert_allclose(segments.time_fraction, [0.2, 0.8], rtol=0, atol=1e-9)
    np.testing.assert_allclose(segments.half_fractions(1.0), [0.1, 0.1, 0.4, 0.4], rtol=0, atol=1e-6)
    np.testing.assert_allclose(segments.pointing.zenith_eq[:, 0], [0, 0.05, 0.1, 0.3, 0.5], rtol=0, atol=1e-6)
    # None passes through every sample of the log.
    one, asked = exposure_motion(monkeypatch, few=True, tolerance_px=0.0)
    assert len(one.drawn_segments) == 4
    assert asked[0][1] is None
    assert len(one.true_segments) == 2


def test_a_rough_motion_is_fitted_within_the_tolerance_or_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    one, asked = exposure_motion(monkeypatch, few=False)
    assert one.drawn_segments is one.true_segments is FITTED[0.01]
    assert [each[0] for each in asked] == ["segments", "fit"]
    nodes_s = [START_S, START_S + 0.2, START_S + 0.3, START_S + 0.5]
    of = {"psf_sigma_px": 1.4, "position_px": 0.02, "readout_s": 0.0}
    assert asked[1] == ("fit", SENSOR.core.effective_sigma_px, 0.01, of, nodes_s)
    one, asked = exposure_motion(monkeypatch, few=False, tolerance_px=0.03)
    assert one.drawn_segments is FITTED[0.03]
    assert one.true_segments is FITTED[0.01]
    one, _ = exposure_motion(monkeypatch, few=False, fits=False, tolerance_px=0.03)
    assert len(one.drawn_segments) == len(one.true_segments) == 4
    assert one.drawn_segments is one.true_segments


def test_paths_under_a_rolling_shutter_are_drawn_four_times_as_closely(monkeypatch: pytest.MonkeyPatch) -> None:
    one, asked = exposure_motion(monkeypatch, few=False, readout_s=0.2)
    assert one.true_segments is FITTED[0.01]
    assert asked[0][3] == 0.005
    assert asked[1][3] == {"psf_sigma_px": 1.4, "position_px": 0.005, "readout_s": 0.2}
    few, _ = exposure_motion(monkeypatch, few=True, readout_s=0.2)
    np.testing.assert_allclose(few.half_fractions(few.true_segments), [0.1, 0.1, 0.6, 0.6], rtol=0, atol=1e-6)
    plain = AnalyticSegments(few.true_segments.pointing, np.array([0.25, 0.75]))
    np.testing.assert_allclose(few.half_fractions(plain), [0.175, 0.175, 0.525, 0.525], rtol=1e-9)


def test_the_shutter_has_three_times(monkeypatch: pytest.MonkeyPatch) -> None:
    one, _ = exposure_motion(monkeypatch, few=True, readout_s=0.25)
    np.testing.assert_allclose(one.shutter_s - START_S, [0.0, 0.375, 0.75], rtol=0, atol=1e-6)
    assert one.shutter == ("at", *one.shutter_s.tolist())
    culler = one.culler(one.stars, ADELAIDE)
    assert (culler.stars is one.stars, culler.camera, culler.sensor) == (True, camera(), SENSOR)
    assert culler.zenith_extinction_mag is None


@pytest.mark.parametrize(("few", "tolerance_px", "draws", "is_known"), [
    (True, 0.03, lambda one: one._few_segments, True), (True, 0.0, lambda one: one._few_segments, False),
    (False, 0.01, lambda one: one._fitted, True), (False, 0.03, lambda one: one._fitted, False),
    (False, 0.01, lambda one: object(), False),
])  # fmt: skip
def test_stars_that_touch_along_the_true_paths_are_found_once(
    monkeypatch: pytest.MonkeyPatch, few: bool, tolerance_px: float, draws: Callable[[ExposureMotion], object],
    is_known: bool,
) -> None:  # fmt: skip
    one, _ = exposure_motion(monkeypatch, few=few, tolerance_px=tolerance_px)
    monkeypatch.setattr(ExposureMotion, "_touching_along", lambda _self, segments: ("along", segments))
    segments = draws(one)
    found = one.touching_along(segments)
    assert found == ("along", segments)
    assert one.touching == ("along", one.true_segments)
    assert (one.touching_along(segments) is one.touching) == is_known


def test_true_paths_are_divided_where_a_source_sets_behind_a_ridge(monkeypatch: pytest.MonkeyPatch) -> None:
    one, _ = exposure_motion(monkeypatch, few=True)
    vars(one)["touching"] = SimpleNamespace(listed="listed", index=np.array([0]))
    listing = ExposureListing(one, None)
    assert listing.stars == "listed"
    assert listing.trails is one.true_segments
    ridge = SimpleNamespace(divided=lambda segments, sources: ("divided", segments, sources))
    behind, _ = exposure_motion(monkeypatch, few=True, attenuation=SimpleNamespace(ridge=ridge))
    vars(behind)["touching"] = SimpleNamespace(listed="listed", index=np.array([0]))
    kind, segments, sources = ExposureListing(behind, None).trails
    assert (kind, segments) == ("divided", behind.true_segments)
    assert isinstance(sources, Sources)
    np.testing.assert_array_equal(sources.direction_eq, [[0.0, 0.0, 1.0]])
