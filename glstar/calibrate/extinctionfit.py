"""Extinction in photographs: fitted to its stars, or given, and taken out of the reference brightness."""

from collections.abc import Callable, Sequence
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
from glstar.sky.starcolours import USUAL_BV, VALID_BV, star_colours
from glstar.statistics import robust_std

__all__ = ["AirTerm", "above_air", "above_air_together"]

Float = NDArray[np.float64]

# A fit needs stars whose air masses differ by this much, between the 5th and the 95th percentile, and this many stars.
_LEAST_SPAN: Final = 0.5
_LEAST_STARS: Final = 20
# A term besides the extinction needs this many stars.
_STARS_PER_TERM: Final = 10


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
    As `above_air_together` with one image.
    """
    return above_air_together((calibration,), zenith_mag)[0]


def above_air_together(parts: Sequence[Calibration], zenith_mag: float | None = None) -> tuple[Calibration, ...]:
    """Return calibrations of photographs of one night, whose reference brightness is that above the air.

    Parameters
    ----------
    parts : sequence of Calibration
        Of images whose site, time and attitude are known.
    zenith_mag : float, optional
        Extinction per air mass, mag; by default one value is fitted to the stars of all images.

    Returns
    -------
    tuple of Calibration
        In the order of the images.

    Raises
    ------
    CalibrationError
        If a zenith is unknown, or the stars do not show the extinction.

    Notes
    -----
    Magnitudes measured minus fitted are a + k X + b (B - V) + c r^2, with X the air mass; b and c, which are centred
    on the stars, keep band and vignetting out of k.  Each image has an a of its own, for haze, and exposures that are
    not quite those given.
    """
    masses = [_air_masses(part) for part in parts]
    used = [part.brightness.used & (part.stars.peak_dn > 0) for part in parts]
    if zenith_mag is None:
        offsets, k, k_error = _fitted(parts, masses, used)
    else:
        offsets = [_offset(part, zenith_mag * mass, some) for part, mass, some in zip(parts, masses, used, strict=True)]
        k, k_error = zenith_mag, None
    seen = np.concatenate([mass[some] for mass, some in zip(masses, used, strict=True)])
    air = AirTerm(k, k_error, float(seen.min()), float(seen.max()), seen.size)
    return tuple(
        _taken_out(part, k * mass, some, *offset, air)
        for part, mass, some, offset in zip(parts, masses, used, offsets, strict=True)
    )


def _offset(part: Calibration, lost_mag: Float, used: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the offset above the air and its standard error, mag."""
    free = (part.off_mag - lost_mag)[used]
    offset_mag = float(np.median(free))
    return offset_mag, robust_std(free, offset_mag) * float(np.sqrt(np.pi / 2 / free.size))


def _taken_out(
    calibration: Calibration,
    lost_mag: Float,
    used: NDArray[np.bool_],
    offset_mag: float,
    error_mag: float,
    air: AirTerm,
) -> Calibration:
    """Return a calibration with the extinction of each star taken out, and its offset above the air."""
    left = (calibration.off_mag - offset_mag - lost_mag)[used]
    fit = replace(
        calibration.brightness,
        reference_peak_dn=calibration.brightness.reference_peak_dn * float(10 ** (-0.4 * offset_mag)),
        scatter_mag=robust_std(left, float(np.median(left))),
        error_mag=error_mag,
    )
    sensor = replace(calibration.sensor, reference_peak_dn=fit.reference_peak_dn)
    # What else the sensor lacks is measured again, because the air dims one side of the image, as vignetting does.
    dimmed = replace(calibration.stars, vmag=calibration.stars.vmag + lost_mag)
    misfit = measure_misfit(calibration.image, calibration.detected, calibration.matches, sensor, fit, dimmed)
    before = calibration.misfit.notes(calibration.sensor, linear=fit.linear)
    kept = (note for note in calibration.notes if note not in before)
    return replace(
        calibration,
        sensor=sensor,
        brightness=fit,
        misfit=misfit,
        notes=(air.note, *kept, *misfit.notes(sensor, linear=fit.linear)),
        extinction_mag=lost_mag,
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
    parts: Sequence[Calibration], masses: Sequence[Float], used: Sequence[NDArray[np.bool_]]
) -> tuple[list[tuple[float, float]], float, float]:
    """Return the offset of each image above the air with its error, and the extinction per air mass with its, mag."""
    mass = np.concatenate([one[some] for one, some in zip(masses, used, strict=True)])
    spans = [np.percentile(one[some], [5, 95]) for one, some in zip(masses, used, strict=True) if some.any()]
    if mass.size < _LEAST_STARS or max(high - low for low, high in spans) < _LEAST_SPAN:
        low, high = max(spans, key=lambda span: span[1] - span[0]) if spans else (np.nan, np.nan)
        where = "the image has" if len(parts) == 1 else "the images have, at best on one of them,"
        raise CalibrationError(
            f"the extinction needs {_LEAST_STARS} stars whose air masses differ by {_LEAST_SPAN:g}, and {where}"
            f" {mass.size} of {low:.2f} to {high:.2f}: take a wider image down to low altitudes, or give the"
            " extinction per air mass, as --extinction 0.28",
            stars_used=mass.size,
            stars_needed=_LEAST_STARS,
        )

    def of_all(values: Callable[[Calibration], NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([values(part)[some] for part, some in zip(parts, used, strict=True)])

    bv = of_all(lambda part: star_colours(part.reference.stars, part.matches.star))
    bv = np.clip(np.nan_to_num(bv, nan=USUAL_BV), *VALID_BV)
    across = of_all(lambda part: corner_distance(part.image, part.matches, part.stars.xy_px) ** 2)
    more = [one - np.median(one) for one in (bv, across)][: mass.size // _STARS_PER_TERM]
    image = np.repeat(np.arange(len(parts)), [int(some.sum()) for some in used])
    design = np.column_stack([image[:, np.newaxis] == np.arange(len(parts)), mass, *more])
    noise_mag = of_all(lambda part: 1.0857 * part.stars.noise_dn / part.stars.peak_dn)
    star_id = of_all(lambda part: part.stars.star_id)
    p, error, _ = robust_fit(design, of_all(lambda part: part.off_mag), noise_mag, same=star_id)
    first = len(parts)
    return list(zip(p[:first].tolist(), error[:first].tolist(), strict=True)), float(p[first]), float(error[first])
