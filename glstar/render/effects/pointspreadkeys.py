"""Profile, wings, halo, ellipticity and varying width of stars: keys of what the star passes draw."""

from collections.abc import Mapping
from typing import Any

from glstar.camera.pointspread import PointSpread
from glstar.render.effects.effect import Control, Effect, Key, Stage, Values
from glstar.render.scene import Scene

__all__ = ["POINT_SPREAD"]

_PLAIN = PointSpread()


def _is_active(values: Values) -> bool:
    return not PointSpread.of({f"sensor.{key}": value for key, value in values.items()}).is_gaussian


def _truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    sensor = scene.sensor
    components = sensor.point_spread.circular(sensor.psf_sigma_px)
    return {
        "psf": {
            "psf_sigma_px": sensor.psf_sigma_px,
            **sensor.point_spread.keys,
            "gaussians": [[one.flux_fraction, one.sigma_px] for one in components],
        }
    }


POINT_SPREAD = Effect(
    name="point_spread",
    section="sensor",
    keys=(
        Key(
            "psf",
            _PLAIN.psf,
            allowed="'gaussian' or 'moffat'",
            choices=("gaussian", "moffat"),
            control=Control("Star profile"),
        ),
        Key(
            "psf_beta",
            _PLAIN.psf_beta,
            allowed="an exponent from 2 to 20",
            minimum=2.0,
            maximum=20.0,
            control=Control("Moffat beta", 2.0, 8.0, "%.2f"),
        ),
        Key(
            "psf_wing_fraction",
            _PLAIN.psf_wing_fraction,
            allowed="a fraction from 0 to 0.9",
            minimum=0.0,
            maximum=0.9,
            control=Control("Wings", 0.0, 0.5, "%.3f of the flux"),
        ),
        Key(
            "psf_wing_sigma_px",
            _PLAIN.psf_wing_sigma_px,
            allowed="a number of pixels from 0.1 to 40",
            minimum=0.1,
            maximum=40.0,
            control=Control("Wing sigma", 1.0, 20.0, "%.2f px"),
        ),
        Key(
            "psf_halo_fraction",
            _PLAIN.psf_halo_fraction,
            allowed="a fraction from 0 to 0.5",
            minimum=0.0,
            maximum=0.5,
            control=Control("Halo", 0.0, 0.1, "%.4f of the flux"),
        ),
        Key(
            "psf_halo_radius_px",
            _PLAIN.psf_halo_radius_px,
            allowed="a number of pixels from 1 to 40",
            minimum=1.0,
            maximum=40.0,
            control=Control("Halo radius", 1.0, 40.0, "%.1f px"),
        ),
        Key(
            "psf_growth",
            _PLAIN.psf_growth,
            allowed="a fraction from 0 to 4",
            minimum=0.0,
            maximum=4.0,
            control=Control("Growth to the corners", 0.0, 2.0, "%.3f"),
        ),
        Key(
            "psf_ellipticity",
            _PLAIN.psf_ellipticity,
            allowed="a number from 0 to 0.4",
            minimum=0.0,
            maximum=0.4,
            control=Control("Ellipticity", 0.0, 0.4, "%.3f"),
        ),
        Key(
            "psf_angle_deg",
            0.0,
            allowed="degrees from -360 to 360",
            minimum=-360.0,
            maximum=360.0,
            control=Control("Major axis", -90.0, 90.0, "%.0f deg"),
        ),
        Key(
            "psf_tilt",
            _PLAIN.psf_tilt,
            allowed="a fraction from 0 to 0.9",
            minimum=0.0,
            maximum=0.9,
            control=Control("Tilt of the sensor", 0.0, 0.9, "%.3f"),
        ),
        Key(
            "psf_tilt_angle_deg",
            0.0,
            allowed="degrees from -360 to 360",
            minimum=-360.0,
            maximum=360.0,
            control=Control("Wider towards", -180.0, 180.0, "%.0f deg"),
        ),
        Key(
            "psf_colour_growth",
            _PLAIN.psf_colour_growth,
            allowed="a fraction from -0.5 to 0.5",
            minimum=-0.5,
            maximum=0.5,
            control=Control("Growth with B - V", -0.5, 0.5, "%.3f"),
        ),
    ),
    stage=Stage.STARS,
    glsl="",
    truth=_truth,
    is_active=_is_active,
)
