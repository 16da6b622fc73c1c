"""The limiting magnitude of a sensor: the faintest star that it records with a given signal-to-noise ratio."""

from math import exp, log10, nan, pi, sqrt
from typing import Final

from glstar.camera.sensor import Sensor

__all__ = ["LIMITING_SNR", "limiting_mag", "noise_equivalent_area_px2"]

# Signal-to-noise ratio at which a star is taken as detected.
LIMITING_SNR: Final = 5.0
# Variance of rounding to whole numbers, DN^2.
_QUANTISATION_VARIANCE_DN2: Final = 1 / 12


def noise_equivalent_area_px2(sensor: Sensor) -> float:
    """Return the noise-equivalent area of a star that does not move, on the optical axis.

    Parameters
    ----------
    sensor : Sensor

    Returns
    -------
    float
        1 over the integral of its squared profile, px^2: 4 pi sigma^2 for a Gaussian.

    Notes
    -----
    King 1983, PASP 95, 163.  Two Gaussians of the variances s and t at the distance d overlap by
    exp(-d^2 / 2 (s + t)) / 2 pi (s + t).
    """
    parts = [
        (one.flux_fraction, sensor.of_component(one).effective_sigma_px ** 2, one.offset_px)
        for one in sensor.point_spread.components(sensor.psf_sigma_px)
    ]
    squared = 0.0
    for fraction, variance_px2, (x_px, y_px) in parts:
        for other_fraction, other_px2, (other_x_px, other_y_px) in parts:
            both_px2 = variance_px2 + other_px2
            separation_px2 = (x_px - other_x_px) ** 2 + (y_px - other_y_px) ** 2
            squared += fraction * other_fraction * exp(-separation_px2 / (2 * both_px2)) / (2 * pi * both_px2)
    return 1 / squared


def limiting_mag(sensor: Sensor, duration_s: float, area_px2: float, *, sky_dn: float = 0.0, frames: int = 1) -> float:
    """Return the magnitude of a star that a matched filter finds with a signal-to-noise ratio of 5.

    Valid for both noise models.  Row noise, fixed patterns, a colour mosaic and processing in the camera are not in it.

    Parameters
    ----------
    sensor : Sensor
    duration_s : float
        Exposure time, s; of each short exposure of a stacked image.
    area_px2 : float
        Noise-equivalent area of the star or of its trail, px^2.
    sky_dn : float
        Signal per pixel of a sky that the sensor's own background does not have, DN; with shot noise in electrons.
    frames : int
        Number of short exposures in the image, whose ratio is sqrt(frames) times that of one.

    Returns
    -------
    float
        In the camera's band, as it reaches the lens, on the optical axis; NaN if the background saturates.

    Notes
    -----
    Merline & Howell 1995, Exp. Astron. 6, 163, eq. (1), solved for the flux F: F^2 = SNR^2 (K F + A v), with K DN per
    electron (0 in the paper's noise model), the noise-equivalent area A, and the variance v of a pixel without a star.
    """
    model = sensor.electrons
    dn_per_e = 0.0 if model is None else model.dn_per_e
    is_full = model is not None and model.background_e(duration_s) + sky_dn / dn_per_e >= model.full_well_e
    if is_full or sensor.background_mean_dn(duration_s) + sky_dn >= sensor.saturation_dn:
        return nan
    variance_dn2 = sensor.background_std_dn(duration_s) ** 2 + dn_per_e * sky_dn + _QUANTISATION_VARIANCE_DN2
    squared_snr = LIMITING_SNR**2 / frames
    shot_dn = squared_snr * dn_per_e
    flux_dn = (shot_dn + sqrt(shot_dn**2 + 4 * squared_snr * area_px2 * variance_dn2)) / 2
    return -2.5 * log10(flux_dn / float(sensor.flux_of_magnitude_dn(0.0, duration_s)))
