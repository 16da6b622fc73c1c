"""Kinds of images that a comparison leaves out."""

from pathlib import Path

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.compare.flights import _kind_of, _sensor_of
from glstar.errors import ImagesError

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
