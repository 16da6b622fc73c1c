"""What the brightness of stars in a photograph depends on besides their V magnitude.

The camera's band, vignetting and tone; the extinction of the air, fitted or given, and taken out of the reference
brightness; and what each star has besides, as the photograph records it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from glstar.arrays import Float, Mask, robust_std
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.sensor.calibration import Calibration
from glstar.calibrate.sensor.combine import Observations, StarTable, solve_brightness
from glstar.calibrate.sensor.misfit import Measurement
from glstar.calibrate.sensor.misfitmeasurement import corner_distance, measure_misfit
from glstar.camera.sensor.colourband import ColourBand
from glstar.errors import CalibrationError
from glstar.render.motion.pointing import Pointing
from glstar.render.scene.starcomponents import colours_used
from glstar.sky.air.extinction import air_mass
from glstar.sky.photometry import USUAL_BV, VALID_BV, star_colours

# Terms are used if the probability that chance lowers the residuals as much (F test) is below the first for all of them
# together, and below the second for each, with at least this number of stars for each term.
_ALL_BY_CHANCE = 0.01
_ONE_BY_CHANCE = 0.05
_STARS_PER_TERM = 4
# A term needs stars that differ in its quantity by this much.
_LEAST_SPAN = 0.2
_ROUNDS = 30
_HUBER = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class BrightnessTerms:
    """Instrumental magnitudes as zero + V + slope (B - V) + curvature (B - V)^2 + loss r^2."""

    zero_mag: float  # -2.5 log10 of the flux in DN of a star of V 0 and B - V 0 on the axis
    zero_error_mag: float
    colour: Measurement | None  # Slope over B - V; None if it is not significant
    # Of the square of B - V: giants of type M are far brighter to a camera that sees red light; none if it is not
    # significant.
    curvature: Measurement | None
    loss_mag: Measurement | None  # Loss at half the diagonal from the axis; None if it is not significant
    magnitude_slope: Measurement | None  # Slope over V minus 1, of a fit of its own: 0 for a linear sensor
    scatter_mag: float  # Robust standard deviation of the stars about the fit
    stars: int
    residual_mag: Float  # (n,) measured minus fitted, of all stars; NaN where there is no measurement


def fit_brightness_terms(
    flux_dn: Float, error_dn: Float, vmag: Float, bv: Float, distance: Float, used: Mask
) -> BrightnessTerms:
    """Return the terms that the stars support.

    `flux_dn`, `error_dn` (n,): fluxes and standard errors, DN; `vmag`, `bv` (n,): V and B - V; NaN where the colour is
    unknown; `distance` (n,): from the principal point over half the diagonal; `used` (n,) bool: stars to use.
    Weighted least squares with Huber's weights; terms that chance explains (F tests with the weights of the larger
    model: 1 % for all together, 5 % for each) are left out, the least significant first.
    """
    used = used & (flux_dn > 0)
    off = np.full(len(flux_dn), np.nan)
    off[flux_dn > 0] = -2.5 * np.log10(flux_dn[flux_dn > 0]) - vmag[flux_dn > 0]
    colour = np.clip(np.nan_to_num(bv, nan=USUAL_BV), *VALID_BV)
    columns = {"colour": colour, "loss": distance**2, "curvature": colour**2}
    known_dn = np.where(np.isfinite(error_dn), error_dn, np.maximum(flux_dn, 1.0))
    noise_mag = 1.0857 * known_dn / np.maximum(flux_dn, np.maximum(known_dn, 1e-9))
    most = int(used.sum()) // _STARS_PER_TERM - 1
    names = [name for name in columns if np.ptp(columns[name][used]) > _LEAST_SPAN][: max(most, 0)]

    def design(names: list[str]) -> Float:
        return np.column_stack([np.ones_like(off), *(columns[name] for name in names)])[used]

    def fitted(names: list[str], *more: Float) -> tuple[Float, Float, float]:
        return robust_fit(np.column_stack([design(names), *(one[used] for one in more)]), off[used], noise_mag[used])

    while True:
        p, error, scatter = fitted(names)
        left_out = _left_out(names, p, *_by_chance(design(names), off[used], noise_mag[used], p))
        if left_out is None:
            break
        names.remove(left_out)
    terms = {name: Measurement(float(p[k + 1]), float(error[k + 1])) for k, name in enumerate(names)}
    slope = None
    if used.sum() >= _STARS_PER_TERM * (len(names) + 2) and np.ptp(vmag[used]) > _LEAST_SPAN:
        q, q_error, _ = fitted(names, vmag - np.median(vmag[used]))
        slope = Measurement(float(q[-1]), float(q_error[-1]))
    model = p[0] + sum((columns[name] * p[k + 1] for k, name in enumerate(names)), np.zeros_like(off))
    return BrightnessTerms(
        zero_mag=float(p[0]),
        zero_error_mag=float(error[0]),
        colour=terms.get("colour"),
        curvature=terms.get("curvature"),
        loss_mag=terms.get("loss"),
        magnitude_slope=slope,
        scatter_mag=scatter,
        stars=int(used.sum()),
        residual_mag=off - model,
    )


def _left_out(names: list[str], p: Float, all_by_chance: float, by_chance: list[float]) -> str | None:
    """Return the term that the stars support least, given the probabilities of chance; None if they support all."""
    chance = {
        name: 1.0 if name == "loss" and value <= 0 else one
        for name, one, value in zip(names, by_chance, p[1:], strict=True)
        # The square without the slope would be another model.
        if name != "colour" or "curvature" not in names
    }
    weakest = max(chance, key=lambda name: chance[name], default=None)
    if weakest is None or (chance[weakest] < _ONE_BY_CHANCE and all_by_chance < _ALL_BY_CHANCE):
        return None
    return weakest


def _by_chance(design: Float, values: Float, noise: Float, p: Float) -> tuple[float, list[float]]:
    """Return the probabilities that chance explains the columns of a fit but the first: all of them, and each.

    F tests of the fits without them.
    """
    residual = values - design @ p
    root = np.sqrt(_huber_weights(residual, noise, robust_std(residual, float(np.median(residual)))))
    free = max(len(values) - design.shape[1], 1)
    weighted, of_values = design * root[:, np.newaxis], values * root

    def cost(columns: list[int]) -> float:
        solution = np.linalg.lstsq(weighted[:, columns], of_values, rcond=None)[0]
        return float(np.sum((of_values - weighted[:, columns] @ solution) ** 2))

    every = list(range(design.shape[1]))
    whole = max(cost(every), 1e-12)

    def chance(without: list[int]) -> float:
        fewer = max(len(without), 1)
        better = (cost([k for k in every if k not in without]) - whole) / whole
        return float(fdtrc(fewer, free, max(better, 0.0) * free / fewer))

    return chance(every[1:]), [chance([k]) for k in every[1:]]


def _huber_weights(residual: Float, noise: Float, scatter: float) -> Float:
    total = np.hypot(max(scatter, 0.01), noise)
    return np.asarray(np.minimum(1.0, _HUBER * total / np.maximum(np.abs(residual), 1e-9)) / total**2)


def robust_fit(
    design: Float, values: Float, noise: Float, *, same: NDArray[Any] | None = None
) -> tuple[Float, Float, float]:
    """Return the parameters of a weighted least-squares fit with Huber's weights.

    `design` (n, m); `values`, `noise` (n,): magnitudes, and their standard errors besides the scatter; `same` (n,):
    equal for measurements of one star, whose deviations are its own; by default all stars differ.  Returns (m,)
    parameters; (m,) their standard errors; robust standard deviation about the fit.
    """
    scatter = 0.15
    p: Float = np.zeros(design.shape[1])
    weight: Float = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        p = np.asarray(np.linalg.lstsq(design * root[:, np.newaxis], values * root, rcond=None)[0], dtype=np.float64)
        residual = values - design @ p
        scatter = robust_std(residual, float(np.median(residual)))
        weight = _huber_weights(residual, noise, scatter)
    inverse = np.linalg.pinv((design * weight[:, np.newaxis]).T @ design)
    score = design * (weight * residual)[:, np.newaxis]
    if same is not None:
        _, group = np.unique(same, return_inverse=True)
        score = np.stack([np.bincount(group, weights=column) for column in score.T], axis=-1)
    meat = score.T @ score
    free = max(len(values) - design.shape[1], 1)
    covariance = inverse @ meat @ inverse * len(values) / free
    return p, np.sqrt(np.diag(covariance)), float(scatter)


# A fit needs stars whose air masses differ by this much, between the 5th and the 95th percentile, and this many stars.
_LEAST_AIR_SPAN = 0.5
_LEAST_AIR_STARS = 20
# Notes on effects that the air may cause: it dims one side of the image more than the other.
_LIKE_AIR = frozenset({NoteKind.VIGNETTING, NoteKind.BRIGHT_CORNERS})
# Extinctions per air mass that an atmosphere can have, mag, and the ratio of one to its error that is no chance.
_LEAST_EXTINCTION_MAG, _LARGEST_EXTINCTION_MAG, _SIGNIFICANT = 0.05, 1.5, 4.0
# A term besides the extinction needs this many stars.
_STARS_PER_AIR_TERM = 10


@dataclass(frozen=True, slots=True)
class AirTerm:
    """The extinction that was taken out of a calibration."""

    zenith_mag: float  # Extinction per air mass, mag
    error_mag: float | None  # Its standard error; None if it was given
    lowest_mass: float  # Air masses of the stars used
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
    def note(self) -> Note:
        """The extinction that was taken out, for the user."""
        masses = f"air masses {self.lowest_mass:.2f} to {self.highest_mass:.2f}"
        how = "as given" if self.error_mag is None else f"± {self.error_mag:.3f}, fitted"
        return Note(
            NoteKind.SENSOR,
            f"reference_peak_dn is above the air: {self.zenith_mag:.3f} mag per air mass ({how}; {self.stars} stars,"
            f' {masses}) are taken out; simulate with [sky] extinction = "standard"',
        )


def above_air(calibration: Calibration, zenith_mag: float | None = None) -> Calibration:
    """Return a calibration whose reference brightness is that above the air.

    The parameters and errors are those of `above_air_together`.
    """
    return above_air_together((calibration,), zenith_mag)[0]


def above_air_together(parts: Sequence[Calibration], zenith_mag: float | None = None) -> tuple[Calibration, ...]:
    """Return calibrations of photographs of one night, whose reference brightness is that above the air.

    `parts`: of images whose site, time and attitude are known; `zenith_mag`: extinction per air mass, mag; by default
    one value is fitted to the stars of all images.  Raises CalibrationError if
    a zenith is unknown, or the stars do not show the extinction.  Magnitudes measured minus fitted are a + k X + b (B
    - V) + c r^2, with X the air mass; b and c, which are centred on the stars, keep band and vignetting out of k.
    Each image has an a of its own, for haze, and exposures that are not quite those given.
    """
    masses = [_air_masses(part) for part in parts]
    used = [part.brightness.used & (part.stars.peak_dn > 0) for part in parts]
    if zenith_mag is None:
        offsets, k, k_error = _fitted_air(parts, masses, used)
    else:
        offsets = [
            _air_offset(part, zenith_mag * mass, is_used)
            for part, mass, is_used in zip(parts, masses, used, strict=True)
        ]
        k, k_error = zenith_mag, None
    seen = np.concatenate([mass[is_used] for mass, is_used in zip(masses, used, strict=True)])
    air = AirTerm(k, k_error, float(seen.min()), float(seen.max()), seen.size)
    return tuple(
        _taken_out(part, k * mass, is_used, *offset, air)
        for part, mass, is_used, offset in zip(parts, masses, used, offsets, strict=True)
    )


def with_air_noted(calibration: Calibration) -> Calibration:
    """Return a calibration whose notes name the extinction of the air, if it explains what stars lose in the corners.

    The altitudes of the stars must be known; else, or if the stars do not show the extinction, the notes stay as they
    are.  The reference brightness stays that below the air.
    """
    before = calibration.misfit.notes(calibration.sensor, linear=calibration.brightness.linear)
    if calibration.reference.C_ned_eq is None or not any(note.kind in _LIKE_AIR for note in before):
        return calibration
    try:
        free = above_air(calibration)
    except CalibrationError:
        return calibration
    term = free.air or {}
    k, error, (lowest, highest) = (term[key] for key in ("zenith_extinction_mag", "standard_error_mag", "air_mass"))
    if not _LEAST_EXTINCTION_MAG < k < _LARGEST_EXTINCTION_MAG or k < _SIGNIFICANT * error:
        return calibration
    after = free.misfit.notes(free.sensor, linear=free.brightness.linear)
    remains = [note for note in after if note.kind in _LIKE_AIR]
    besides = "" if remains else ": the corners are as bright as the centre without it"
    air = Note(
        NoteKind.VIGNETTING,
        f"the air dims the stars by {k:.3f} ± {error:.3f} mag per air mass ({term['stars']} stars, air masses"
        f" {lowest:.2f} to {highest:.2f}){besides}. reference_peak_dn is that below it; --extinction fit takes it out",
    )
    kept = [note for note in calibration.notes if note not in before or note.kind not in _LIKE_AIR]
    return replace(calibration, notes=(air, *kept, *remains))


def _air_offset(part: Calibration, lost_mag: Float, used: NDArray[np.bool_]) -> tuple[float, float]:
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
    residual_mag = (calibration.off_mag - offset_mag - lost_mag)[used]
    fit = replace(
        calibration.brightness,
        reference_peak_dn=calibration.brightness.reference_peak_dn * float(10 ** (-0.4 * offset_mag)),
        scatter_mag=robust_std(residual_mag, float(np.median(residual_mag))),
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


def _fitted_air(
    parts: Sequence[Calibration], masses: Sequence[Float], used: Sequence[NDArray[np.bool_]]
) -> tuple[list[tuple[float, float]], float, float]:
    """Return the offset of each image above the air with its error, and the extinction per air mass with its, mag."""
    mass = np.concatenate([one[is_used] for one, is_used in zip(masses, used, strict=True)])
    spans = [np.percentile(one[is_used], [5, 95]) for one, is_used in zip(masses, used, strict=True) if is_used.any()]
    if mass.size < _LEAST_AIR_STARS or max(high - low for low, high in spans) < _LEAST_AIR_SPAN:
        low, high = max(spans, key=lambda span: span[1] - span[0]) if spans else (np.nan, np.nan)
        where = "the image has" if len(parts) == 1 else "the images have, at best on one of them,"
        raise CalibrationError(
            f"the extinction needs {_LEAST_AIR_STARS} stars whose air masses differ by {_LEAST_AIR_SPAN:g}, and {where}"
            f" {mass.size} of {low:.2f} to {high:.2f}: take a wider image down to low altitudes, or give the"
            " extinction per air mass, as --extinction 0.28",
            stars_used=mass.size,
            stars_needed=_LEAST_AIR_STARS,
        )

    def of_all(values: Callable[[Calibration], NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([values(part)[is_used] for part, is_used in zip(parts, used, strict=True)])

    bv = of_all(lambda part: star_colours(part.reference.stars, part.matches.star))
    bv = np.clip(np.nan_to_num(bv, nan=USUAL_BV), *VALID_BV)
    across = of_all(lambda part: corner_distance(part.image, part.matches, part.stars.xy_px) ** 2)
    more = [one - np.median(one) for one in (bv, across)][: mass.size // _STARS_PER_AIR_TERM]
    image = np.repeat(np.arange(len(parts)), [int(is_used.sum()) for is_used in used])
    design = np.column_stack([image[:, np.newaxis] == np.arange(len(parts)), mass, *more])
    noise_mag = of_all(lambda part: 1.0857 * part.stars.noise_dn / part.stars.peak_dn)
    star_id = of_all(lambda part: part.stars.star_id)
    p, error, _ = robust_fit(design, of_all(lambda part: part.off_mag), noise_mag, same=star_id)
    first = len(parts)
    return list(zip(p[:first].tolist(), error[:first].tolist(), strict=True)), float(p[first]), float(error[first])


# Stars below this signal-to-noise ratio say nothing that the catalogue does not say better.
_LEAST_SNR = 3.0
# Standard error of a flux besides its noise, mag: the profile is not exactly that of every star.
_LEAST_ERROR_MAG = 0.02


def recorded_brightness(
    calibration: Calibration, terms: BrightnessTerms, colour: ColourBand, flux_dn: Float, error_dn: Float
) -> StarTable:
    """Return the magnitudes of the matched stars in the camera's band.

    `terms`: what their brightness depends on; `colour`: the camera's band; `flux_dn`, `error_dn` (n,): of the matched
    stars, with standard errors, DN.  Saturated and blended stars are left out.  A star differs from the catalogue
    because it varies, because several stars or a nebula add light, or because of air and cloud before it.
    The deviations are shrunk towards their median, as with several photographs: a star whose noise is as large
    as the spread of all stars keeps half of its deviation.
    """
    stars, reference = calibration.stars, calibration.reference.stars
    measured = np.isfinite(terms.residual_mag) & (flux_dn > _LEAST_SNR * error_dn)
    chosen = np.flatnonzero(measured & ~stars.saturated & ~stars.blended)
    noise_mag = 2.5 / np.log(10) * error_dn[chosen] / flux_dn[chosen]
    order = np.arange(len(chosen))
    seen = Observations(np.zeros_like(order), order, terms.residual_mag[chosen], np.hypot(noise_mag, _LEAST_ERROR_MAG))
    off_mag, error_mag, zero_mag, _ = solve_brightness(seen, len(chosen), 1)
    matched = calibration.matches.star[chosen]
    of_band = colour.magnitude_minus_v(colours_used(reference, matched))
    names = tuple(reference.name[k] for k in matched.tolist())
    return StarTable(
        catalogue=reference.catalogue,
        star_id=reference.star_id[matched],
        name=names,
        vmag=stars.vmag[chosen],
        off_mag=of_band + zero_mag[0] + off_mag,
        error_mag=error_mag,
        images=np.ones_like(order),
    )
