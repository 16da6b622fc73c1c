"""Which stars of a scene are predicted as trails, from a scene and a frame composed by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import prediction
from glstar.compare.prediction import (
    ExposedPaths,
    Trails,
    _trail_jacobians,
    offsets_and_directions,
    predicted_trails,
)
from tests.compare.test_pathshapes import trails
from tests.support.scenes import camera

LENS = camera(220, 180, 300.0)
SENSOR = Sensor(psf_sigma_px=1.6, bit_depth=12)
U = np.linspace(-0.5, 0.5, 21)[:, np.newaxis]
STEP = np.array([14.0, 6.0])
# Middles of trails: two whole ones, one at the edge, one beyond, a faint one, and one beside the first.
MIDDLES = np.array([[60.0, 60], [150, 90], [15, 120], [300, 90], [110, 140], [60, 66.5]])
EXPOSED = np.array([1.0, 0.8, 1.0, 1.0, 1.0, 1.0])


def drawn(flux_dn: np.ndarray) -> np.ndarray:
    """Return the light of all trails."""
    rows, columns = np.indices((180, 220))
    sigma_px = SENSOR.effective_sigma_px
    total = np.zeros((180, 220))
    for flux, (x, y) in zip(flux_dn, MIDDLES, strict=True):
        for dx, dy in U * STEP:
            total += flux / 21 * np.exp(-((columns - x - dx) ** 2 + (rows - y - dy) ** 2) / (2 * sigma_px**2))
    return (total / (2 * np.pi * sigma_px**2)).astype(np.float32)


def predicted(
    monkeypatch: pytest.MonkeyPatch, exposure: Exposure, fractions: list[float], **limits
) -> tuple[Trails, list]:
    """Return the trails of stars whose upper bounds are given as fractions of the least signal, and what was asked."""
    noise_dn, least, most = limits["noise_dn"], limits["least_signal"], limits["most"]
    # The signal-to-noise ratio of a star at rest is its flux over 2 sqrt(pi) sigma times the noise.
    flux_dn = np.array(fractions) * least * 2 * np.sqrt(np.pi) * SENSOR.effective_sigma_px * noise_dn
    short_dn = flux_dn / exposure.signal_factor
    magnitude = -2.5 * np.log10(short_dn / float(SENSOR.flux_dn(SENSOR.peak_dn(0.0, exposure.duration_s))))
    count, asked = len(fractions), []
    visible = np.arange(count) + 2  # two stars of the catalogue are not visible
    stars = SimpleNamespace(
        catalogue="tycho2",
        vmag=np.arange(count + 2) / 10,
        star_id=100 + np.arange(count + 2),
        name=tuple(f"star {k}" for k in range(count + 2)),
        direction_eq=np.arange(3.0 * (count + 2)).reshape(-1, 3),
    )
    scene = SimpleNamespace(
        sensor=SENSOR, camera=LENS, exposure=exposure, stars=stars, visible=visible, observed_mag=magnitude
    )

    def paths(_, direction_eq):
        which = (direction_eq[:, 0] / 3 - 2).astype(int)
        asked.append(which.tolist())
        xy_px = MIDDLES[which] + U[:, :, np.newaxis] * STEP
        return ExposedPaths(LENS.unit_vectors(xy_px), 0.01, EXPOSED[which], U[:, 0])

    def jacobians(_, __, which, trails):
        asked.append(which.tolist())
        return np.arange(32.0 * len(trails)).reshape(-1, 4, 8)

    monkeypatch.setattr(prediction, "exposed_paths", paths)
    monkeypatch.setattr(prediction, "_trail_jacobians", jacobians)
    light = drawn(flux_dn * EXPOSED)
    frame = SimpleNamespace(light_dn=light, pixels=np.full((180, 220), 77, np.uint16))
    return predicted_trails(scene, frame, noise_dn=noise_dn, least_signal=least, most=most), asked


def test_whole_isolated_trails_above_the_noise_are_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    exposure = Exposure(5.0, 0.2)
    limits = {"noise_dn": 2.5, "least_signal": 10.0, "most": 9}
    found, asked = predicted(monkeypatch, exposure, [40.0, 70.0, 9.0, 9.0, 1.04, 0.96], **limits)

    # The last one is too faint at rest; of the others two are not whole, one touches the image.
    assert asked == [[0, 1, 2, 3, 4], [1, 0]]
    assert (found.catalogue, found.star_id.tolist(), found.name) == ("tycho2", [103, 102], ("star 3", "star 2"))
    assert found.vmag.tolist() == [0.3, 0.2]
    assert (found.cut_off, found.blended, found.sigma_px) == (1, 0, SENSOR.effective_sigma_px)
    np.testing.assert_allclose(found.path_px, MIDDLES[[1, 0]] + U[:, :, np.newaxis] * STEP, rtol=0, atol=1e-9)
    background_dn = float(SENSOR.background_mean_dn(0.2))
    np.testing.assert_allclose(found.pixels_dn, 77 - background_dn, rtol=1e-5)
    assert found.headroom_dn == pytest.approx(4095 - background_dn)
    assert found.jacobian.tolist() == np.arange(64.0).reshape(2, 4, 8).tolist()
    # A trail has less of it than a star at rest: the root of the sum of squares.
    light = found.signal_dn.astype(float)
    halves = light[:, 110:], light[:, :110]
    expected = [np.sqrt((half[:120] ** 2).sum()) / 2.5 for half in halves]
    np.testing.assert_allclose(found.signal_to_noise, expected, rtol=0.02)
    assert predicted(monkeypatch, exposure, [40.0, 70.0, 9.0, 9.0, 1.04, 0.96], **limits | {"most": 1})[
        0
    ].star_id.tolist() == [103]


def test_blended_trails_are_counted_but_not_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    found, asked = predicted(
        monkeypatch, Exposure(5.0, 0.2), [9.0, 12.0, 9.0, 9.0, 5.0, 4.0], noise_dn=2.5, least_signal=10.0, most=9
    )
    # The first trail has a neighbour 6.5 px below it, and it is beside the neighbour.
    assert (found.star_id.tolist(), found.blended, found.cut_off) == ([103, 106], 2, 1)
    assert asked[0] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(("stack", "factor"), [("sum", 3), ("mean", 1)])
def test_a_stack_is_saturated_by_one_short_exposure(stack: str, factor: int, monkeypatch: pytest.MonkeyPatch) -> None:
    exposure = Exposure(5.0, 0.2, frames=3, stack=stack)
    found, asked = predicted(
        monkeypatch, exposure, [40.0, 70.0, 9.0, 9.0, 1.04, 0.96], noise_dn=2.5, least_signal=10.0, most=9
    )
    assert (asked[0], found.star_id.tolist()) == ([0, 1, 2, 3, 4], [103, 102])
    background_dn = float(SENSOR.background_mean_dn(0.2))
    assert found.headroom_dn == pytest.approx((4095 - background_dn) * factor / 3)
    np.testing.assert_allclose(found.pixels_dn, 77 - factor * background_dn, rtol=1e-5)


def test_a_direction_is_from_the_first_to_the_last_point() -> None:
    # A path that turns back after its first and before its last step.
    x = np.array([0.0, 3.0, -5.0, -11.0, 1.0])
    forth = np.column_stack([x, 0.5 * x])[:, np.newaxis]
    offset, along = offsets_and_directions(np.concatenate([forth, forth[::-1]], axis=1))
    np.testing.assert_allclose(along, np.array([[2, 1], [-2, -1]]) / np.sqrt(5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(offset[:, 0, 0], x + 2.4, rtol=0, atol=1e-12)


def test_two_samples_of_each_short_exposure_have_no_rate() -> None:
    xy_px = MIDDLES[:2] + np.linspace(-0.5, 0.5, 6)[:, np.newaxis, np.newaxis] * STEP
    paths = ExposedPaths(LENS.unit_vectors(xy_px), 0.01, EXPOSED[:2], np.linspace(-0.5, 0.5, 6), pieces=3)
    found = _trail_jacobians(
        SimpleNamespace(camera=LENS), paths, np.array([0, 1]), trails(list(np.swapaxes(xy_px, 0, 1)))
    )
    assert not found[..., 3:5].any()
    # A turn about the down axis, to the right, moves stars to the left.
    assert found[0, 0, 1] == pytest.approx(-300 * (1 + ((60 - 109.5) / 300) ** 2), rel=2e-3)
