"""What the brightness of stars depends on besides their V magnitude: the camera's band, vignetting and tone."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from glstar.calibrate.misfit import Measurement
from glstar.sky.starcolours import USUAL_BV, VALID_BV
from glstar.statistics import robust_std

__all__ = ["BrightnessTerms", "fit_brightness_terms", "robust_fit"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Terms are used if the probability that chance lowers the residuals as much (F test) is below the first for all of them
# together, and below the second for each, with at least this number of stars for each term.
_ALL_BY_CHANCE: Final = 0.01
_ONE_BY_CHANCE: Final = 0.05
_STARS_PER_TERM: Final = 4
# A term needs stars that differ in its quantity by this much.
_LEAST_SPAN: Final = 0.2
_ROUNDS: Final = 30
_HUBER: Final = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class BrightnessTerms:
    """Instrumental magnitudes as zero + V + slope (B - V) + curvature (B - V)^2 + loss r^2.

    Attributes
    ----------
    zero_mag : float
        -2.5 log10 of the flux in DN of a star of V 0 and B - V 0 on the axis.
    zero_error_mag : float
    colour : Measurement or None
        Slope over B - V; None if it is not significant.
    curvature : Measurement or None
        Of the square of B - V: giants of type M are far brighter to a camera that sees red light.  None if it is not
        significant.
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
    curvature: Measurement | None
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
        float(p[0]), float(error[0]), terms.get("colour"), terms.get("curvature"), terms.get("loss"), slope, scatter,
        int(used.sum()),
        off - model,
    )  # fmt: skip


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
    left = values - design @ p
    root = np.sqrt(_huber_weights(left, noise, robust_std(left, float(np.median(left)))))
    free = max(len(values) - design.shape[1], 1)
    weighted, of_values = design * root[:, np.newaxis], values * root

    def cost(columns: list[int]) -> float:
        found = np.linalg.lstsq(weighted[:, columns], of_values, rcond=None)[0]
        return float(np.sum((of_values - weighted[:, columns] @ found) ** 2))

    every = list(range(design.shape[1]))
    whole = max(cost(every), 1e-12)

    def chance(without: list[int]) -> float:
        fewer = max(len(without), 1)
        better = (cost([k for k in every if k not in without]) - whole) / whole
        return float(stats.f.sf(better * free / fewer, fewer, free))

    return chance(every[1:]), [chance([k]) for k in every[1:]]


def _huber_weights(left: Float, noise: Float, scatter: float) -> Float:
    total = np.hypot(max(scatter, 0.01), noise)
    return np.asarray(np.minimum(1.0, _HUBER * total / np.maximum(np.abs(left), 1e-9)) / total**2)


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
        weight = _huber_weights(left, noise, scatter)
    inverse = np.linalg.pinv((design * weight[:, np.newaxis]).T @ design)
    score = design * (weight * left)[:, np.newaxis]
    if same is not None:
        _, group = np.unique(same, return_inverse=True)
        score = np.stack([np.bincount(group, weights=column) for column in score.T], axis=-1)
    meat = score.T @ score
    free = max(len(values) - design.shape[1], 1)
    covariance = inverse @ meat @ inverse * len(values) / free
    return p, np.sqrt(np.diag(covariance)), float(scatter)
