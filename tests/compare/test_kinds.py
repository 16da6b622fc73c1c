"""Kinds of images that a comparison leaves out, and where and when it searches the others."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import FlightComparison, Search, flights
from glstar.compare.flights import _kind_of, _Searched, _sensor_of
from glstar.errors import ImagesError
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from tests.support.scenes import camera

SINGLE, STACK = Exposure(0.0, 0.1), Exposure(0.0, 0.1, frames=2, stack="mean")


@pytest.mark.parametrize(
    ("dtype", "largest_dn", "bit_depth", "exposure"),
    [(np.uint8, 9, 12, SINGLE), (np.uint16, 4096, 12, STACK)],
)
def test_an_image_of_another_depth_is_named_so(dtype, largest_dn, bit_depth, exposure) -> None:
    pixels = np.full((2, 2), largest_dn, dtype)
    with pytest.raises(ImagesError) as caught:
        _sensor_of(pixels, Sensor(bit_depth=bit_depth), Path("a.png"), exposure)
    assert _kind_of(caught.value) == "of another depth"


def test_the_sensor_has_the_depth_of_a_single_image_and_keeps_that_of_a_stack() -> None:
    cases = [
        (np.uint8, 8, SINGLE, 8),
        (np.uint16, 12, SINGLE, 12),
        (np.uint16, 8, SINGLE, 16),
        (np.uint16, 12, STACK, 12),
    ]
    for dtype, bit_depth, exposure, expected in cases:
        sensor = _sensor_of(np.full((2, 2), 200, dtype), Sensor(bit_depth=bit_depth), Path("a.png"), exposure)
        assert sensor.bit_depth == expected


@pytest.mark.parametrize(
    ("message", "kind"),
    [("has 640 x 480 px and the camera 320 x 240", "of another size"), ("is truncated", "broken")],
)
def test_other_images_are_of_another_size_or_broken(message: str, kind: str) -> None:
    assert _kind_of(ImagesError(Path("a.png"), message)) == kind


def compared_flight(**values):
    """Return what the methods of a comparison use of it: a flight from 100 s to 200 s, and a camera."""
    gaps = {"gap_within": lambda a, b: SimpleNamespace(reason="a gap", duration_s=2.0) if a < 150 < b else None}
    flight = SimpleNamespace(attitude=SimpleNamespace(first_s=100.0, last_s=200.0, **gaps))
    simulator = SimpleNamespace(flight=flight, camera=camera(640, 480, 500.0))
    return SimpleNamespace(_simulator=simulator, **values)


def test_an_exposure_is_covered_from_the_first_to_the_last_attitude_without_a_gap() -> None:
    flight = compared_flight()
    for start_s, kind in ((100.0, None), (199.5, None), (99.9, "begins 0.100 s before"), (199.6, "ends 0.100 s after")):
        reason = FlightComparison._uncovered(flight, Exposure(start_s, 0.5))
        assert (reason is None) == (kind is None)
        assert kind is None or reason == ("beyond the flight", f"{kind} the flight")
    gap = FlightComparison._uncovered(flight, Exposure(149.9, 0.5))
    assert gap == ("in a gap of the log", "its exposure meets a gap of the log, 2.000 s long")


@pytest.mark.parametrize(("angle_deg", "most_px"), [(0.1, 4.0), (5.0, 500 * np.tan(np.deg2rad(5))), (40.0, 0.4 * 480)])
def test_stars_are_searched_up_to_an_angle_within_the_image(angle_deg: float, most_px: float) -> None:
    flight = compared_flight(_search=Search(angle_rad=float(np.deg2rad(angle_deg))))
    assert FlightComparison._search_px(flight) == pytest.approx(most_px)


@pytest.mark.parametrize("readout_s", [0.08, -0.08])
def test_another_readout_keeps_the_instant_of_an_image(readout_s: float) -> None:
    """With a time in the middle of an image, the middle of the middle row stays where it is."""
    exposure = Exposure(100.0, 0.5, readout_s=0.02)
    flight = compared_flight(_exposures=[(None, exposure)], _given_readout_s=0.02, _fraction_before=lambda _: 0.5)
    delayed = FlightComparison._exposure_at(flight, 0, 0.3, readout_s)
    assert delayed.readout_s == 0.08
    assert delayed.start_utc_s + (0.5 + 0.08) / 2 == pytest.approx(100.3 + (0.5 + 0.02) / 2, abs=1e-9)


def test_the_last_search_says_where_trails_are_by_the_mount_clock_and_readout(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, given, count = np.random.default_rng(1), [], 0
    mount, motion = Mount(0.1, 0.2, 0.3), np.array([1e-3, 2e-3, -1e-3])
    turn = np.array([4e-3, -1e-3, 2e-3])
    last_mount = Mount.from_matrix(matrix_from_quaternion(quaternion_from_turn(-turn)) @ mount.C_camera_body)
    last = _Searched(last_mount, 0.3, 0.02, motion, 10)
    trails = SimpleNamespace(jacobian=rng.normal(0, 100, (7, 4, 8)))

    def paired(_sky, _trails, *, search_px, expected_px):
        given.append((search_px, expected_px))
        return SimpleNamespace(found_indices=range(count))

    monkeypatch.setattr(flights, "pair_trails", paired)
    flight = SimpleNamespace(_searches={3: last}, _search_px=lambda: 9.0)
    for count, is_enough in ((8, True), (7, False)):  # noqa: B007 - `paired` uses it
        pairing = FlightComparison._find_nearby(flight, 3, None, trails, mount, 0.5, 0.06)
        assert (pairing is not None) == is_enough
    expected = trails.jacobian[:, :2, :5] @ np.array([*(motion - turn), 0.3 - 0.5, 0.02 - 0.06])
    assert given[0][0] == 9.0
    np.testing.assert_allclose(given[0][1], expected, rtol=0, atol=1e-9)
    assert FlightComparison._find_nearby(flight, 4, None, trails, mount, 0.5, 0.06) is None


def test_images_of_a_fit_are_evenly_chosen_and_readable() -> None:
    def subtracted(image: int) -> None:
        if image == 0:
            raise ImagesError(Path("a.png"), "is broken")

    flight = SimpleNamespace(_exposures=[(k, None) for k in range(200)], _subtracted_image=subtracted)
    chosen = FlightComparison._usable_images(flight)
    assert chosen == [int(k * 199 / 47) for k in range(1, 48)]
    assert FlightComparison._usable_images(SimpleNamespace(_exposures=[])) == []
