"""What the brightness of stars depends on besides their V magnitude: the camera's band, vignetting and tone."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from glstar.calibrate.misfit import Measurement
from glstar.statistics import robust_std

__all__ = ["BrightnessTerms", "fit_brightness_terms", "robust_fit"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A term is used if the probability of an estimate as large by chance is below this (Student's t), with at least
# this number of stars for each term.
_BY_CHANCE: Final = 0.01
_STARS_PER_TERM: Final = 4
# Colours beyond which the band's polynomial is constant.
_VALID_BV: Final = (-0.3, 1.7)
# A term needs stars that differ in its quantity by this much.
_LEAST_SPAN: Final = 0.2
_ROUNDS: Final = 30
_HUBER: Final = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class BrightnessTerms:
    """Instrumental magnitudes as zero + V + slope (B - V) + loss r^2.

    Attributes
    ----------
    zero_mag : float
        -2.5 log10 of the flux in DN of a star of V 0 and B - V 0 on the axis.
    zero_error_mag : float
    colour : Measurement or None
        Slope over B - V; None if it is not significant.
    loss_mag : Measurement or None
        Loss at half the diagonal from the axis; None if it is not significant.
    magnitude_slope : Measurement or None
        Slope over V minus 1, of a fit of its own: 0 for a linear sensor.
    scatter_mag : float
        Robust standard deviation of the stars about the fit.
    stars : int
    residual_mag : (n,) float64
        Measured minus fitted, of all stars; NaN where there is no measurement.
    """

    zero_mag: float
    zero_error_mag: float
    colour: Measurement | None
    loss_mag: Measurement | None
    magnitude_slope: Measurement | None
    scatter_mag: float
    stars: int
    residual_mag: Float


def fit_brightness_terms(
    flux_dn: Float, error_dn: Float, vmag: Float, bv: Float, distance: Float, used: Mask
) -> BrightnessTerms:
    """Return the terms that the stars support.

    Parameters
    ----------
    flux_dn, error_dn : (n,) float64
        Fluxes and standard errors, DN.
    vmag, bv : (n,) float64
        V and B - V; NaN where the colour is unknown.
    distance : (n,) float64
        From the principal point over half the diagonal.
    used : (n,) bool
        Stars to use.

    Returns
    -------
    BrightnessTerms

    Notes
    -----
    Weighted least squares with Huber's weights; a term that chance explains (Student's t, 1 %) is left out.
    """
    used = used & (flux_dn > 0)
    off = np.full(len(flux_dn), np.nan)
    off[flux_dn > 0] = -2.5 * np.log10(flux_dn[flux_dn > 0]) - vmag[flux_dn > 0]
    colour = np.clip(np.nan_to_num(bv, nan=0.65), *_VALID_BV)
    columns = {"colour": colour, "loss": distance**2}
    known_dn = np.where(np.isfinite(error_dn), error_dn, np.maximum(flux_dn, 1.0))
    noise_mag = 1.0857 * known_dn / np.maximum(flux_dn, np.maximum(known_dn, 1e-9))
    most = int(used.sum()) // _STARS_PER_TERM - 1
    names = [name for name in columns if np.ptp(columns[name][used]) > _LEAST_SPAN][: max(most, 0)]

    def fitted(names: list[str], *more: Float) -> tuple[Float, Float, float]:
        design = np.column_stack([np.ones_like(off), *(columns[name] for name in names), *more])
        return robust_fit(design[used], off[used], noise_mag[used])

    while True:
        p, error, scatter = fitted(names)
        limit = float(stats.t.ppf(1 - _BY_CHANCE / 2, max(int(used.sum()) - len(p), 1)))
        weak = [k for k in range(len(names)) if abs(p[k + 1]) < limit * error[k + 1]]
        weak += [k for k in range(len(names)) if names[k] == "loss" and p[k + 1] <= 0]
        if not weak:
            break
        names.pop(max(weak, key=lambda k: error[k + 1] / max(abs(p[k + 1]), 1e-9)))
    terms = {name: Measurement(float(p[k + 1]), float(error[k + 1])) for k, name in enumerate(names)}
    slope = None
    if used.sum() >= _STARS_PER_TERM * (len(names) + 2) and np.ptp(vmag[used]) > _LEAST_SPAN:
        q, q_error, _ = fitted(names, vmag - np.median(vmag[used]))
        slope = Measurement(float(q[-1]), float(q_error[-1]))
    model = p[0] + sum((columns[name] * p[k + 1] for k, name in enumerate(names)), np.zeros_like(off))
    return BrightnessTerms(
        float(p[0]), float(error[0]), terms.get("colour"), terms.get("loss"), slope, scatter, int(used.sum()),
        off - model,
    )  # fmt: skip


def robust_fit(
    design: Float, values: Float, noise: Float, *, same: NDArray[Any] | None = None
) -> tuple[Float, Float, float]:
    """Return the parameters of a weighted least-squares fit with Huber's weights.

    Parameters
    ----------
    design : (n, m) float64
    values, noise : (n,) float64
        Magnitudes, and their standard errors besides the scatter.
    same : (n,) array, optional
        Equal for measurements of one star, whose deviations are its own; by default all stars differ.

    Returns
    -------
    (m,) float64
        Parameters.
    (m,) float64
        Their standard errors.
    float
        Robust standard deviation about the fit.
    """
    scatter = 0.15
    p: Float = np.zeros(design.shape[1])
    weight: Float = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        p = np.asarray(np.linalg.lstsq(design * root[:, np.newaxis], values * root, rcond=None)[0], dtype=np.float64)
        left = values - design @ p
        scatter = robust_std(left, float(np.median(left)))
        total = np.hypot(max(scatter, 0.01), noise)
        weight = np.minimum(1.0, _HUBER * total / np.maximum(np.abs(left), 1e-9)) / total**2
    inverse = np.linalg.pinv((design * weight[:, np.newaxis]).T @ design)
    score = design * (weight * left)[:, np.newaxis]
    if same is not None:
        _, group = np.unique(same, return_inverse=True)
        score = np.stack([np.bincount(group, weights=column) for column in score.T], axis=-1)
    meat = score.T @ score
    free = max(len(values) - design.shape[1], 1)
    covariance = inverse @ meat @ inverse * len(values) / free
    return p, np.sqrt(np.diag(covariance)), float(scatter)
