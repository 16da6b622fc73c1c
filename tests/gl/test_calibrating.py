"""Calibration of images that the exporter's renderer draws with a known camera.

``poe bench calibrate`` tests many images of all kinds.
"""

import pytest

from tests.bench.calibration import Kind, photo_of, recovered


@pytest.mark.parametrize(
    ("kind", "lost"),
    [
        (Kind(fov_deg=10.0, sigma_px=1.2, sky_dn=2.0, bit_depth=8, seed=6), False),
        (Kind(fov_deg=27.0, sigma_px=0.7, sky_dn=60.0, bit_depth=16, seed=23), True),
        (Kind(fov_deg=60.0, sigma_px=3.0, sky_dn=16.0, bit_depth=8, seed=50), False),
    ],
)
def test_a_hidden_camera_is_recovered_within_tolerances(renderer, kind, lost, kept_patterns) -> None:
    """Sigma and sky within 2 %, peak within 0.05 mag, f within 0.1 %, attitude within 20", 95 % found, none false."""
    if lost:
        pytest.importorskip("tetra3rs")
    result = recovered(photo_of(kind, renderer), kind, lost=lost)
    assert result.is_accurate, result
