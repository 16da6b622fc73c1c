"""Which star is which: from a known attitude, from labels, or from nothing but the pattern.

All three ways end alike.  A first `PlateSolution` (where the camera looked, how long its lens is, whether the image is
mirrored) predicts where the catalogue's stars fall; predictions and detections that meet refine the solution; and what
meets is held against what would meet by chance, so that a wrong solution is refused instead of reported.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import bdtrc

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.leastsquares import Minimum, minimise, projection_jacobian
from glstar.calibrate.significance import chance_pairs, match_probability, significant
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.render.scene import Pointing
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.sky.horizon import diurnal_aberration_rad
from glstar.sky.observed import Sky
from glstar.sky.site import Site
from glstar.sky.starfield import StarField
from glstar.statistics import robust_std

__all__ = [
    "CENTRAL_RADIUS_RAD",
    "MIN_STARS",
    "Label",
    "Matches",
    "PlateSolution",
    "ReferenceStars",
    "exceeds_pinhole",
    "identify_by_labels",
    "is_significant",
    "match",
    "mutual_nearest",
    "offset_probability",
    "orientation_notes",
    "refine",
    "require_significant",
    "wide_angle_cameras",
]  # fmt: skip

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# A solution is accepted if chance would bring as many stars together less often than this, all tried ones counted, and
# this fraction of its brightest stars is matched.
_CHANCE: Final = 1e-9
_FIELDS_TRIED: Final = 1e6
_LEAST_SHARE: Final = 0.5
# Where fewer are (a roof, a cloud, a lamp hides them) it is accepted if the false-alarm probability is below this.
_FALSE_ALARM: Final = 1e-12
# A solution is found through this number of stars: they match whether it is right or wrong.
_STARS_OF_A_PATTERN: Final = 4
# The false-alarm probability is also computed for this number of the brightest stars, twice, four times that.
_FEWEST_BRIGHTEST: Final = 10
# The density of detections where the stars are is measured by this number of shifts, this multiple of the radius long.
_SHIFTS: Final = 24
_SHIFT_RADII: Final = (6.0, 20.0)
MIN_STARS: Final = 4
# Detections are matched from the brightest down: so many for each predicted star, and some.
_DETECTIONS_A_STAR: Final = 1.5
_DETECTIONS_MORE: Final = 10
# Expected number of chance pairs: fewer stars are matched within a large circle than within a small one, ...
_FALSE_STARS: Final = 0.5
# ... but no fewer than this number of the brightest.
_FEWEST_TRIED: Final = 20
# Stars are looked for within this share of the image's width at first, and at last within so many times the distance
# under which nine of ten lie.
_FIRST_RADIUS: Final = 0.01
_LAST_RADIUS: Final = 3.0
_LEAST_RADIUS_PX: Final = 1.5
_BURNT_RADIUS: Final = 2.0
# Of this number of stars nearest to a detection those within a pixel of the nearest are one on the image.
_ONE_OF: Final = 4
_ONE_PX: Final = 1.0
_ROUNDS: Final = 10
# Centroids are never better than this, px; the scatter of real matches is found in this number of rounds.
_LEAST_SCATTER_PX: Final = 0.1
_SCATTER_ROUNDS: Final = 5
# The first rounds of a refinement take at most this number of steps; after them a solution whose matches chance can
# explain is given up.
_FIRST_ROUNDS: Final = 3
_FIRST_STEPS: Final = 6
_MOST_STEPS: Final = 100
# What is thought of a lens before the stars have spoken, standard deviations: of the focal length's logarithm, of the
# principal point from the image's middle over its width, of the bend.
_FOCAL_SD: Final = 0.1
_MIDDLE_SD: Final = 0.02
_BEND_SD: Final = 0.1
_CLEARLY: Final = 10.0
# Wide views are no pinholes': how their lenses may go, where nobody says it.  Most are nearly equidistant, the distance
# from the middle in proportion to the angle from the axis, whatever the model that somebody calibrates them with.
_WIDE_LENSES: Final = (Lens("fisheye", ()), Lens("fisheye", (1 / 6,)))
# From this width on, left to right, a view counts as wide.
_WIDE_RAD: Final = np.deg2rad(35.0)
# Wider than this only a fisheye sees.
_WIDEST_PINHOLE_RAD: Final = np.deg2rad(140.5)
# Within this angle of the middle any of those lenses is right to a hundredth.
CENTRAL_RADIUS_RAD: Final = np.deg2rad(20.0)
# A label points at a star to so many pixels.
_LABEL_PX: Final = 8.0
_LABELS_NEEDED: Final = 3
_FOVS_TRIED_RAD: Final = np.deg2rad(np.geomspace(2.0, 140.0, 200))


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceStars:
    """The stars that an image may show, and what bends their light.

    Attributes
    ----------
    stars : StarField
        The brightest first.
    zenith_eq, velocity_eq : (3,) float64
        The direction up and the observer's velocity in units of that of light; zeros where the place is not known.
    refraction_scale : float
        What `glstar.sky.horizon.refraction_scale` gives; 0 where the place is not known.
    C_ned_eq : (3, 3) float64 or None
        True equator and equinox to north, east, down, where place and time are known.
    """

    stars: StarField
    zenith_eq: Float
    velocity_eq: Float
    refraction_scale: float
    C_ned_eq: Float | None

    @staticmethod
    def over(sky: Sky, utc_s: float, site: Site) -> "ReferenceStars":
        """Return the sky over a place and a time.

        Parameters
        ----------
        sky : Sky
        utc_s : float
            UTC seconds since 1970.
        site : Site

        Returns
        -------
        ReferenceStars
        """
        C = sky.C_ned_eq([utc_s], [site.latitude_rad], [site.longitude_rad])[0]
        speed = diurnal_aberration_rad(site.latitude_rad, site.height_m)
        return ReferenceStars(sky.star_field(utc_s), -C[2], speed * C[1], sky.refraction_scale(site), C)

    @staticmethod
    def anywhere(sky: Sky, utc_s: float) -> "ReferenceStars":
        """Return the sky of nowhere in particular: without horizon and refraction.

        Parameters
        ----------
        sky : Sky
        utc_s : float
            About when, UTC seconds since 1970, for proper motion.

        Returns
        -------
        ReferenceStars
        """
        return ReferenceStars(sky.star_field(utc_s), np.zeros(3), np.zeros(3), 0.0, None)

    def to_camera(self, C_camera_eq: Float) -> Float:
        """Return where the stars stand in the camera frame, (n, 3) float64; NaN under the horizon."""
        pointing = Pointing(
            C_camera_eq[np.newaxis], self.zenith_eq[np.newaxis], self.velocity_eq[np.newaxis], self.refraction_scale
        )
        return np.asarray(pointing.to_camera(self.stars.direction_eq)[0])


@dataclass(frozen=True, slots=True, eq=False)
class PlateSolution:
    """How the sky falls on an image.

    Attributes
    ----------
    camera : Camera
    C_camera_eq : (3, 3) float64
        True equator and equinox of date to camera components.
    mirrored : bool
        Whether left and right are exchanged on the image.
    k1 : float
        How much farther from the principal point stars fall than a pinhole puts them, over the cube of the tangent of
        their angle: radial distortion of the lowest order (OpenCV's k1).
    prior_camera : Camera or None
        The camera before it was refined, if it was: stars too few to tell leave it as it is.
    """

    camera: Camera
    C_camera_eq: Float
    mirrored: bool = False
    k1: float = 0.0
    prior_camera: Camera | None = None

    def project(self, direction_camera: Float) -> Float:
        """Return where directions of the camera frame fall on the image.

        Parameters
        ----------
        direction_camera : (n, 3) float64

        Returns
        -------
        (n, 2) float64
            px; NaN behind the camera.
        """
        camera = self.camera
        centre = np.array([camera.cx_px, camera.cy_px])
        flat = camera.project(direction_camera) - centre
        square = (flat[:, 0] / camera.fx_px) ** 2 + (flat[:, 1] / camera.fy_px) ** 2
        # A bend that turns back on itself far outside the image would bring stars back in.
        square = np.minimum(square, 1.5 * np.tan(camera.reach_rad) ** 2)
        xy = centre + flat * (1 + self.k1 * square)[:, np.newaxis]
        if self.mirrored:
            xy[:, 0] = camera.width_px - 1 - xy[:, 0]
        return np.asarray(xy)

    def stars_on_image(self, reference: ReferenceStars) -> tuple[Index, Float]:
        """Return the stars that fall on the image and where.

        Parameters
        ----------
        reference : ReferenceStars

        Returns
        -------
        index : (k,) intp
            Into `reference.stars`, the brightest first.
        xy_px : (k, 2) float64
        """
        xy = self.project(reference.to_camera(self.C_camera_eq))
        on_image = np.flatnonzero(self.camera.contains(xy))
        return on_image, xy[on_image]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Stars of the catalogue found on an image.

    Attributes
    ----------
    solution : PlateSolution
        Refined on them.
    star : (k,) intp
        Into the stars of the reference, the brightest first.
    detection : (k,) intp
        Into the detected stars.
    residual_px : (k, 2) float64
        Detected minus predicted.
    predicted : (m,) intp
        All stars of the reference that fall on the image.
    predicted_xy_px : (m, 2) float64
        Where.
    chance : float
        How often as many would have met by chance, all solutions tried counted.
    false_alarm : float
        The same for the stars beyond those that a solution is found through, with the density of detections measured
        where the stars are, all solutions tried counted: the probability that a wrong solution matches as many.
    needed : int
        With as many matches the false-alarm probability is small enough; 0 where it was not computed.
    expected_by_chance : float
        How many of the matches are expected to be false: other detections that happen to lie near the star.
    notes : tuple of str
        What a person should know: a mirrored image, an attitude far off.
    standard_error : dict of str to float
        Of ``fx_px``, ``cx_px``, ``cy_px`` and the lens's coefficients, those that were fitted.
    """

    solution: PlateSolution
    star: Index
    detection: Index
    residual_px: Float
    predicted: Index
    predicted_xy_px: Float
    chance: float
    false_alarm: float = 1.0
    needed: int = 0
    expected_by_chance: float = 0.0
    notes: tuple[str, ...] = ()
    standard_error: dict[str, float] = dataclass_field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.star)

    @property
    def rms_px(self) -> float:
        """Root mean square distance between detected and predicted, px."""
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean()))


@dataclass(frozen=True, slots=True)
class Label:
    """A star that somebody pointed at.

    Attributes
    ----------
    x_px, y_px : float
        About where it is.
    hr : int
        Its number in the catalogue.
    """

    x_px: float
    y_px: float
    hr: int


def identify_by_labels(
    detected: DetectedStars, reference: ReferenceStars, labels: Sequence[Label], camera: Camera, *, focal_known: bool
) -> Matches:
    """Identify stars from a few that somebody named.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    labels : sequence of Label
        Three at the least.
    camera : Camera
        Its size and, if `focal_known`, its focal length.
    focal_known : bool
        Whether the camera's focal length is about right; otherwise it is found.

    Returns
    -------
    Matches

    Raises
    ------
    CalibrationError
        If there are too few labels, if they contradict each other, or name stars that the catalogue has not.
    """
    if len(labels) < _LABELS_NEEDED:
        words = f"{len(labels)} labels were given and {_LABELS_NEEDED} are needed to know where the camera looked"
        raise CalibrationError(words, stars_used=len(labels), stars_needed=_LABELS_NEEDED)
    number_to_star = {int(hr): k for k, hr in enumerate(reference.stars.hr)}
    missing = [label.hr for label in labels if label.hr not in number_to_star]
    if missing:
        words = f"the labels name HR {', '.join(map(str, missing[:5]))}, which the catalogue has not within its limit"
        raise CalibrationError(words, stars_used=len(labels) - len(missing), stars_needed=_LABELS_NEEDED)
    star = np.array([number_to_star[label.hr] for label in labels])
    xy = np.array([[label.x_px, label.y_px] for label in labels])
    if len(detected):
        distance_px, nearest = KDTree(detected.xy_px).query(xy)
        xy = np.where((distance_px < _LABEL_PX)[:, np.newaxis], detected.xy_px[nearest], xy)
    direction = reference.stars.direction_eq[star]
    focals = [camera.fx_px] if focal_known else list(camera.width_px / 2 / np.tan(_FOVS_TRIED_RAD / 2))
    solutions = [_through(xy, direction, camera, f, mirrored=mirrored) for f in focals for mirrored in (False, True)]
    off_px = [np.median(np.linalg.norm(f.project(direction @ f.C_camera_eq.T) - xy, axis=1)) for f in solutions]
    guess = solutions[int(np.nanargmin(off_px))]
    matches = refine(detected, reference, guess)
    if matches is None or not is_significant(matches):
        raise CalibrationError(
            f"the labels do not fit together: with the best attitude half of them are {min(off_px):.1f} px off, and"
            f" {0 if matches is None else len(matches)} stars of the catalogue meet the {len(detected)}"
            f" found{detected.quality_note};"
            " check numbers and places, x to the right and y down from the top-left pixel",
            stars_used=0 if matches is None else len(matches),
            stars_needed=MIN_STARS,
        )
    given = {(int(reference.stars.hr[s])) for s in matches.star}
    lost = [label.hr for label in labels if label.hr not in given]
    notes = orientation_notes(0, matches.solution.mirrored) + (
        (f"no star was found where the labels put HR {', '.join(map(str, lost))}",) if lost else ()
    )
    return replace(matches, notes=notes)


def require_significant(detected: DetectedStars, matches: Matches | None) -> Matches:
    """Return matches that can be no accident, with what a person should know of them.

    Parameters
    ----------
    detected : DetectedStars
    matches : Matches or None

    Returns
    -------
    Matches

    Raises
    ------
    CalibrationError
        If what meets may have met by chance, or the bright stars are not among it.
    """
    if matches is None or not is_significant(matches):
        met = 0 if matches is None else len(matches)
        needed = max(MIN_STARS, 0 if matches is None else matches.needed)
        words = (
            f"of {len(detected)} stars found{detected.quality_note} {met} agree with the catalogue, and to be sure that"
            f" this is no accident {needed} are needed; take a sharper image of a darker sky, or give time, place and"
            " attitude, or --labels"
        )
        raise CalibrationError(words, stars_used=met, stars_needed=needed)
    return replace(matches, notes=orientation_notes(0, matches.solution.mirrored))


def wide_angle_cameras(camera: Camera) -> tuple[Camera, ...]:
    """Return cameras as wide as a pinhole, left to right, with lenses that wide views have.

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    tuple of Camera
        None for a camera that has its lens, and none for a narrow view.  Of a view wider than any pinhole's also those
        whose image circle fits the shorter side of the image.
    """
    tangent = camera.width_px / 2 / camera.fx_px
    if camera.lens is not None or 2 * np.arctan(tangent) < _WIDE_RAD:
        return ()
    sides_px = [camera.width_px]
    if exceeds_pinhole(camera) and camera.height_px < camera.width_px:
        sides_px.append(camera.height_px)
    wide = []
    for side_px, lens in itertools.product(sides_px, _WIDE_LENSES):
        f_px = side_px / 2 / float(lens.distort([tangent, 0.0])[0])
        wide.append(replace(camera, fx_px=f_px, fy_px=f_px * camera.fy_px / camera.fx_px, lens=lens))
    return tuple(wide)


def exceeds_pinhole(camera: Camera) -> bool:
    """Return whether a camera without a lens is as wide, left to right, as only a fisheye can be."""
    return camera.lens is None and 2 * np.arctan(camera.width_px / 2 / camera.fx_px) > _WIDEST_PINHOLE_RAD


def is_significant(matches: Matches) -> bool:
    """Return whether the solution can be no accident.

    Parameters
    ----------
    matches : Matches

    Returns
    -------
    bool
    """
    if len(matches) < MIN_STARS:
        return False
    # Of the predicted ones as many of the brightest as stars were matched: most of them must be there, ...
    bright = matches.predicted[: len(matches)]
    if matches.chance <= _CHANCE and np.isin(bright, matches.star).mean() >= _LEAST_SHARE:
        return True
    # ... unless part of the view is hidden; then the others must be all the more.
    return matches.false_alarm <= _FALSE_ALARM


def orientation_notes(turned_rad: float, mirrored: bool) -> tuple[str, ...]:
    """Return what to say of an image that is held another way than was said.

    Parameters
    ----------
    turned_rad : float
        By how much it is turned, rad; 0 for upright.
    mirrored : bool

    Returns
    -------
    tuple of str
        Nothing for one that is held as was said.
    """
    notes = []
    if mirrored:
        notes.append("the image is mirrored: left and right are exchanged")
    if turned_rad:
        notes.append(f"the image is turned by {np.rad2deg(turned_rad):.0f} deg against what attitude and mount say")
    return tuple(notes)


def refine(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution) -> Matches | None:
    """Match and refine a solution that is right to a hundredth of the image's width, within shrinking radii.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    solution : PlateSolution

    Returns
    -------
    Matches or None
        None if fewer than three stars meet, or all may have met by chance.
    """
    radius_px = max(_FIRST_RADIUS * solution.camera.width_px, 3 * _LEAST_RADIUS_PX)
    for round_ in range(_ROUNDS):
        matches = match(detected, reference, solution, radius_px)
        if len(matches) < 3 or (round_ >= _FIRST_ROUNDS and matches.chance >= 1):
            return None
        solution = _refined(detected, reference, matches, _FIRST_STEPS if round_ < _FIRST_ROUNDS else None)
        far_px = float(np.quantile(np.linalg.norm(_residuals(detected, reference, solution, matches), axis=1), 0.9))
        radius_px = max(min(_LAST_RADIUS * far_px, 0.8 * radius_px), _LEAST_RADIUS_PX)
    return match(detected, reference, solution, radius_px, deep=True)


def match(
    detected: DetectedStars,
    reference: ReferenceStars,
    solution: PlateSolution,
    radius_px: float,
    *,
    deep: bool = False,
    within_px: float = np.inf,
) -> Matches:
    """Return predictions and detections that are each other's nearest within a circle.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    solution : PlateSolution
    radius_px : float
        Of the circle.
    deep : bool
        Whether to try as many detections as can be without a false one to be expected; else the brightest, about as
        many as stars are predicted.
    within_px : float
        Farther from the principal point nothing is looked at.

    Returns
    -------
    Matches
    """
    predicted, xy = solution.stars_on_image(reference)
    centre = solution.project(np.array([[0.0, 0.0, 1.0]]))
    near = np.linalg.norm(xy - centre, axis=1) < within_px
    predicted, xy = predicted[near], xy[near]
    tried = np.flatnonzero(np.linalg.norm(detected.xy_px - centre, axis=1) < within_px)
    area_px2 = min(solution.camera.width_px * solution.camera.height_px, np.pi * within_px**2)
    stars, count = _tried(len(predicted), len(tried), radius_px, area_px2)
    if deep:
        stars = len(predicted)
        sparse = int(_FALSE_STARS / max(chance_pairs(stars, 1, radius_px, area_px2), 1e-12))
        count = min(len(tried), max(round(_DETECTIONS_A_STAR * stars) + _DETECTIONS_MORE, sparse))
    tried = tried[:count]
    bright, near_xy = detected.xy_px[tried], xy[:stars]
    if not stars or not count:
        return Matches(solution, _none(), _none(), np.empty((0, 2)), predicted, xy, 1.0)
    detection, distance_px = mutual_nearest(near_xy, bright, detected.psf_sigma_px)
    # The centre of a saturated star is less certain.
    softer = np.where(deep & detected.saturated[tried[detection]], _BURNT_RADIUS, 1.0)
    met = distance_px < radius_px * softer
    by_chance = 1 - (1 - min(np.pi * radius_px**2 / area_px2, 1.0)) ** count
    chance = float(min(1.0, _FIELDS_TRIED * bdtrc(int(met.sum()) - 1, stars, by_chance)))
    expected, false_alarm, needed = 0.0, 1.0, 0
    if deep:
        nearby = max(by_chance, _chance_nearby(bright, near_xy, radius_px))
        false_alarm, needed = _false_alarm(met, nearby)
        offset = bright[detection] - near_xy
        probability = offset_probability(offset, met, softer, count / area_px2, radius_px)
        met = significant(probability)
        expected = float((1 - probability[met]).sum())
    pairs = np.flatnonzero(met)
    return Matches(
        solution,
        predicted[pairs],
        tried[detection[pairs]],
        bright[detection[pairs]] - xy[pairs],
        predicted,
        xy,
        chance,
        false_alarm,
        needed,
        expected,
    )


def mutual_nearest(star_xy: Float, detection_xy: Float, psf_sigma_px: float) -> tuple[Index, Float]:
    """Return predicted and detected stars that are each other's nearest.

    Parameters
    ----------
    star_xy : (n, 2) float64
        Predicted positions, the brightest star first.
    detection_xy : (m, 2) float64
        m >= 1.
    psf_sigma_px : float
        Stars nearer to each other than this, and than a pixel, are one on the image: the brightest of them counts.

    Returns
    -------
    detection : (n,) intp
        The detection nearest to each star.
    distance_px : (n,) float64
        How far it is; infinite where another star has it.
    """
    distance_px, detection = KDTree(detection_xy).query(star_xy)
    count = min(_ONE_OF, len(star_xy))
    neighbour_px, star = KDTree(star_xy).query(detection_xy, k=np.arange(1, count + 1))
    one_px = max(psf_sigma_px, _ONE_PX)
    alike = np.linalg.norm(star_xy[star] - star_xy[star[:, :1]], axis=2) <= one_px
    owner = np.where(alike & np.isfinite(neighbour_px), star, len(star_xy)).min(axis=1)
    return detection, np.where(owner[detection] == np.arange(len(star_xy)), distance_px, np.inf)


def offset_probability(offset_px: Float, met: Mask, softer: Float, density_per_px2: float, radius_px: float) -> Float:
    """Return the probability that each match is real, with the scatter that the matches themselves show.

    Parameters
    ----------
    offset_px : (n, 2) float64
        Detected minus predicted, the brightest star of the catalogue first.
    met : (n,) bool
        Whether the star has a match.
    softer : (n,) float64
        How many times as uncertain as that of others a star's position is.
    density_per_px2 : float
        Detections per square pixel.
    radius_px : float
        Within this distance matches were accepted.

    Returns
    -------
    (n,) float64
        0 for stars without a match.
    """
    separation_px = np.where(met, np.linalg.norm(offset_px, axis=1), np.inf)
    probability = met.astype(np.float64)
    # Chance matches widen the scatter; without them it is that of the real ones.
    for _ in range(_SCATTER_ROUNDS):
        real = probability > 0.5
        if not real.any():
            break
        scatter_px = max(robust_std(offset_px[real] / softer[real, np.newaxis]), _LEAST_SCATTER_PX)
        probability = match_probability(separation_px, scatter_px * softer, density_per_px2, radius_px)
    return probability


def _chance_nearby(detection_xy: Float, star_xy: Float, radius_px: float) -> float:
    """Return how often a detection lies within a radius of a place near to a star: of stars shifted to and fro."""
    angle = np.arange(_SHIFTS) * np.pi * (3 - np.sqrt(5))
    length_px = radius_px * np.linspace(*_SHIFT_RADII, _SHIFTS)
    shift = np.column_stack([np.cos(angle), np.sin(angle)]) * length_px[:, np.newaxis]
    shifted = (star_xy[np.newaxis] + shift[:, np.newaxis]).reshape(-1, 2)
    return float((KDTree(detection_xy).query(shifted)[0] < radius_px).mean())


def _false_alarm(met: Mask, nearby: float) -> tuple[float, int]:
    """Return how probable as many matches are in a wrong solution, and how many would be improbable enough.

    Of all the stars, or of the brightest 10, 20, 40 and so on, whichever is the least probable: a hazy image shows no
    faint ones.  All solutions and all these choices are counted.
    """
    stars = len(met)
    choices = [*(_FEWEST_BRIGHTEST * 2 ** np.arange(20)), stars]
    choices = sorted({int(count) for count in choices if count <= stars})
    best, needed = 1.0, stars + 1
    for count in choices:
        matched = int(met[:count].sum())
        number = np.arange(count + 1)
        beyond, others = number - _STARS_OF_A_PATTERN, max(count - _STARS_OF_A_PATTERN, 1)
        tail = np.where(beyond < 1, 1.0, bdtrc(np.clip(beyond - 1, 0, others - 1), others, nearby))
        alarm = np.minimum(1.0, _FIELDS_TRIED * len(choices) * tail)
        if alarm[matched] <= best:
            enough = np.flatnonzero(alarm <= _FALSE_ALARM)
            best = float(alarm[matched])
            needed = int(met.sum()) - matched + (int(enough[0]) if enough.size else count + 1)
    return best, needed


def _tried(stars: int, detections: int, radius_px: float, area_px2: float) -> tuple[int, int]:
    """Return how many of the brightest predicted and detected stars to match, without too many pairs by chance."""
    most = _FALSE_STARS / chance_pairs(1, 1, radius_px, area_px2)
    # The positive root of k (1.5 k + 10) = most.
    few = (np.sqrt(_DETECTIONS_MORE**2 + 4 * _DETECTIONS_A_STAR * most) - _DETECTIONS_MORE) / (2 * _DETECTIONS_A_STAR)
    stars = min(stars, max(int(few), _FEWEST_TRIED))
    return stars, min(detections, round(_DETECTIONS_A_STAR * stars) + _DETECTIONS_MORE)


def _none() -> Index:
    return np.empty(0, dtype=np.intp)


def _residuals(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution, matches: Matches) -> Float:
    placed = solution.project(reference.to_camera(solution.C_camera_eq)[matches.star])
    return np.asarray(detected.xy_px[matches.detection] - placed)


def _refined(detected: DetectedStars, reference: ReferenceStars, matches: Matches, steps: int | None) -> PlateSolution:
    """Return the solution that brings matched stars nearest to where they were found; outliers pull little.

    In so many steps at the most, for the next round goes on from there.
    """
    start, xy = matches.solution, detected.xy_px[matches.detection]
    apparent = reference.to_camera(np.eye(3))[matches.star]
    typical_px = max(robust_std(matches.residual_px), 0.02)
    first = start.prior_camera or start.camera

    def fit(free: int, solution: PlateSolution) -> Minimum[PlateSolution]:
        return minimise(
            replace(solution, prior_camera=first),
            lambda solution: _residuals_and_jacobian(solution, apparent, xy, typical_px, free),
            _stepped,
            scale=typical_px,
            most_steps=_MOST_STEPS if steps is None else steps,
        )

    bent, straight = fit(7, start), _straightened(start, first)
    # The lens is as it was given unless the stars clearly say otherwise (Bayes' information criterion, and some): in a
    # narrow view its middle and the attitude can hardly be told apart.
    plain, count = fit(4, straight), 2 * len(xy)
    if count * np.log(plain.cost / max(bent.cost, 1e-12)) < 3 * np.log(count) + _CLEARLY:
        return plain.state
    return bent.state


def _stepped(solution: PlateSolution, step: Float) -> PlateSolution:
    """Return the solution a step (4 or 7,) away: rotation, ln f, principal point over the width, k1."""
    turn, (longer, right, down, bend) = step[:3], np.append(step[3:], np.zeros(7 - len(step)))
    camera = solution.camera
    lens = replace(
        camera,
        fx_px=float(camera.fx_px * np.exp(longer)),
        fy_px=float(camera.fy_px * np.exp(longer)),
        cx_px=camera.cx_px + float(right) * camera.width_px,
        cy_px=camera.cy_px + float(down) * camera.width_px,
    )
    C = matrix_from_quaternion(quaternion_from_turn(turn)) @ solution.C_camera_eq
    return replace(solution, camera=lens, C_camera_eq=C, k1=solution.k1 + float(bend))


def _residuals_and_jacobian(
    solution: PlateSolution, apparent: Float, xy_px: Float, typical_px: float, free: int
) -> tuple[Float, Float]:
    """Return how far stars are off, and the lens from what was thought of it; with slopes by a step."""
    camera, first, width_px = solution.camera, solution.prior_camera or solution.camera, solution.camera.width_px
    direction = apparent @ solution.C_camera_eq.T
    off = solution.project(direction) - xy_px
    bent, _, by_turn = projection_jacobian(camera, direction)
    focal = np.array([camera.fx_px, camera.fy_px])
    flat = bent @ camera.K[:2, :2].T
    share = flat / focal
    square = (share**2).sum(axis=1)[:, np.newaxis]
    # What the bend does to a place on the image, (n, 2, 2), and to a step in focal length, for the square stays.
    bends = (1 + solution.k1 * square)[..., np.newaxis] * np.eye(2)
    bends = bends + 2 * solution.k1 * flat[:, :, np.newaxis] * (share / focal)[:, np.newaxis, :]
    slopes = np.zeros((len(off), 2, 7))
    slopes[:, :, :3] = bends @ by_turn
    slopes[:, :, 3] = flat * (1 + solution.k1 * square)
    slopes[:, :, 4:6] = width_px * np.eye(2)
    slopes[:, :, 6] = flat * square
    if solution.mirrored:
        slopes[:, 0] *= -1
    slopes[~np.isfinite(slopes).all(axis=(1, 2)) | ~np.isfinite(off).all(axis=1)] = 0.0
    thought = np.array(
        [
            np.log(camera.fx_px / first.fx_px) / _FOCAL_SD,
            (camera.cx_px - first.cx_px) / (_MIDDLE_SD * width_px),
            (camera.cy_px - first.cy_px) / (_MIDDLE_SD * width_px),
            solution.k1 / _BEND_SD,
        ]
    )
    sure = np.hstack([np.zeros((4, 3)), np.diag([1 / _FOCAL_SD, 1 / _MIDDLE_SD, 1 / _MIDDLE_SD, 1 / _BEND_SD])])
    residual = np.concatenate([np.nan_to_num(off, nan=1e3).ravel(), typical_px * thought])
    return residual, np.concatenate([slopes.reshape(-1, 7), typical_px * sure])[:, :free]


def _straightened(solution: PlateSolution, first: Camera) -> PlateSolution:
    """Return the solution with the principal point of the first camera and no bend, stars near the middle unmoved."""
    lens = solution.camera
    right_px, down_px = lens.cx_px - first.cx_px, lens.cy_px - first.cy_px
    aside_rad = np.array([np.arctan(down_px / lens.fy_px), -np.arctan(right_px / lens.fx_px), 0.0])
    C = matrix_from_quaternion(quaternion_from_turn(aside_rad)) @ solution.C_camera_eq
    return PlateSolution(replace(lens, cx_px=first.cx_px, cy_px=first.cy_px), C, solution.mirrored, 0.0, first)


def _through(xy: Float, direction_eq: Float, camera: Camera, f_px: float, *, mirrored: bool) -> PlateSolution:
    """Return the attitude that turns directions nearest to the rays of pixels (Wahba's problem, by SVD)."""
    lens = replace(camera, fx_px=f_px, fy_px=f_px * camera.fy_px / camera.fx_px)
    x = camera.width_px - 1 - xy[:, 0] if mirrored else xy[:, 0]
    rays = lens.unproject(np.column_stack([x, xy[:, 1]]))
    rays = rays[seen := np.isfinite(rays).all(axis=1)]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(rays.T @ direction_eq[seen])
    return PlateSolution(lens, U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt, mirrored)
