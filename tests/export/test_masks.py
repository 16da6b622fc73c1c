"""Masks without a picture: nodes and interpolation, saturated pixels, the flare, and the pixels of each star."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.config import Config
from glstar.export.convert.labels import MaskRuns
from glstar.export.imagefiles import masks


def scene_of(width_px: int, height_px: int, **more: Any) -> Any:
    return SimpleNamespace(camera=SimpleNamespace(width_px=width_px, height_px=height_px), **more)


@pytest.mark.parametrize(("width_px", "height_px"), [(41, 21), (40, 23), (9, 4), (5, 2), (3, 1)])
def test_values_between_the_nodes_are_bilinear(width_px: int, height_px: int) -> None:
    """A plane and the product of both coordinates over the whole image are what interpolation keeps."""
    x, y = np.meshgrid(np.arange(width_px), np.arange(height_px))
    found = masks._interpolated(scene_of(width_px, height_px), lambda at: 3.0 + 0.25 * at[..., 0] - 0.5 * at[..., 1])
    assert found.shape == (height_px, width_px)
    np.testing.assert_allclose(found, 3.0 + 0.25 * x - 0.5 * y, rtol=0, atol=0.02)


def test_values_are_computed_every_fourth_pixel() -> None:
    asked = []

    def zero(xy_px: np.ndarray) -> np.ndarray:
        asked.append(xy_px)
        return np.zeros(xy_px.shape[:2])

    masks._interpolated(scene_of(41, 21), zero)
    [nodes] = asked
    assert nodes.shape == (6, 11, 2)  # 41 / 4 and 21 / 4, rounded up
    np.testing.assert_allclose(nodes[0, :, 0], np.arange(0, 41, 4), rtol=0, atol=1e-9)
    np.testing.assert_allclose(nodes[:, 0, 1], np.arange(0, 21, 4), rtol=0, atol=1e-9)


def test_the_ground_is_white_below_the_horizon() -> None:
    camera = SimpleNamespace(width_px=9, height_px=9, unit_vectors=lambda at: np.stack([at[..., 1]] * 3, axis=-1))
    scene = SimpleNamespace(
        camera=camera,
        shutter=SimpleNamespace(C_camera_eq=[None, np.eye(3), None]),
        above_horizon=lambda vectors: 4.5 - vectors[..., 0],
    )
    np.testing.assert_array_equal(masks.ground_mask(scene), np.repeat([[0], [255]], [5, 4], axis=0) * np.ones(9))


def test_a_pixel_is_saturated_from_the_full_digital_number_on() -> None:
    scene = SimpleNamespace(sensor=SimpleNamespace(full_dn=4095))
    pixels = np.array([[0, 4094, 4095, 4096]], np.uint16)
    assert masks.saturated_mask(scene, SimpleNamespace(pixels=pixels, saturated=None)).tolist() == [[0, 0, 255, 255]]
    full = np.array([[True, False, False, True]])
    assert masks.saturated_mask(scene, SimpleNamespace(pixels=pixels, saturated=full)).tolist() == [[255, 0, 0, 255]]


def test_the_flare_has_sixteen_steps_per_digital_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def flare_dn(_scene: object, xy_px: np.ndarray) -> np.ndarray:
        return np.where(xy_px[..., 0] == 2, 1e6, xy_px[..., 0] + 0.7 * xy_px[..., 1])

    monkeypatch.setattr(masks, "flare_dn", flare_dn)
    assert masks.flare_mask(scene_of(3, 2)).tolist() == [[0, 16, 65535], [11, 27, 65535]]


def test_masks_are_written_of_what_the_config_has() -> None:
    assert masks.masks_of(Config(), masks=False) == ()
    assert masks.masks_of(Config(), masks=True)[:2] == ("trails", "saturated")


def test_the_pixels_of_each_star_are_those_of_the_mask() -> None:
    """Star 3 (value 4) has no pixel, and there is none beyond the last."""
    rng = np.random.default_rng(3)
    mask = rng.choice([0, 1, 2, 3, 5], (13, 17), p=[0.6, 0.1, 0.1, 0.1, 0.1]).astype(np.uint16)
    mask[0, 0], mask[-1, -1], mask[5:9, 4] = 1, 2, 3
    runs = MaskRuns.of(mask)
    for index in range(7):
        found = runs.annotation(index)
        rows, columns = np.nonzero(mask == index + 1)
        if not rows.size:
            assert found == {}
            continue
        # Lengths of alternating runs of other pixels and of the star's, down the columns.
        counts, size = found["segmentation"]["counts"], found["segmentation"]["size"]
        decoded = np.concatenate([np.full(count, turn % 2 == 1) for turn, count in enumerate(counts)])
        np.testing.assert_array_equal(decoded.reshape(size[::-1]).T, mask == index + 1)
        assert found["area"] == rows.size
        assert found["bbox"] == [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
    assert MaskRuns.of(np.zeros((3, 4), np.uint16)).annotation(0) == {}
