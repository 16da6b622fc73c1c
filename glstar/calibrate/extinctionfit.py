"""Extinction in one photograph: fitted to its stars, or given, and taken out of the reference brightness."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.brightnessterms import robust_fit
from glstar.calibrate.calibration import Calibration
from glstar.calibrate.misfitmeasurement import corner_distance, measure_misfit
from glstar.errors import CalibrationError
from glstar.render.pointing import Pointing
from glstar.sky.extinction import air_mass
from glstar.sky.starcolours import USUAL_BV, star_colours
from glstar.statistics import robust_std

__all__ = ["AirTerm", "above_air"]

Float = NDArray[np.float64]

# A fit needs stars whose air masses differ by this much, between the 5th and the 95th percentile, and this many stars.
_LEAST_SPAN: Final = 0.5
_LEAST_STARS: Final = 20
# A term besides the extinction needs this many stars.
_STARS_PER_TERM: Final = 10
# Colours beyond which the band's polynomial is constant.
_VALID_BV: Final = (-0.3, 1.7)


@dataclass(frozen=True, slots=True)
class AirTerm:
    """The extinction that was taken out of a calibration.

    Attributes
    ----------
    zenith_mag : float
        Extinction per air mass, mag.
    error_mag : float or None
        Its standard error; None if it was given.
    lowest_mass, highest_mass : float
        Air masses of the stars used.
    stars : int
    """

    zenith_mag: float
    error_mag: float | None
    lowest_mass: float
    highest_mass: float
    stars: int

    def to_json(self) -> dict[str, Any]:
        """Return the term as JSON-serialisable values."""
        return {
            "reference_is": "above the air",
            "zenith_extinction_mag": self.zenith_mag,
            "standard_error_mag": self.error_mag,
            "air_mass": [self.lowest_mass, self.highest_mass],
            "stars": self.stars,
        }

    @property
    def note(self) -> str:
        """What was done, for the user."""
        masses = f"air masses {self.lowest_mass:.2f} to {self.highest_mass:.2f}"
        how = "as given" if self.error_mag is None else f"± {self.error_mag:.3f}, fitted"
        return (
            f"reference_peak_dn is above the air: {self.zenith_mag:.3f} mag per air mass ({how}; {self.stars} stars,"
            f' {masses}) are taken out; simulate with [sky] extinction = "standard"'
        )


def above_air(calibration: Calibration, zenith_mag: float | None = None) -> Calibration:
    """Return a calibration whose reference brightness is that above the air.

    Parameters
    ----------
    calibration : Calibration
        Of an image whose site, time and attitude are known.
    zenith_mag : float, optional
        Extinction per air mass, mag; by default it is fitted.

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationError
        If the zenith is unknown, or the stars do not show the extinction.

    Notes
    -----
    Magnitudes measured minus fitted are a + k X + b (B - V) + c r^2, with X the air mass; b and c, which are centred
    on the stars, keep band and vignetting out of k.
    """
    mass = _air_masses(calibration)
    used = calibration.brightness.used & (calibration.stars.peak_dn > 0)
    off_mag = calibration.off_mag
    if zenith_mag is None:
        offset_mag, error_mag, k, k_error = _fitted(calibration, mass, off_mag, used)
    else:
        free = off_mag[used] - zenith_mag * mass[used]
        offset_mag, k, k_error = float(np.median(free)), zenith_mag, None
        error_mag = robust_std(free, offset_mag) * float(np.sqrt(np.pi / 2 / used.sum()))
    brighter = float(10 ** (-0.4 * offset_mag))
    left = off_mag[used] - offset_mag - k * mass[used]
    air = AirTerm(k, k_error, float(mass[used].min()), float(mass[used].max()), int(used.sum()))
    fit = replace(
        calibration.brightness,
        reference_peak_dn=calibration.brightness.reference_peak_dn * brighter,
        scatter_mag=robust_std(left, float(np.median(left))),
        error_mag=error_mag,
    )
    sensor = replace(calibration.sensor, reference_peak_dn=fit.reference_peak_dn)
    # What else the sensor lacks is measured again, because the air dims one side of the image, as vignetting does.
    dimmed = replace(calibration.stars, vmag=calibration.stars.vmag + k * mass)
    misfit = measure_misfit(calibration.image, calibration.detected, calibration.matches, sensor, fit, dimmed)
    before = calibration.misfit.notes(calibration.sensor, linear=fit.linear)
    kept = (note for note in calibration.notes if note not in before)
    return replace(
        calibration,
        sensor=sensor,
        brightness=fit,
        misfit=misfit,
        notes=(air.note, *kept, *misfit.notes(sensor, linear=fit.linear)),
        extinction_mag=k * mass,
        air=air.to_json(),
    )


def _air_masses(calibration: Calibration) -> Float:
    """Return the air masses of the identified stars."""
    reference = calibration.reference
    if reference.C_ned_eq is None:
        raise CalibrationError(
            "--extinction needs the altitude of the stars, so the site and the time of the image: give --utc, --lat,"
            " --lon, --yaw, --pitch and --roll, or --flight and --utc"
        )
    pointing = Pointing(
        calibration.matches.solution.C_camera_eq[np.newaxis],
        reference.zenith_eq[np.newaxis],
        reference.velocity_eq[np.newaxis],
        reference.refraction_scale,
    )
    return air_mass(pointing.sine_apparent_altitude(reference.stars.direction_eq[calibration.matches.star])[0])


def _fitted(
    calibration: Calibration, mass: Float, off_mag: Float, used: NDArray[np.bool_]
) -> tuple[float, float, float, float]:
    """Return the offset above the air and the extinction per air mass, each with its standard error, mag."""
    low, high = np.percentile(mass[used], [5, 95])
    if used.sum() < _LEAST_STARS or high - low < _LEAST_SPAN:
        raise CalibrationError(
            f"the extinction needs {_LEAST_STARS} stars whose air masses differ by {_LEAST_SPAN:g}, and the image has"
            f" {int(used.sum())} of {low:.2f} to {high:.2f}: take a wider image down to low altitudes, or give the"
            " extinction per air mass, as --extinction 0.28",
            stars_used=int(used.sum()),
            stars_needed=_LEAST_STARS,
        )
    bv = star_colours(calibration.reference.stars)[calibration.matches.star]
    bv = np.clip(np.nan_to_num(bv, nan=USUAL_BV), *_VALID_BV)
    across = corner_distance(calibration.image, calibration.matches, calibration.stars.xy_px) ** 2
    more = [one - np.median(one[used]) for one in (bv, across)][: int(used.sum()) // _STARS_PER_TERM]
    design = np.column_stack([np.ones_like(mass), mass, *more])[used]
    noise_mag = 1.0857 * calibration.stars.noise_dn[used] / calibration.stars.peak_dn[used]
    p, error, _ = robust_fit(design, off_mag[used], noise_mag)
    return float(p[0]), float(error[0]), float(p[1]), float(error[1])
