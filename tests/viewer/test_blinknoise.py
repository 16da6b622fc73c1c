"""Blinking with the image without noise."""

import numpy as np
import pytest

from glstar.config import Config
from tests.support.windowinput import press, screen


class Clock:
    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


@pytest.mark.parametrize("noise", ["paper", "electrons"])
def test_the_image_blinks_with_the_same_without_noise(make_viewer, small: Config, noise):
    viewer = make_viewer(config=small.override(**{"sensor.noise": noise}))
    session = viewer.session
    clock = Clock()
    session.comparison._clock = clock
    session.comparison._blinks_from_s = 0.0
    before = session.image.pixels.copy()
    press(viewer, "Shift+N")
    assert session.busy
    shown: dict[float, tuple[np.ndarray, np.ndarray]] = {}
    for phase in (0.25, 0.75, 0.3):
        clock.seconds = phase * session.comparison.blink_period_s
        viewer.frame(0.0)
        viewer.frame(0.0)
        shown[phase] = session.image.pixels.astype(float), screen(viewer).copy()
    np.testing.assert_array_equal(shown[0.25][0], before)
    np.testing.assert_array_equal(shown[0.3][0], before)
    dark = shown[0.75][0]
    assert np.std(before - dark) > 1.0
    assert abs(np.mean(before - dark)) < 0.3 * np.std(before - dark)
    assert (shown[0.25][1] != shown[0.75][1]).any()
    # It is the starlight of the truth on a level background, rounded.
    light_dn = session.renderer.render(session.scene, seed=0, light=True).light_dn
    level_dn = dark.flat[light_dn.argmin()]
    expected_dn = np.minimum(light_dn + level_dn, session.scene.sensor.saturation_dn)
    np.testing.assert_allclose(dark, expected_dn, rtol=0, atol=1.0)
    press(viewer, "Shift+N")
    viewer.frame(0.0)
    np.testing.assert_array_equal(session.image.pixels, before)
