"""When stars cross the horizon during an exposure, against roots of their exact heights."""

import numpy as np
import pytest
from scipy.optimize import brentq

from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.occlusion import NEVER, rise_and_set
from glstar.sky.air.refraction import refraction_displacement, refraction_scale
from tests.support.scenes import camera

EARTH_RAD_PER_S = 7.292115e-5
LATITUDE_RAD = np.deg2rad(-35.0)
# Ends of segments of different lengths, s.
ENDS_S = np.array([0.0, 0.3, 1.0, 1.1, 5.0, 60.0])
SCALE = float(refraction_scale(1010.0, 10.0))


def zenith(time_s):
    turned = EARTH_RAD_PER_S * np.asarray(time_s)
    return np.stack(
        [
            np.cos(LATITUDE_RAD) * np.cos(turned),
            np.cos(LATITUDE_RAD) * np.sin(turned),
            np.full_like(turned, np.sin(LATITUDE_RAD)),
        ],
        axis=-1,
    )


def pointing(time_s, *, scale=SCALE, sine_horizon=0.0):
    n = len(time_s)
    return Pointing(np.tile(np.eye(3), (n, 1, 1)), zenith(time_s), np.zeros((n, 3)), scale, sine_horizon)


def segments(ends_s=ENDS_S, **sky):
    times_s = np.interp(np.arange(2 * len(ends_s) - 1) / 2, np.arange(len(ends_s)), ends_s)
    return AnalyticSegments(pointing(times_s, **sky), np.diff(ends_s) / ends_s[-1])


def star(azimuth_rad, sine_apparent_altitude, time_s, scale=SCALE):
    """Return the direction of a star that is at an apparent altitude, without refraction."""
    up = zenith(time_s)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    level = np.cos(azimuth_rad) * np.cross(up, east) + np.sin(azimuth_rad) * east
    s = brentq(lambda s: s + refraction_displacement(s, scale) - sine_apparent_altitude, -0.05, 0.05, xtol=1e-15)
    return s * up + np.sqrt(1 - s * s) * level


@pytest.mark.parametrize("sine_horizon", [0.0, -0.004])
@pytest.mark.parametrize("azimuth_deg", [92.0, 272.0, 30.0, 178.0])
@pytest.mark.parametrize("crosses_s", [0.17, 0.99, 1.05, 3.7, 41.0])
def test_a_star_rises_in_the_east_and_sets_in_the_west_at_the_exact_time(crosses_s, azimuth_deg, sine_horizon):
    direction = star(np.deg2rad(azimuth_deg), sine_horizon, crosses_s)
    ((rises, sets),) = rise_and_set(segments(sine_horizon=sine_horizon), direction[np.newaxis], camera()) * ENDS_S[-1]
    # Refraction is a rational function, and a segment's heights a quadratic: 2.5 ms in the segment of 55 s, in which a
    # camera that does not turn sees the star move by 0.0002 px at f = 1000 px.
    tolerance_s = 3e-3 if crosses_s > 5.0 else 2e-6
    if azimuth_deg < 180.0:
        assert rises == pytest.approx(crosses_s, rel=0, abs=tolerance_s)
        assert sets == NEVER * ENDS_S[-1]
    else:
        assert sets == pytest.approx(crosses_s, rel=0, abs=tolerance_s)
        assert rises == 0.0


def test_stars_that_stay_above_or_below_the_horizon_do_not_cross_it():
    heights = [0.3, 0.01, 0.005, -0.005, -0.01, -0.3]
    directions = np.array([star(np.deg2rad(90.0), h, 0.0) if abs(h) < 0.02 else h * zenith(0.0) for h in heights])
    expected = [[0.0, NEVER]] * 3 + [[NEVER, NEVER]] * 3
    np.testing.assert_array_equal(rise_and_set(segments(), directions, camera()), expected)


def test_a_star_that_sets_and_rises_again_has_both_times():
    """At lower culmination, in the south, for two hours."""
    ends_s = np.linspace(0.0, 7200.0, 13)
    south = -zenith(3600.0)[:2] / np.linalg.norm(zenith(3600.0)[:2])
    declination = -(np.pi / 2 + LATITUDE_RAD) + 0.002
    direction = np.append(np.cos(declination) * south, np.sin(declination))
    # Without refraction, hour angles of half a turn from the crossing are known in closed form.
    half_s = np.arccos(np.tan(LATITUDE_RAD) * np.tan(declination)) / EARTH_RAD_PER_S
    ((rises, sets),) = rise_and_set(segments(ends_s, scale=0.0), direction[np.newaxis], camera()) * ends_s[-1]
    assert [sets, rises] == pytest.approx([3600.0 - half_s, 3600.0 + half_s], rel=0, abs=0.1)
