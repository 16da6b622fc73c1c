"""Matching of predicted catalogue stars with detections, and the refinement of the plate solution on the matches.

A faint catalogue star always has some detection near it: a hot pixel, a noise peak, a fainter star.  A match is kept if
it is much more probable that the detection is the star than that another detection is as close by chance.  In wide
views the matches grow outwards from the middle of the image, together with a fisheye lens.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc

from glstar.arrays import Float, Index, Mask, robust_std
from glstar.calibrate.identify.leastsquares import (
    CameraPoses,
    FreeParameters,
    IdentifiedStars,
    fit_parameters,
    projection_jacobian,
)
from glstar.calibrate.identify.platesolution import (
    CENTRAL_RADIUS_RAD,
    MIN_STARS,
    SIGNIFICANCE,
    Matches,
    PlateSolution,
    ReferenceStars,
)
from glstar.calibrate.minimise import Minimum, minimise
from glstar.calibrate.photo.detection import DetectedStars
from glstar.camera.model import Camera
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn

# Smallest probability of a real match that is kept.
_LEAST_PROBABILITY = 0.9
# Largest expected number of false matches among all kept ones, or their largest fraction if that is more.
_MOST_FALSE = 0.5
_MOST_FALSE_FRACTION = 0.005
# The fraction of stars detected is estimated from this number of stars just brighter and just fainter, each.
_NEIGHBOURS = 12
# No star is certain to be detected, and none certain not to be.
_COMPLETENESS = (0.005, 0.98)
# Positions of one star in ten scatter three times as much: neighbours, saturation, a lens not quite of the model.
_TAIL_FRACTION = 0.1
_TAIL_SCALE = 3.0


def chance_pairs(stars: int, detections: int, radius_px: float, area_px2: float) -> float:
    """Return the expected number of chance pairs within a radius, of all stars and detections in an area."""
    return stars * detections * np.pi * radius_px**2 / area_px2


def match_probability(separation_px: Float, scatter_px: Float, density_per_px2: float, radius_px: float) -> Float:
    """Return the probability that each catalogue star's nearest detection is the star itself.

    `separation_px` (n,): distance from each predicted star, the brightest first, to its match; infinite for a star
    without one; `scatter_px` (n,): standard deviation of a match's position in x and in y, if it is real;
    `density_per_px2`: detections per square pixel; `radius_px`: matching radius, px.  Returns (n,): 0 for stars without
    a match.  Bayes' theorem: a real match has a Gaussian separation (with a tail), and a prior, the fraction of stars
    of this brightness that are matched in excess of chance; a chance match has a uniform position.
    """
    matched = np.isfinite(separation_px)
    prior = _completeness(matched, float(-np.expm1(-density_per_px2 * np.pi * radius_px**2)))
    square = np.where(matched, separation_px / scatter_px, 0.0) ** 2
    core = (1 - _TAIL_FRACTION) * np.exp(-square / 2)
    tail = _TAIL_FRACTION * np.exp(-square / (2 * _TAIL_SCALE**2)) / _TAIL_SCALE**2
    real = prior * (core + tail) / (2 * np.pi * scatter_px**2)
    chance = (1 - prior) * density_per_px2
    return np.where(matched, real / (real + chance), 0.0)


def significant(probability: Float) -> Mask:
    """Return which matches are kept (n,): the most probable, with a bound on the number of false ones."""
    order = np.argsort(-probability, kind="stable")
    false_so_far = np.cumsum(1 - probability[order])
    most = np.maximum(_MOST_FALSE, _MOST_FALSE_FRACTION * np.arange(1, len(order) + 1))
    kept = np.zeros(len(order), dtype=np.bool_)
    kept[order[(false_so_far <= most) & (probability[order] >= _LEAST_PROBABILITY)]] = True
    return kept


def _completeness(matched: Mask, chance: float) -> Float:
    """Return the detected fraction of stars of similar brightness, without the star itself.

    The estimate is conservative: the expected chance matches and one standard deviation of their number are subtracted.
    """
    count = len(matched)
    total = np.concatenate([[0], np.cumsum(matched)])
    rank = np.arange(count)
    first, last = np.maximum(rank - _NEIGHBOURS, 0), np.minimum(rank + _NEIGHBOURS + 1, count)
    others = last - first - 1
    seen = total[last] - total[first] - matched
    by_chance = chance * others
    fraction = (seen + 0.5 - by_chance - np.sqrt(by_chance)) / ((others + 1) * (1 - min(chance, 0.9)))
    return np.asarray(np.clip(fraction, *_COMPLETENESS))


@dataclass(frozen=True, slots=True)
class _Matching:
    """Thresholds of matching."""

    # Number of the brightest detections that are matched: a multiple of the number of predicted stars, plus a constant.
    detections_per_star: float = 1.5
    extra_detections: int = 10
    # The expected number of chance pairs limits the number of stars matched within a large radius, ...
    chance_pairs: float = 0.5
    # ... but at least this number of the brightest are matched.
    fewest_stars: int = 20
    # The matching radius of a saturated star, over that of the others: its centroid is less certain.
    saturated_radius: float = 2.0
    # Catalogue stars within a pixel of the nearest one, among this number of neighbours, are one star on the image.
    unresolved_neighbours: int = 4
    unresolved_px: float = 1.0
    # Smallest scatter of centroids, px, and the number of rounds to estimate it.
    min_scatter_px: float = 0.1
    scatter_rounds: int = 5


@dataclass(frozen=True, slots=True)
class _FalseAlarm:
    """How the false-alarm probability is computed."""

    # Solutions tried in a search of the whole sky.
    solutions_tried: float = 1e6
    # Number of stars in the pattern of a solution; they match even if the solution is wrong.
    pattern_stars: int = 4
    # The probability is computed for this number of the brightest stars, and for two, four ... times this number.
    fewest_brightest: int = 10
    # The density of detections is measured around stars shifted this number of times, by these multiples of the radius.
    shifts: int = 24
    shift_radii: tuple[float, float] = (6.0, 20.0)


@dataclass(frozen=True, slots=True)
class _Refinement:
    """How a plate solution is refined."""

    # The first matching radius, over the image's width.
    first_radius: float = 0.01
    # Later radii: this multiple of the 90th percentile of the residuals, and at least this many px.
    radius_per_residual: float = 3.0
    min_radius_px: float = 1.5
    rounds: int = 10
    # The first rounds take few least-squares steps, because the next round continues the fit.  After these rounds,
    # solutions with insignificant matches are abandoned.
    first_rounds: int = 3
    first_steps: int = 6
    most_steps: int = 100
    # Prior standard deviations: of ln f, of the principal point over the image's width, of k1.
    focal_sd: float = 0.1
    principal_point_sd: float = 0.02
    k1_sd: float = 0.1
    # A free principal point and k1 must lower Bayes' information criterion by this much.
    criterion_margin: float = 10.0


_MATCHING = _Matching()
_FALSE_ALARM = _FalseAlarm()
_REFINEMENT = _Refinement()


def refine(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution) -> Matches | None:
    """Match and refine a solution with an error of at most 1 % of the image's width, with shrinking radii.

    The result is None if fewer than three stars match, or if the matches are insignificant.
    """
    radius_px = max(_REFINEMENT.first_radius * solution.camera.width_px, 3 * _REFINEMENT.min_radius_px)
    for number in range(_REFINEMENT.rounds):
        matches = match_stars(detected, reference, solution, radius_px)
        first = number < _REFINEMENT.first_rounds
        if len(matches) < 3 or (not first and matches.chance >= 1):
            return None
        solution = _refined(detected, reference, matches, _REFINEMENT.first_steps if first else _REFINEMENT.most_steps)
        residual_px = np.linalg.norm(_residuals(detected, reference, solution, matches), axis=1)
        next_px = _REFINEMENT.radius_per_residual * float(np.quantile(residual_px, 0.9))
        radius_px = max(min(next_px, 0.8 * radius_px), _REFINEMENT.min_radius_px)
    return match_stars(detected, reference, solution, radius_px, deep=True)


def match_stars(
    detected: DetectedStars,
    reference: ReferenceStars,
    solution: PlateSolution,
    radius_px: float,
    *,
    deep: bool = False,
    within_px: float = np.inf,
) -> Matches:
    """Return pairs of predicted stars and detections that are each other's nearest within a radius.

    `radius_px`: matching radius, px; `deep`: match all predicted stars, with as many detections as possible without an
    expected false match, and keep the significant pairs; otherwise match about as many of the brightest detections as
    there are predicted stars; `within_px`: ignore stars and detections farther from the principal point than this, px.
    """
    predicted, xy = solution.stars_on_image(reference)
    centre = solution.project(np.array([[0.0, 0.0, 1.0]]))
    near = np.linalg.norm(xy - centre, axis=1) < within_px
    predicted, xy = predicted[near], xy[near]
    tried = np.flatnonzero(np.linalg.norm(detected.xy_px - centre, axis=1) < within_px)
    area_px2 = min(solution.camera.width_px * solution.camera.height_px, np.pi * within_px**2)
    stars, count = _brightest_counts(len(predicted), len(tried), radius_px, area_px2, deep=deep)
    tried = tried[:count]
    detection_xy, star_xy = detected.xy_px[tried], xy[:stars]
    if not stars or not count:
        none = np.empty(0, dtype=np.intp)
        return Matches(
            solution=solution,
            star=none,
            detection=none,
            residual_px=np.empty((0, 2)),
            predicted=predicted,
            predicted_xy_px=xy,
            chance=1.0,
        )
    detection, distance_px = mutual_nearest(star_xy, detection_xy, detected.psf_sigma_px)
    scale = np.where(deep & detected.saturated[tried[detection]], _MATCHING.saturated_radius, 1.0)
    matched = distance_px < radius_px * scale
    by_chance = 1 - (1 - min(np.pi * radius_px**2 / area_px2, 1.0)) ** count
    chance = float(min(1.0, _FALSE_ALARM.solutions_tried * bdtrc(int(matched.sum()) - 1, stars, by_chance)))
    expected, false_alarm, needed = 0.0, 1.0, 0
    if deep:
        nearby = max(by_chance, _chance_nearby(detection_xy, star_xy, radius_px))
        false_alarm, needed = _false_alarm(matched, nearby)
        offset = detection_xy[detection] - star_xy
        probability = offset_probability(offset, matched, scale, count / area_px2, radius_px)
        matched = significant(probability)
        expected = float((1 - probability[matched]).sum())
    pairs = np.flatnonzero(matched)
    star, paired = predicted[pairs], tried[detection[pairs]]
    residual_px = detection_xy[detection[pairs]] - xy[pairs]
    return Matches(
        solution=solution,
        star=star,
        detection=paired,
        residual_px=residual_px,
        predicted=predicted,
        predicted_xy_px=xy,
        chance=chance,
        false_alarm=false_alarm,
        needed=needed,
        expected_by_chance=expected,
    )


def mutual_nearest(star_xy: Float, detection_xy: Float, psf_sigma_px: float) -> tuple[Index, Float]:
    """Return the predicted stars and detections that are each other's nearest.

    `star_xy` (n, 2): predicted positions, px, the brightest star first; `detection_xy` (m, 2): detected positions, px;
    m >= 1; `psf_sigma_px`: stars closer than this, and than a pixel, are unresolved; the brightest of them counts.
    Returns `detection` (n,) intp: the detection nearest to each star; `distance_px` (n,): its distance, px; infinite if
    another star is nearer to that detection.
    """
    distance_px, detection = KDTree(detection_xy).query(star_xy)
    count = min(_MATCHING.unresolved_neighbours, len(star_xy))
    neighbour_px, star = KDTree(star_xy).query(detection_xy, k=np.arange(1, count + 1))
    resolution_px = max(psf_sigma_px, _MATCHING.unresolved_px)
    unresolved = np.linalg.norm(star_xy[star] - star_xy[star[:, :1]], axis=2) <= resolution_px
    owner = np.where(unresolved & np.isfinite(neighbour_px), star, len(star_xy)).min(axis=1)
    return detection, np.where(owner[detection] == np.arange(len(star_xy)), distance_px, np.inf)


def offset_probability(
    offset_px: Float, matched: Mask, scale: Float, density_per_px2: float, radius_px: float
) -> Float:
    """Return the probability that each match is real, with the scatter measured on the matches themselves.

    `offset_px` (n, 2): detected minus predicted position, px, the brightest star of the catalogue first; `matched` (n,)
    bool: whether the star has a match; `scale` (n,): ratio of the standard deviations of a star's position and of the
    other stars' positions; `density_per_px2`: detections per square pixel; `radius_px`: matching radius, px.  Returns
    (n,): 0 for stars without a match.
    """
    separation_px = np.where(matched, np.linalg.norm(offset_px, axis=1), np.inf)
    probability = matched.astype(np.float64)
    # Chance matches widen the measured scatter; each round leaves more of them out.
    for _ in range(_MATCHING.scatter_rounds):
        real = probability > 0.5
        if not real.any():
            break
        scatter_px = max(robust_std(offset_px[real] / scale[real, np.newaxis]), _MATCHING.min_scatter_px)
        probability = match_probability(separation_px, scatter_px * scale, density_per_px2, radius_px)
    return probability


def _chance_nearby(detection_xy: Float, star_xy: Float, radius_px: float) -> float:
    """Return the probability that a detection lies within a radius of a random position near a star."""
    angle = np.arange(_FALSE_ALARM.shifts) * np.pi * (3 - np.sqrt(5))
    length_px = radius_px * np.linspace(*_FALSE_ALARM.shift_radii, _FALSE_ALARM.shifts)
    shift = np.column_stack([np.cos(angle), np.sin(angle)]) * length_px[:, np.newaxis]
    shifted = (star_xy[np.newaxis] + shift[:, np.newaxis]).reshape(-1, 2)
    return float((KDTree(detection_xy).query(shifted)[0] < radius_px).mean())


def _false_alarm(matched: Mask, nearby: float) -> tuple[float, int]:
    """Return the probability that a wrong solution matches as many stars, and the number that is improbable enough.

    The smallest probability among all stars and the brightest 10, 20, 40 ..., because a hazy image lacks faint stars.
    All solutions and all these subsets count as trials.
    """
    stars = len(matched)
    subsets = [*(_FALSE_ALARM.fewest_brightest * 2 ** np.arange(20)), stars]
    subsets = sorted({int(count) for count in subsets if count <= stars})
    best, needed = 1.0, stars + 1
    for count in subsets:
        matches = int(matched[:count].sum())
        number = np.arange(count + 1)
        beyond = number - _FALSE_ALARM.pattern_stars
        others = max(count - _FALSE_ALARM.pattern_stars, 1)
        tail = np.where(beyond < 1, 1.0, bdtrc(np.clip(beyond - 1, 0, others - 1), others, nearby))
        alarm = np.minimum(1.0, _FALSE_ALARM.solutions_tried * len(subsets) * tail)
        if alarm[matches] <= best:
            enough = np.flatnonzero(alarm <= SIGNIFICANCE.false_alarm)
            best = float(alarm[matches])
            needed = int(matched.sum()) - matches + (int(enough[0]) if enough.size else count + 1)
    return best, needed


def _brightest_counts(stars: int, detections: int, radius_px: float, area_px2: float, *, deep: bool) -> tuple[int, int]:
    """Return how many of the brightest predicted stars and detections to match, with few pairs expected by chance."""
    per_star, extra = _MATCHING.detections_per_star, _MATCHING.extra_detections
    if deep:
        sparse = int(_MATCHING.chance_pairs / max(chance_pairs(stars, 1, radius_px, area_px2), 1e-12))
        return stars, min(detections, max(round(per_star * stars) + extra, sparse))
    most = _MATCHING.chance_pairs / chance_pairs(1, 1, radius_px, area_px2)
    # The positive root of k (1.5 k + 10) = most.
    few = (np.sqrt(extra**2 + 4 * per_star * most) - extra) / (2 * per_star)
    stars = min(stars, max(int(few), _MATCHING.fewest_stars))
    return stars, min(detections, round(per_star * stars) + extra)


def _residuals(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution, matches: Matches) -> Float:
    detected_px = detected.xy_px[matches.detection]
    recorded = reference.recorded(solution.C_camera_eq, matches.star, detected_px, solution.camera)
    return np.asarray(detected_px - solution.project(recorded))


def _refined(detected: DetectedStars, reference: ReferenceStars, matches: Matches, most_steps: int) -> PlateSolution:
    """Return the solution that minimises the robust residuals.

    The camera keeps its principal point and has no k1 unless Bayes' information criterion clearly supports them: in a
    narrow view the principal point and the attitude can hardly be separated.
    """
    start, xy = matches.solution, detected.xy_px[matches.detection]
    apparent = reference.recorded(np.eye(3), matches.star, xy, start.camera)
    typical_px = max(robust_std(matches.residual_px), 0.02)
    prior = start.prior_camera or start.camera

    def fit(free: int, solution: PlateSolution) -> Minimum[PlateSolution]:
        return minimise(
            replace(solution, prior_camera=prior),
            lambda solution: _residuals_and_jacobian(solution, apparent, xy, typical_px, free),
            _stepped,
            scale=typical_px,
            most_steps=most_steps,
        )

    distorted, plain = fit(7, start), fit(4, without_k1(start, prior))
    count = 2 * len(xy)
    improvement = count * np.log(plain.cost / max(distorted.cost, 1e-12))
    if improvement < 3 * np.log(count) + _REFINEMENT.criterion_margin:
        return plain.state
    return distorted.state


def _stepped(solution: PlateSolution, step: Float) -> PlateSolution:
    """Return the solution a step (4 or 7,) away: rotation, ln f, principal point over the width, k1."""
    turn, (log_f, right, down, k1) = step[:3], np.append(step[3:], np.zeros(7 - len(step)))
    camera = solution.camera
    stepped = replace(
        camera,
        fx_px=float(camera.fx_px * np.exp(log_f)),
        fy_px=float(camera.fy_px * np.exp(log_f)),
        cx_px=camera.cx_px + float(right) * camera.width_px,
        cy_px=camera.cy_px + float(down) * camera.width_px,
    )
    C = matrix_from_quaternion(quaternion_from_turn(turn)) @ solution.C_camera_eq
    return replace(solution, camera=stepped, C_camera_eq=C, k1=solution.k1 + float(k1))


def _residuals_and_jacobian(
    solution: PlateSolution, apparent: Float, xy_px: Float, typical_px: float, free: int
) -> tuple[Float, Float]:
    """Return predicted minus detected positions and the prior's residuals, and their Jacobian by a step."""
    camera, width_px = solution.camera, solution.camera.width_px
    prior = solution.prior_camera or camera
    direction = apparent @ solution.C_camera_eq.T
    residual = solution.project(direction) - xy_px
    distorted, by_turn = projection_jacobian(camera, direction)
    focal = np.array([camera.fx_px, camera.fy_px])
    offset = distorted @ camera.K[:2, :2].T
    tangent = offset / focal
    square = (tangent**2).sum(axis=1)[:, np.newaxis]
    # Derivative of the position with k1 by the position without, (n, 2, 2).
    by_offset = (1 + solution.k1 * square)[..., np.newaxis] * np.eye(2)
    by_offset = by_offset + 2 * solution.k1 * offset[:, :, np.newaxis] * (tangent / focal)[:, np.newaxis, :]
    jacobian = np.zeros((len(residual), 2, 7))
    jacobian[:, :, :3] = by_offset @ by_turn
    # A step in focal length leaves the tangents as they are.
    jacobian[:, :, 3] = offset * (1 + solution.k1 * square)
    jacobian[:, :, 4:6] = width_px * np.eye(2)
    jacobian[:, :, 6] = offset * square
    if solution.mirrored:
        jacobian[:, 0] *= -1
    jacobian[~np.isfinite(jacobian).all(axis=(1, 2)) | ~np.isfinite(residual).all(axis=1)] = 0.0
    sd = np.array([_REFINEMENT.focal_sd, *(2 * [_REFINEMENT.principal_point_sd]), _REFINEMENT.k1_sd])
    from_prior = np.array(
        [
            np.log(camera.fx_px / prior.fx_px) / _REFINEMENT.focal_sd,
            (camera.cx_px - prior.cx_px) / (_REFINEMENT.principal_point_sd * width_px),
            (camera.cy_px - prior.cy_px) / (_REFINEMENT.principal_point_sd * width_px),
            solution.k1 / _REFINEMENT.k1_sd,
        ]
    )
    by_step = np.hstack([np.zeros((4, 3)), np.diag(1 / sd)])
    residuals = np.concatenate([np.nan_to_num(residual, nan=1e3).ravel(), typical_px * from_prior])
    return residuals, np.concatenate([jacobian.reshape(-1, 7), typical_px * by_step])[:, :free]


def without_k1(solution: PlateSolution, prior: Camera) -> PlateSolution:
    """Return the solution with the principal point of its new prior and without k1; the middle stays where it is."""
    camera = solution.camera
    right_px, down_px = camera.cx_px - prior.cx_px, camera.cy_px - prior.cy_px
    turn_rad = np.array([np.arctan(down_px / camera.fy_px), -np.arctan(right_px / camera.fx_px), 0.0])
    C = matrix_from_quaternion(quaternion_from_turn(turn_rad)) @ solution.C_camera_eq
    return PlateSolution(replace(camera, cx_px=prior.cx_px, cy_px=prior.cy_px), C, solution.mirrored, 0.0, prior)


@dataclass(frozen=True, slots=True)
class _Growth:
    """How matching grows outwards."""

    # Each round extends the matched radius by this factor; the matching radius is this fraction of the image's width.
    factor: float = 1.2
    radius: float = 0.005
    # Rounds over the whole image, at the end.
    rounds: int = 6
    # Their matching radius: this multiple of the 90th percentile of the residuals, and at least this many px.
    radius_per_residual: float = 3.0
    min_radius_px: float = 1.0
    # Number of fisheye coefficients from this fraction of the distance to the corner on.
    coefficients: tuple[tuple[float, int], ...] = ((0.0, 1), (0.4, 2), (0.65, 3), (0.9, 4))
    stars_per_parameter: int = 2
    min_noise_px: float = 0.005


_GROWTH = _Growth()


def refine_outwards(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution) -> Matches | None:
    """Match and refine a solution that is right near the middle of the image and has an approximate lens.

    `solution`: its camera has a fisheye lens, and the focal length and attitude that fit the middle of the image.  The
    result has a fisheye that fits up to the corners; it is None if fewer than four stars match towards the corners, or
    if the matches are insignificant.
    """
    camera, apparent = solution.camera, reference.to_camera(np.eye(3))
    assert camera.lens is not None
    solution = replace(solution, prior_camera=solution.prior_camera or camera)
    corner_px = float(np.hypot(camera.width_px, camera.height_px) / 2)
    within_px = camera.fx_px * float(camera.lens.radius(CENTRAL_RADIUS_RAD))
    radius_px, rounds = _GROWTH.radius * camera.width_px, _GROWTH.rounds
    while rounds:
        matches = match_stars(detected, reference, solution, radius_px, within_px=within_px)
        if len(matches) < MIN_STARS or matches.chance >= 1:
            return None
        stars = IdentifiedStars.of(detected, apparent, solution, matches.star, matches.detection, reference.rows)
        refined = _with_fisheye(stars, solution, matches, within_px / corner_px)
        if refined is None:
            return None
        solution = refined
        if within_px < corner_px:
            within_px *= _GROWTH.factor
        else:
            residual_px = np.linalg.norm(stars.residual_px(solution.camera, solution.C_camera_eq), axis=1)
            next_px = _GROWTH.radius_per_residual * float(np.nanquantile(residual_px, 0.9))
            radius_px = max(min(next_px, radius_px), _GROWTH.min_radius_px)
            rounds -= 1
    return match_stars(detected, reference, solution, radius_px, deep=True)


def _with_fisheye(
    stars: IdentifiedStars, solution: PlateSolution, matches: Matches, corner_fraction: float
) -> PlateSolution | None:
    """Return the solution with a fisheye whose number of coefficients depends on the matched radius."""
    count = max(count for fraction, count in _GROWTH.coefficients if corner_fraction >= fraction)
    count = max(1, min(count, len(stars) // _GROWTH.stars_per_parameter - 6))
    noise_px = max(robust_std(matches.residual_px), _GROWTH.min_noise_px)
    prior = solution.prior_camera or solution.camera
    free = FreeParameters((stars,), prior, (noise_px,), tuple(range(count)), principal_point=True)
    fit = fit_parameters(free, CameraPoses(solution.camera, (solution.C_camera_eq,)), "fisheye")
    if fit is None:
        return None
    return replace(solution, camera=fit.state.camera, C_camera_eq=fit.state.C_camera_eq[0])
