"""One point spread function fitted to many stars of a photograph together, saturated ones with their wings."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from scipy.special import erf

from glstar.arrays import Float, Index, Mask
from glstar.camera.sensor.pointspread import PointSpread


@dataclass(frozen=True, slots=True, eq=False)
class StarStamps:
    """Pixels around stars."""

    corner_px: Float  # (n, 2) first column and row of each stamp
    values_dn: Float  # (n, m, m) above the sky
    # (n, m, m) of the sky and the sensor, without the star's own light; infinite for pixels that do not count.
    variance_dn2: Float
    xy_px: Float  # (n, 2) positions of the stars
    trail_px: Float  # (n, 2) motion during the exposure
    offset: Float  # (n, 2) position (x, y) minus the principal point, over half the diagonal
    bv: Float  # (n,) colours B - V
    # Gain: the variance of a star's light over its level, DN. It acts on the fitted light: the recorded one would give
    # pixels that are too dark by chance more weight, and make stars narrower and fainter than they are.
    dn_per_e: float = 0.0

    def __len__(self) -> int:
        return len(self.xy_px)

    def some(self, k: Index | Mask) -> "StarStamps":
        """Return the stamps of some stars."""
        return StarStamps(
            corner_px=self.corner_px[k],
            values_dn=self.values_dn[k],
            variance_dn2=self.variance_dn2[k],
            xy_px=self.xy_px[k],
            trail_px=self.trail_px[k],
            offset=self.offset[k],
            bv=self.bv[k],
            dn_per_e=self.dn_per_e,
        )

    def profiles(self, psf: PointSpread, sigma_px: float) -> Float:
        """Return the image of each star for a flux of 1, (n, m, m)."""
        samples, weights = _trail_samples(self.trail_px, sigma_px)
        along = np.arange(self.values_dn.shape[1], dtype=np.float64)
        near = self.xy_px - self.corner_px
        scale = psf.scale_at(self.offset, self.bv)
        light = np.zeros_like(self.values_dn)
        # The core's Gaussians scale with the growth; those of the outer parts do not.
        ones, twos = psf.components(sigma_px, scale=1.0), psf.components(sigma_px, scale=2.0)
        for one, two in zip(ones, twos, strict=True):
            grows = two.sigma_px / one.sigma_px - 1
            width = (one.sigma_px * (1 + grows * (scale - 1)))[:, np.newaxis, np.newaxis]
            axes = []
            for axis in (0, 1):
                offset = one.offset_px[axis] * (1 + grows * (scale - 1))
                centre = (near[:, axis] + offset)[:, np.newaxis] + samples * self.trail_px[:, axis, np.newaxis]
                axes.append(_pixels(along - centre[..., np.newaxis], width))
            across, down = axes
            light += one.flux_fraction * np.einsum("t,nty,ntx->nyx", weights, down, across, optimize=True)
        return light


def cut_stamps(
    *,
    above_dn: Float,
    variance_dn2: Float,
    usable: Mask,
    xy_px: Float,
    others_px: Float,
    trail_px: Float,
    offset: Float,
    bv: Float,
    half_px: int,
    dn_per_e: float = 0.0,
) -> tuple[StarStamps, Index]:
    """Return the stamps of stars that lie wholly on the image, and which stars these are.

    `above_dn`, `variance_dn2` (height, width): the image above its sky, DN, and the variance of its pixels without the
    light of stars, DN^2; `usable` (height, width) bool: pixels that are not saturated; `xy_px` (n, 2): positions, px;
    `others_px` (k, 2): positions of all stars: pixels that are nearer to another star do not count; `trail_px` (n, 2);
    `offset` (n, 2): from the principal point, over half the diagonal; `bv` (n,): colours B - V; `half_px`: half the
    side of a stamp; `dn_per_e`: variance of the light of stars over its level, DN.  Returns (k,) intp.
    """
    height, width = above_dn.shape
    corner = np.rint(xy_px).astype(np.intp) - half_px
    inside = np.flatnonzero(((corner >= 0) & (corner < np.array([width, height]) - 2 * half_px)).all(axis=1))
    along = np.arange(2 * half_px + 1)
    columns, rows = corner[inside, :1] + along, corner[inside, 1:] + along
    place = rows[:, :, np.newaxis], columns[:, np.newaxis, :]
    counts = usable[place]
    tree = KDTree(others_px)
    for k, star in enumerate(inside):
        for other in others_px[tree.query_ball_point(xy_px[star], 2.9 * half_px)]:
            if float(np.hypot(*(other - xy_px[star]))) >= 1.0:
                # What lies closer to the other star than that may have its light.
                r2, other_r2 = (_squares(columns[k], rows[k], one) for one in (xy_px[star], other))
                counts[k] &= other_r2 > np.minimum(r2, (0.6 * half_px) ** 2)
    variance = np.where(counts, variance_dn2[place], np.inf)
    stamps = StarStamps(
        corner_px=corner[inside].astype(np.float64),
        values_dn=above_dn[place],
        variance_dn2=variance,
        xy_px=xy_px[inside],
        trail_px=trail_px[inside],
        offset=offset[inside],
        bv=bv[inside],
        dn_per_e=dn_per_e,
    )
    return stamps, inside


def _squares(columns: Index, rows: Index, xy_px: Float) -> Float:
    """Return the squared distances of the pixels of a rectangle from a position, px^2."""
    return np.asarray((columns - xy_px[0]) ** 2 + ((rows - xy_px[1]) ** 2)[:, np.newaxis])


def _pixels(offset_px: Float, sigma_px: Float) -> Float:
    """Return one axis of a Gaussian of flux 1, integrated over pixels in a row: neighbours share an edge."""
    edges_px = np.concatenate([offset_px - 0.5, offset_px[..., -1:] + 0.5], axis=-1)
    return np.asarray(0.5 * np.diff(erf(edges_px / (np.sqrt(2) * sigma_px))))


def _trail_samples(trail_px: Float, sigma_px: float) -> tuple[Float, Float]:
    """Return Gauss-Legendre nodes along trails, -1/2 to 1/2, and their weights."""
    longest_px = float(np.linalg.norm(trail_px, axis=1).max(initial=0.0))
    count = 1 if longest_px < 1e-3 else 2 + int(np.ceil(longest_px / max(sigma_px, 0.3)))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes / 2, weights / 2


# A model is wrong by about this fraction of a star's brightness: it limits the weight of bright pixels.
_MODEL_ERROR = 0.03
# Gauss-Newton rounds for the positions in each round of the shape, and rounds of the shape.
_POSITION_ROUNDS = 3
_ROUNDS = 3
# Step of numerical derivatives by position, px, and the largest step of a position, px.
_STEP_PX = 0.02
_LARGEST_STEP_PX = 0.4
# A further parameter must lower the squared residuals, over their mean, by this much.
_BETTER = 12.0
# ... and must exceed its standard error by this factor, away from the ends of its range.
_CLEAR = 3.0
_AT_END = 2e-3
# Bright and faint stars are fitted separately if each half has this number of stars for each parameter.
_STARS_PER_PARAMETER = 2
# Light this far off the first fit does not count in the last one, standard deviations.
_OUTLIER = 4.0
# Moffat exponent from which on a star is a Gaussian, and range of the fit.
_GAUSSIAN_BETA = 15.0
_BETA = (2.05, 19.0)
_MOST_ELLIPTICAL = 0.39
_LARGEST_GROWTH = 3.0
# As large as `psf_tilt` may be: a smaller range would leave out tilts that the stars determine.
_LARGEST_TILT = 0.9
_LARGEST_COLOUR_GROWTH = 0.5
_LARGEST_WING = 0.8
# Parameters that are tried together, and where they start: first the better of two profiles, then the others in turn.
_PROFILES: tuple[tuple[str, ...], ...] = (("beta",), ("wing", "ln_wing_px"))
_GROUPS = (*_PROFILES, ("growth",), ("tilt_x", "tilt_y"), ("colour",), ("e1", "e2"))
_STARTS = {"beta": 4.0, "wing": 0.1, "ln_wing_px": 1.1}


@dataclass(frozen=True, slots=True, eq=False)
class JointPsf:
    """A point spread function with the standard errors of its parameters."""

    psf: PointSpread
    sigma_px: float  # ``psf_sigma_px``
    standard_error: dict[str, float]  # By key of ``[sensor]``
    stars: int  # Number of stars it was fitted to
    misfit: float  # Root mean square of the residuals over their expected noise
    refused: tuple[str, ...] = ()  # Parameters that lower the residuals, and that the stars do not determine


def fit_joint_psf(stamps: StarStamps, start_sigma_px: float) -> tuple[JointPsf, StarStamps]:
    """Return the point spread function of stars, and their stamps with fitted positions.

    `stamps`: of isolated stars, most of them not saturated; `start_sigma_px`: approximate width, px.  Returns a
    Gaussian; with a Moffat exponent, wings, growth, tilt, colour and ellipticity each only where they lower the
    residuals clearly and exceed their standard errors.  Weighted least squares on all pixels of all stars with the
    renderer's own sums of Gaussians, integrated over pixels and along the sidereal trails.  Flux and sky of each star
    are solved for each shape (variable projection, Golub & Pereyra 1973), positions in turns with the shape.
    """
    names: tuple[str, ...] = ("sigma",)
    fitted, stamps, cost = _fitted(stamps, names, _Shape(start_sigma_px))
    untried, refused, deferred = list(_GROUPS), [], False
    while untried:
        # Of the shapes with a further group of parameters, the one that explains most.
        trials = []
        for group in untried[: 2 if untried[: len(_PROFILES)] == list(_PROFILES) else 1]:
            start = fitted.started(group)
            trials.append((*_fitted(stamps, (*names, *group), start), group))
        trial, moved, trial_cost, group = min(trials, key=lambda one: one[2] / (1 - 1e-3 * len(one[3])))
        untried.remove(group)
        unit = trial_cost / max(_free_pixels(stamps) - 5 * len(stamps), 1)
        # Pixels of one star share its own peculiarities: they are fewer than they seem.
        if cost - trial_cost <= _BETTER * unit * len(group):
            continue
        unclear = _unclear(moved, (*names, *group), trial, _covariance(moved, (*names, *group), trial))
        if group in unclear and group in _PROFILES and len(names) == 1 and not deferred:
            # Widths that differ over the image look like wings of the mean star: they are fitted first.
            deferred, untried = True, [*(one for one in untried if one not in _PROFILES), *_PROFILES]
        elif group in unclear:
            refused.append(unclear[group])
        else:
            names, fitted, stamps, cost = (*names, *group), trial, moved, trial_cost
    # Stars below the limit of detection are outliers of the pixels around the others.
    stamps = _without_outliers(stamps, fitted)
    while True:
        fitted, stamps, cost = _fitted(stamps, names, fitted)
        covariance = _covariance(stamps, names, fitted) + _between_halves(stamps, names, fitted)
        unclear = _unclear(stamps, names, fitted, covariance)
        if not unclear:
            break
        # The group that was added last depends on the others.
        group = max(unclear, key=lambda one: names.index(one[0]))
        refused.append(unclear[group])
        names, fitted = tuple(name for name in names if name not in group), fitted.without(group)
    fitted = _without_position_bias(stamps, names, fitted)
    errors = _errors(names, fitted, covariance)
    misfit = float(np.sqrt(cost / max(_free_pixels(stamps) - 4 * len(stamps), 1)))
    return JointPsf(fitted.psf, fitted.sigma_px, errors, len(stamps), misfit, tuple(refused)), stamps


def measure_fluxes(stamps: StarStamps, joint: JointPsf) -> tuple[Float, Float, StarStamps]:
    """Return fluxes with a known point spread function (n,), their standard errors (n,), and moved stamps."""
    shape = _Shape(joint.sigma_px, fixed=joint.psf)
    flux = _faint_fluxes(stamps, shape)
    for _ in range(3):
        weight = _weights(stamps, shape, flux)
        stamps = _moved(stamps, shape, weight)
        flux = _residuals(stamps, shape, weight)[1]
    profile = stamps.profiles(shape.psf, shape.sigma_px)
    information = np.sum(weight * profile**2, axis=(1, 2)) - np.sum(weight * profile, axis=(1, 2)) ** 2 / np.maximum(
        weight.sum(axis=(1, 2)), 1e-12
    )
    return flux, 1 / np.sqrt(np.maximum(information, 1e-12)), stamps


@dataclass(frozen=True, slots=True)
class _Shape:
    """Parameters of a shape; `fixed` is a finished one."""

    sigma_px: float
    beta: float = 20.0
    growth: float = 0.0
    e1: float = 0.0
    e2: float = 0.0
    wing: float = 0.0
    ln_wing_px: float = 1.4
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    colour: float = 0.0
    fixed: PointSpread | None = None

    @property
    def psf(self) -> PointSpread:
        if self.fixed is not None:
            return self.fixed
        ellipticity = min(float(np.hypot(self.e1, self.e2)), _MOST_ELLIPTICAL)
        tilt = min(float(np.hypot(self.tilt_x, self.tilt_y)), _LARGEST_TILT)
        return PointSpread(
            psf="moffat" if self.beta < _GAUSSIAN_BETA else "gaussian",
            psf_beta=float(np.clip(self.beta, *_BETA)) if self.beta < _GAUSSIAN_BETA else 3.0,
            psf_wing_fraction=float(np.clip(self.wing, 0, _LARGEST_WING)),
            psf_wing_sigma_px=float(np.exp(self.ln_wing_px)) if self.wing > 0 else 4.0,
            psf_growth=float(np.clip(self.growth, 0, _LARGEST_GROWTH)),
            psf_ellipticity=ellipticity if ellipticity > 1e-4 else 0.0,
            psf_angle_rad=float(np.arctan2(self.e2, self.e1) / 2) if ellipticity > 1e-4 else 0.0,
            psf_tilt=tilt,
            psf_tilt_angle_rad=float(np.arctan2(self.tilt_y, self.tilt_x)) if tilt > 0 else 0.0,
            psf_colour_growth=float(np.clip(self.colour, -_LARGEST_COLOUR_GROWTH, _LARGEST_COLOUR_GROWTH)),
        )

    def started(self, group: tuple[str, ...]) -> "_Shape":
        """Return the shape with the starting values of a group of parameters."""
        given: dict[str, Any] = {name: _STARTS[name] for name in group if name in _STARTS}
        return replace(self, **given)

    def without(self, group: tuple[str, ...]) -> "_Shape":
        """Return the shape without a group of parameters."""
        plain = _Shape(self.sigma_px)
        return replace(self, **{name: getattr(plain, name) for name in group})

    def vector(self, names: tuple[str, ...]) -> Float:
        values = {"sigma": np.log(self.sigma_px), "beta": 1 / self.beta}
        return np.array([values.get(name, getattr(self, name, 0.0)) for name in names], dtype=np.float64)

    def at(self, names: tuple[str, ...], vector: Float) -> "_Shape":
        given = dict(zip(names, vector.tolist(), strict=True))
        sigma_px = float(np.exp(given.pop("sigma")))
        if "beta" in given:
            given["beta"] = 1 / given["beta"]
        return replace(self, sigma_px=sigma_px, **given)


_LIMITS = {
    "sigma": (np.log(0.2), np.log(12.0)),
    "beta": (1 / (_GAUSSIAN_BETA - 0.1), 1 / _BETA[0]),
    "growth": (0.0, _LARGEST_GROWTH),
    "tilt_x": (-_LARGEST_TILT, _LARGEST_TILT),
    "tilt_y": (-_LARGEST_TILT, _LARGEST_TILT),
    "colour": (-_LARGEST_COLOUR_GROWTH, _LARGEST_COLOUR_GROWTH),
    "e1": (-0.27, 0.27),
    "e2": (-0.27, 0.27),
    "wing": (0.0, _LARGEST_WING),
    "ln_wing_px": (np.log(0.8), np.log(12.0)),
}


def _limits(stamps: StarStamps, names: tuple[str, ...]) -> tuple[Float, Float]:
    """Return the smallest and largest value of each parameter; wider wings than half a stamp's half are sky."""
    low, high = np.transpose([_LIMITS[name] for name in names])
    widest_px = max(stamps.values_dn.shape[1] / 4, 1.0)
    return low, np.where(np.array(names) == "ln_wing_px", np.minimum(high, np.log(widest_px)), high)


def _flat_residuals(stamps: StarStamps, names: tuple[str, ...], shape: _Shape, weight: Float, vector: Float) -> Float:
    """Return the weighted residuals of all pixels for a vector of parameters, (pixels,)."""
    return _residuals(stamps, shape.at(names, vector), weight)[0].reshape(-1)


def _fitted(stamps: StarStamps, names: tuple[str, ...], start: _Shape) -> tuple[_Shape, StarStamps, float]:
    """Return the best shape, the stamps with the best positions, and the weighted sum of squares."""
    low, high = _limits(stamps, names)
    shape = start
    weight = _weights(stamps, shape, _faint_fluxes(stamps, shape))
    for _ in range(_ROUNDS):
        stamps = _moved(stamps, shape, weight)
        begin = np.clip(shape.vector(names), low + 1e-6, high - 1e-6)
        residuals = partial(_flat_residuals, stamps, names, shape, weight)
        minimum = least_squares(residuals, begin, bounds=(low, high), diff_step=1e-3, xtol=1e-5, ftol=1e-6, max_nfev=12)
        shape = shape.at(names, minimum.x)
        weight = _weights(stamps, shape, _residuals(stamps, shape, weight)[1])
    residual, _ = _residuals(stamps, shape, weight)
    return shape, stamps, float(np.sum(residual**2))


def _unclear(
    stamps: StarStamps, names: tuple[str, ...], shape: _Shape, covariance: Float
) -> dict[tuple[str, ...], str]:
    """Return the groups of parameters that the stars do not determine, each with the reason for the user.

    `covariance` (k, k): of the parameters.  A group is determined if its size exceeds its standard error clearly, and
    no parameter is at an end of its range, where the range and not the stars decides.
    """
    low, high = _limits(stamps, names)
    vector, errors = shape.vector(names), _errors(names, shape, covariance)
    unclear: dict[tuple[str, ...], str] = {}
    at_end = np.minimum(vector - low, high - vector) < _AT_END * (high - low)
    at_end |= np.char.startswith(names, "tilt") & (shape.psf.psf_tilt > (1 - _AT_END) * _LARGEST_TILT)
    for group in filter(lambda one: one[0] in names, _GROUPS):
        key, size = _SIZES[group]
        value, error, null = size(shape), errors[key], "0"
        stated = f"{key} {value:.2g} ± {error:.2g}"
        if key == "psf_beta":  # The inverse is fitted
            value, error, null = 1 / value - 1 / _GAUSSIAN_BETA, error / value**2, "a Gaussian"
        if value <= _CLEAR * error:
            unclear[group] = f"{stated} is not clear of {null}"
        elif any(at_end[names.index(name)] for name in group):
            unclear[group] = f"{stated} ends at a limit of its fit, which the stars do not reach"
    return unclear


# The size of each group of parameters, and the key of its standard error.
_SIZES: dict[tuple[str, ...], tuple[str, Callable[[_Shape], float]]] = {
    ("beta",): ("psf_beta", lambda shape: shape.beta),
    ("wing", "ln_wing_px"): ("psf_wing_fraction", lambda shape: shape.wing),
    ("growth",): ("psf_growth", lambda shape: shape.growth),
    ("tilt_x", "tilt_y"): ("psf_tilt", lambda shape: shape.psf.psf_tilt),
    ("colour",): ("psf_colour_growth", lambda shape: abs(shape.colour)),
    ("e1", "e2"): ("psf_ellipticity", lambda shape: float(np.hypot(shape.e1, shape.e2))),
}


def _covariance(stamps: StarStamps, names: tuple[str, ...], shape: _Shape) -> Float:
    """Return the covariance of the parameters by leaving out each star in turn, (k, k).

    The jackknife of the linearised fit, with flux, sky and position of each star free (Efron & Stein 1981, *Ann. Stat.*
    9, 586).  A few bright stars decide a fit: with their own residuals, which the fit has made small, the sandwich
    estimator states a tenth of the error.
    """
    weight = _weights(stamps, shape, _faint_fluxes(stamps, shape))
    residual, by_position = _position_slopes(stamps, shape, weight)
    transposed = np.swapaxes(by_position, 1, 2)
    normal = transposed @ by_position + 1e-9 * np.eye(2)

    def free(values: Float) -> Float:
        return np.asarray(values - by_position @ np.linalg.solve(normal, transposed @ values))

    J = free(_slopes(stamps, names, shape, weight))
    r = free(residual)
    information = np.swapaxes(J, 1, 2) @ J
    score = (np.swapaxes(J, 1, 2) @ r)[..., 0]
    without = information.sum(axis=0) - information
    step = np.einsum("nkl,nl->nk", np.linalg.pinv(without, hermitian=True), score)
    return np.asarray(np.cov(step.T, bias=True).reshape(len(names), -1) * (len(stamps) - 1))


def _between_halves(stamps: StarStamps, names: tuple[str, ...], shape: _Shape) -> Float:
    """Return what the shapes of bright and of faint stars add to the covariance, (k, k).

    A cut-off background, tone curves and blends change bright and faint stars differently, but stars of one brightness
    alike, which no jackknife shows.  A difference within its own standard error adds nothing.
    """
    if len(stamps) < 2 * _STARS_PER_PARAMETER * len(names):
        return np.zeros((len(names), len(names)))
    order = np.argsort(-_faint_fluxes(stamps, shape), kind="stable")
    fits = [_fitted(stamps.some(np.sort(half)), names, shape) for half in np.array_split(order, 2)]
    half_difference = (fits[0][0].vector(names) - fits[1][0].vector(names)) / 2
    by_chance = sum((np.diag(_covariance(moved, names, one)) for one, moved, _ in fits), np.zeros(len(names))) / 4
    return np.diag(np.maximum(half_difference**2 - by_chance, 0.0))


def _errors(names: tuple[str, ...], shape: _Shape, covariance: Float) -> dict[str, float]:
    """Return the standard errors of the keys of ``[sensor]``; `covariance` (k, k): of the parameters."""
    by_name = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    errors = {"psf_sigma_px": by_name["sigma"] * shape.sigma_px}
    if "beta" in by_name:
        errors["psf_beta"] = by_name["beta"] * shape.beta**2
    if "wing" in by_name:
        errors["psf_wing_fraction"] = by_name["wing"]
        errors["psf_wing_sigma_px"] = by_name["ln_wing_px"] * float(np.exp(shape.ln_wing_px))
    if "growth" in by_name:
        errors["psf_growth"] = by_name["growth"]
    if "tilt_x" in by_name:
        errors["psf_tilt"] = float(np.hypot(by_name["tilt_x"], by_name["tilt_y"]) / np.sqrt(2))
        errors["psf_tilt_angle_deg"] = float(np.rad2deg(errors["psf_tilt"] / max(shape.psf.psf_tilt, 1e-3)))
    if "colour" in by_name:
        errors["psf_colour_growth"] = by_name["colour"]
    if "e1" in by_name:
        errors["psf_ellipticity"] = float(np.hypot(by_name["e1"], by_name["e2"]) / np.sqrt(2))
        errors["psf_angle_deg"] = float(
            np.rad2deg(errors["psf_ellipticity"] / max(2 * shape.psf.psf_ellipticity, 2e-3))
        )
    return errors


def _weights(stamps: StarStamps, shape: _Shape, flux: Float) -> Float:
    """Return the weights of pixels: noise of sky and star, and the model's own error where stars are bright."""
    if not flux.any():
        return 1 / stamps.variance_dn2
    model = np.maximum(flux, 0.0)[:, np.newaxis, np.newaxis] * stamps.profiles(shape.psf, shape.sigma_px)
    return np.asarray(1 / (stamps.variance_dn2 + stamps.dn_per_e * model + (_MODEL_ERROR * model) ** 2))


def _faint_fluxes(stamps: StarStamps, shape: _Shape) -> Float:
    """Return the fluxes of stars, (n,), with the weights of stars too faint for noise of their own."""
    return _residuals(stamps, shape, _weights(stamps, shape, np.zeros(len(stamps))))[1]


def _without_outliers(stamps: StarStamps, shape: _Shape) -> StarStamps:
    """Return the stamps without the light that a shape does not explain, found by a filter as wide as a star."""
    residual = _residuals(stamps, shape, _weights(stamps, shape, _faint_fluxes(stamps, shape)))[0]
    sigma_px = float(np.clip(shape.sigma_px, 0.7, 3.0))
    noise = 1 / (2 * np.sqrt(np.pi) * sigma_px)
    near = np.ones((2 * round(1.5 * sigma_px) + 1,) * 2, np.uint8)
    unexplained = [
        cv2.dilate((np.abs(cv2.GaussianBlur(one, (0, 0), sigma_px)) > _OUTLIER * noise).astype(np.uint8), near) > 0
        for one in residual
    ]
    return replace(stamps, variance_dn2=np.where(unexplained, np.inf, stamps.variance_dn2))


def _without_position_bias(stamps: StarStamps, names: tuple[str, ...], shape: _Shape) -> _Shape:
    """Return the shape that stars have about their true positions.

    Fitted positions follow the noise, and about them stars look narrower: with the covariance C of a position the
    parameters are off by -(J' W J)^-1 J' W tr(C m'') / 2 (Box 1971, *J. R. Stat. Soc. B* 33, 171), m'' being the second
    derivatives of a star's light by its position.
    """
    weight = _weights(stamps, shape, _faint_fluxes(stamps, shape))
    flux = _residuals(stamps, shape, weight)[1][:, np.newaxis, np.newaxis]
    here = stamps.profiles(shape.psf, shape.sigma_px)
    step_px = 5 * _STEP_PX
    missing = np.zeros_like(here)
    for axis in (0, 1):
        sides = []
        for sign in (-1, 1):
            shifted = stamps.xy_px.copy()
            shifted[:, axis] += sign * step_px
            sides.append(replace(stamps, xy_px=shifted).profiles(shape.psf, shape.sigma_px))
        slope = flux * (sides[1] - sides[0]) / (2 * step_px)
        variance_px2 = 1 / np.maximum(np.sum(weight * slope**2, axis=(1, 2), keepdims=True), 1e-12)
        missing += variance_px2 * flux * (sides[0] + sides[1] - 2 * here) / step_px**2 / 2
    J = _slopes(stamps, names, shape, weight)
    # `J` is that of the residuals, data minus model.
    by = -np.einsum("npk,np->k", J, (np.sqrt(weight) * missing).reshape(len(stamps), -1))
    inverse = np.linalg.pinv(np.einsum("npk,npl->kl", J, J))
    error = np.sqrt(np.diag(inverse))
    # The expansion holds for small shifts.
    moved = shape.vector(names) + np.clip(inverse @ by, -error, error)
    low, high = _limits(stamps, names)
    return shape.at(names, np.clip(moved, low + 1e-6, high - 1e-6))


def _slopes(stamps: StarStamps, names: tuple[str, ...], shape: _Shape, weight: Float) -> Float:
    """Return the derivatives of the weighted residuals by the parameters, (n, m^2, parameters)."""
    vector = shape.vector(names)
    residual = _residuals(stamps, shape, weight)[0].reshape(len(stamps), -1)
    slopes = []
    middle = np.mean(_limits(stamps, names), axis=0)
    for k in range(len(names)):
        # Towards the inside of the range.
        step = 1e-3 if vector[k] < middle[k] else -1e-3
        shifted = vector + step * (np.arange(len(names)) == k)
        slopes.append(
            (_residuals(stamps, shape.at(names, shifted), weight)[0].reshape(len(stamps), -1) - residual) / step
        )
    return np.stack(slopes, axis=-1)


def _residuals(stamps: StarStamps, shape: _Shape, weight: Float) -> tuple[Float, Float]:
    """Return weighted residuals (n, m, m) with the best flux and sky of each star, and these fluxes (n,)."""
    profile = stamps.profiles(shape.psf, shape.sigma_px)
    values = np.where(weight > 0, stamps.values_dn, 0.0)
    w, wp, wv = (np.sum(weight * one, axis=(1, 2)) for one in (1.0, profile, values))
    wpp, wpv = (np.sum(weight * profile * one, axis=(1, 2)) for one in (profile, values))
    determinant = np.maximum(w * wpp - wp**2, 1e-12 * w * wpp + 1e-30)
    flux = (w * wpv - wp * wv) / determinant
    sky = (wpp * wv - wp * wpv) / determinant
    model = flux[:, np.newaxis, np.newaxis] * profile + sky[:, np.newaxis, np.newaxis]
    return np.sqrt(weight) * (values - model), flux


def _moved(stamps: StarStamps, shape: _Shape, weight: Float) -> StarStamps:
    """Return the stamps with better positions: Gauss-Newton steps by numerical derivatives."""
    for _ in range(_POSITION_ROUNDS):
        residual, J = _position_slopes(stamps, shape, weight)
        normal = np.swapaxes(J, 1, 2) @ J + 1e-9 * np.eye(2)
        step = -np.linalg.solve(normal, np.swapaxes(J, 1, 2) @ residual)[..., 0]
        stamps = replace(stamps, xy_px=stamps.xy_px + np.clip(step, -_LARGEST_STEP_PX, _LARGEST_STEP_PX))
    return stamps


def _position_slopes(stamps: StarStamps, shape: _Shape, weight: Float) -> tuple[Float, Float]:
    """Return the weighted residuals (n, m^2, 1), and their derivatives by the positions of the stars (n, m^2, 2)."""
    residual, _ = _residuals(stamps, shape, weight)
    slopes = []
    for axis in (0, 1):
        shifted = stamps.xy_px.copy()
        shifted[:, axis] += _STEP_PX
        slopes.append((_residuals(replace(stamps, xy_px=shifted), shape, weight)[0] - residual) / _STEP_PX)
    return residual.reshape(len(stamps), -1, 1), np.stack(slopes, axis=-1).reshape(len(stamps), -1, 2)


def _free_pixels(stamps: StarStamps) -> int:
    return int(np.isfinite(stamps.variance_dn2).sum())
