"""Plate solutions: the camera and the attitude that map the sky to an image.

Also the catalogue stars that an image may show, over a site or without one, and the sidereal motion of stars over the
image of a camera at rest.  Matches of stars with detections are tested for whether chance could explain them.
"""

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from glstar.arrays import Float, Index
from glstar.calibrate.identify.rollingshutter import ReadoutTime, RowTurns
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.detection import DetectedStars
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.render.motion.pointing import Pointing
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.stars import SIDEREAL_RAD_PER_S, Sky
from glstar.sky.place.horizon import diurnal_aberration_rad
from glstar.sky.place.site import Site

# Refraction at the zenith of standard air: 58.3 arcsec for each radian of zenith distance, as a fraction.
ZENITH_REFRACTION = 2.8e-4
# What refraction does to the focal length and to the principal point, along x and along y, over its effect on the focal
# length at the zenith: root mean squares over the sky 30 deg or more above the horizon.
_UNKNOWN_REFRACTION = (1.55, 1.97)


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceStars:
    """Catalogue stars with the refraction and the aberration that act on their directions."""

    stars: StarField  # The brightest first
    # (3,) the direction of the zenith, and the observer's velocity over the speed of light; zeros if the site is
    # unknown; the zenith may be known from the refraction of the photograph alone; see
    # `glstar.calibrate.geometry.zenith`.
    zenith_eq: Float
    velocity_eq: Float
    refraction_scale: float  # The result of `glstar.sky.air.refraction.refraction_scale`; 0 if the site is unknown
    # (3, 3) or None: rotation from the true equator and equinox of date to north, east, down; None if site or time is
    # unknown.
    C_ned_eq: Float | None
    # How the aircraft turned while a rolling shutter read the image; None if one attitude holds for all rows.
    rows: RowTurns | None = None
    # Standard error of a zenith from refraction, rad; None if time and site state it, or if it is unknown.
    zenith_error_rad: float | None = None

    @staticmethod
    def over(sky: Sky, utc_s: float, site: Site) -> "ReferenceStars":
        """Return the stars over a site at a time; `utc_s`: UTC seconds since 1970."""
        C = sky.C_ned_eq([utc_s], [site.latitude_rad], [site.longitude_rad])[0]
        speed = diurnal_aberration_rad(site.latitude_rad, site.height_m)
        return ReferenceStars(sky.star_field(utc_s), -C[2], speed * C[1], sky.refraction_scale(site), C)

    @staticmethod
    def anywhere(sky: Sky, utc_s: float) -> "ReferenceStars":
        """Return the stars of the whole sphere, without a horizon and without refraction.

        `utc_s`: UTC seconds since 1970, for proper motion; an error of a few years is negligible.
        """
        return ReferenceStars(sky.star_field(utc_s), np.zeros(3), np.zeros(3), 0.0, None)

    def refraction_error(self, axis_eq: Float) -> tuple[float, float]:
        """Return the standard errors that unknown refraction gives a camera: 0 if site and time are known.

        `axis_eq` (3,): its optical axis.  Returns the errors of the focal length, and of the principal point along x
        and along y, each over the focal length.  At the zenith distance z refraction is S tan z.  It brings stars
        together by S along the horizon and by S / cos^2 z towards the zenith.  A camera takes that as a focal length
        shorter by S (1 + 1 / cos^2 z) / 2; the next derivative moves its principal point by S tan z / cos^2 z.
        """
        if self.C_ned_eq is not None:
            return 0.0, 0.0
        if self.zenith_error_rad is None:
            of_focal, of_point = _UNKNOWN_REFRACTION
            return of_focal * ZENITH_REFRACTION, of_point * ZENITH_REFRACTION
        cosine = max(float(axis_eq @ self.zenith_eq), 0.2)
        tangent, secant2 = np.sqrt(1 / cosine**2 - 1), 1 / cosine**2
        error = ZENITH_REFRACTION * self.refraction_scale * self.zenith_error_rad
        return float(error * tangent * secant2), float(error * secant2 * (secant2 + 2 * tangent**2 + tangent))

    def to_camera(self, C_camera_eq: Float) -> Float:
        """Return the apparent directions in the camera frame.

        `C_camera_eq` (3, 3): rotation from the true equator and equinox of date to the camera frame.  Returns (n, 3)
        NaN below the horizon.
        """
        pointing = Pointing(
            C_camera_eq[np.newaxis], self.zenith_eq[np.newaxis], self.velocity_eq[np.newaxis], self.refraction_scale
        )
        return np.asarray(pointing.to_camera(self.stars.direction_eq)[0])

    def recorded(self, C_camera_eq: Float, star: Index, xy_px: Float, camera: Camera) -> Float:
        """Return the directions of stars on an image in the camera frame, with a rolling shutter each in its own row.

        `C_camera_eq` (3, 3): as for `to_camera`; with a rolling shutter in the middle of the exposure of the middle
        row; `star` (k,) intp: indices of the stars; `xy_px` (k, 2): where they are on the image as it was recorded, px;
        `camera`: of the size of the image.  Returns (k, 3): NaN below the horizon.
        """
        if self.rows is None:
            return np.asarray(self.to_camera(C_camera_eq)[star])
        return np.asarray(self.rows.turned(self.to_camera(np.eye(3))[star], xy_px, camera) @ C_camera_eq.T)


# Lenses to try for wide fields of view with an unknown lens.  Most wide-angle lenses are nearly equidistant (the
# distance from the principal point is proportional to the angle from the axis), whatever their calibrated model.
_EQUIDISTANT = Lens("fisheye", ())
_WIDE_LENSES = (_EQUIDISTANT, Lens("fisheye", (1 / 6,)))
# Smallest horizontal field of view that counts as wide.
_WIDE_RAD = np.deg2rad(35.0)
# Largest horizontal field of view of a pinhole; wider ones need a fisheye.
_WIDEST_PINHOLE_RAD = np.deg2rad(140.5)
# Within this angle of the axis each lens of `_WIDE_LENSES` is right to 1 %.
CENTRAL_RADIUS_RAD = np.deg2rad(20.0)


@dataclass(frozen=True, slots=True, eq=False)
class PlateSolution:
    """The camera and the attitude that map the sky to an image."""

    camera: Camera
    C_camera_eq: Float  # (3, 3) rotation from the true equator and equinox of date to the camera frame
    mirrored: bool = False  # Whether left and right are exchanged on the image
    k1: float = 0.0  # Radial distortion of the lowest order in addition to the camera's lens, as OpenCV's k1
    # The camera before refinement, if there was one: parameters that the stars do not determine stay at its values.
    prior_camera: Camera | None = None

    def project(self, direction_camera: Float) -> Float:
        """Return the pixel positions of directions in the camera frame.

        `direction_camera` (n, 3).  Returns (n, 2) px; NaN behind the camera.
        """
        camera = self.camera
        centre = np.array([camera.cx_px, camera.cy_px])
        undistorted = camera.project(direction_camera) - centre
        square = (undistorted[:, 0] / camera.fx_px) ** 2 + (undistorted[:, 1] / camera.fy_px) ** 2
        # Beyond the image a negative k1 would turn back and bring stars from outside into the image.
        corners = camera.normalized(
            [(x, y) for x in (-0.5, camera.width_px - 0.5) for y in (-0.5, camera.height_px - 0.5)]
        )
        square = np.minimum(square, 1.5 * (corners**2).sum(axis=1).max())
        xy = centre + undistorted * (1 + self.k1 * square)[:, np.newaxis]
        if self.mirrored:
            xy[:, 0] = camera.width_px - 1 - xy[:, 0]
        return np.asarray(xy)

    def predicted(self, reference: ReferenceStars) -> Float:
        """Return where catalogue stars are on the image, of a rolling shutter each in its own row.

        Returns (n, 2) px; NaN behind the camera and below the horizon.
        """
        if reference.rows is None:
            return self.project(reference.to_camera(self.C_camera_eq))
        return self.placed(reference.to_camera(np.eye(3)), reference.rows)

    def placed(self, apparent: Float, rows: RowTurns | None) -> Float:
        """Return where apparent directions are on the image, of a rolling shutter each in its own row.

        `apparent` (n, 3): true equator and equinox of date.  Returns (n, 2) px; NaN behind the camera.
        """

        def project(apparent: Float) -> Float:
            return self.project(apparent @ self.C_camera_eq.T)

        return project(apparent) if rows is None else rows.positions(project, apparent, self.camera)

    def stars_on_image(self, reference: ReferenceStars) -> tuple[Index, Float]:
        """Return the catalogue stars predicted on the image.

        Returns `index` (k,) intp: into `reference.stars`, the brightest first; `xy_px` (k, 2): predicted positions, px.
        """
        xy = self.predicted(reference)
        on_image = np.flatnonzero(self.camera.contains(xy))
        return on_image, xy[on_image]


def nominal_camera(width_px: int, height_px: int, fov_rad: float) -> Camera:
    """Return a camera of a horizontal field of view: a pinhole, or an equidistant fisheye where that is too wide."""
    lens = None if fov_rad <= _WIDEST_PINHOLE_RAD else _EQUIDISTANT
    f_px = width_px / 2 / float(np.tan(fov_rad / 2) if lens is None else lens.radius(fov_rad / 2))
    return Camera(width_px, height_px, f_px, f_px, (width_px - 1) / 2, (height_px - 1) / 2, lens=lens)


def wide_angle_cameras(camera: Camera) -> tuple[Camera, ...]:
    """Return cameras with typical wide-angle lenses and the horizontal field of view of a nominal camera.

    There are none for a camera with a known lens and for a narrow field of view.  For a field too wide for a pinhole,
    the image circle of some fits the shorter side of the image.
    """
    half_rad = camera.horizontal_field_rad / 2
    if camera.lens not in {None, _EQUIDISTANT} or 2 * half_rad < _WIDE_RAD:
        return ()
    sides_px = [camera.width_px]
    if exceeds_pinhole(camera) and camera.height_px < camera.width_px:
        sides_px.append(camera.height_px)
    wide = []
    for side_px, lens in itertools.product(sides_px, _WIDE_LENSES):
        f_px = side_px / 2 / float(lens.radius(half_rad))
        wide.append(replace(camera, fx_px=f_px, fy_px=f_px * camera.fy_px / camera.fx_px, lens=lens))
    return tuple(wide)


def exceeds_pinhole(camera: Camera) -> bool:
    """Return whether the horizontal field of view of a nominal camera needs a fisheye."""
    return camera.lens in {None, _EQUIDISTANT} and camera.horizontal_field_rad > _WIDEST_PINHOLE_RAD


def sidereal_trails(solution: PlateSolution, xy_px: Float, exposure_s: float) -> Float:
    """Return the sidereal motion of stars over the image of a camera at rest on the ground.

    `solution`: the camera and attitude at mid-exposure; `xy_px` (n, 2): positions at mid-exposure.  Returns (n, 2) from
    the start of each trail to its end, px; zeros outside the lens's domain.
    """
    camera = solution.camera
    x = camera.width_px - 1 - xy_px[:, 0] if solution.mirrored else xy_px[:, 0]
    rays = camera.unit_vectors(np.column_stack([x, xy_px[:, 1]]))
    pole = solution.C_camera_eq[:, 2]
    half = SIDEREAL_RAD_PER_S * exposure_s / 2
    # Stars move from east to west, against the sense of right ascension.
    before, after = (matrix_from_quaternion(quaternion_from_turn(sign * half * pole)) for sign in (-1.0, 1.0))
    return np.nan_to_num(solution.project(rays @ after.T) - solution.project(rays @ before.T))


# A plate solution needs at least this number of matches.
MIN_STARS = 4


@dataclass(frozen=True, slots=True)
class _Significance:
    """Limits for accepting a plate solution."""

    # Expected number of wrong solutions with as many matches, over all solutions tried ...
    chance: float = 1e-9
    # ... if this fraction of the brightest predicted stars is matched as well.
    matched_fraction: float = 0.5
    # If a roof, a cloud or a lamp hides bright stars, a solution is accepted below this false-alarm probability.
    false_alarm: float = 1e-12


SIGNIFICANCE = _Significance()


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Catalogue stars matched with detections."""

    solution: PlateSolution  # Refined on these matches
    star: Index  # (k,) intp: indices into the reference stars, the brightest first
    detection: Index  # (k,) intp: indices into the detected stars
    residual_px: Float  # (k, 2) detected minus predicted position, px
    predicted: Index  # (m,) intp: all reference stars predicted on the image
    predicted_xy_px: Float  # (m, 2) their predicted positions, px
    chance: float  # Expected number of wrong solutions with as many matches, over all solutions tried
    # Probability that any wrong solution matches as many stars, besides those of its pattern; from the density of
    # detections around the stars.
    false_alarm: float = 1.0
    needed: int = 0  # Number of matches at which the false-alarm probability is small enough; 0 if it was not computed
    expected_by_chance: float = 0.0  # Expected number of false matches, which are unrelated detections near a star
    notes: tuple[Note, ...] = ()  # Remarks for the user: a mirrored image, an attitude far off
    # Standard errors of ``fx_px``, ``cx_px``, ``cy_px`` and the lens's coefficients, of those that were fitted.
    standard_error: dict[str, float] = field(default_factory=dict)
    readout: ReadoutTime | None = None  # The readout time of a rolling shutter, if it was fitted

    def __len__(self) -> int:
        return len(self.star)

    @property
    def rms_px(self) -> float:
        """Root mean square distance between detected and predicted positions, px."""
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean()))


def is_significant(matches: Matches) -> bool:
    """Return whether chance cannot explain the matches."""
    if len(matches) < MIN_STARS:
        return False
    # Among as many of the brightest predicted stars as were matched, most must be matched, ...
    bright = matches.predicted[: len(matches)]
    if matches.chance <= SIGNIFICANCE.chance and np.isin(bright, matches.star).mean() >= SIGNIFICANCE.matched_fraction:
        return True
    # ... unless part of the view is hidden; then the false-alarm probability must be lower.
    return matches.false_alarm <= SIGNIFICANCE.false_alarm


def require_significant(detected: DetectedStars, matches: Matches | None) -> Matches:
    """Return the matches with notes on the image's orientation, if chance cannot explain them.

    Raises CalibrationError if chance may explain the matches, or if bright stars are missing among them.
    """
    if matches is None or not is_significant(matches):
        matched = 0 if matches is None else len(matches)
        needed = max(MIN_STARS, 0 if matches is None else matches.needed)
        message = (
            f"{len(detected)} stars were found{detected.quality_note}, {matched} agree with the catalogue, and {needed}"
            " are needed to rule out chance; take a sharper image of a darker sky, or give time, site and attitude, or"
            " --labels"
        )
        raise CalibrationError(message, stars_used=matched, stars_needed=needed)
    return replace(matches, notes=orientation_notes(0, matches.solution.mirrored))


def orientation_notes(turned_rad: float, mirrored: bool) -> tuple[Note, ...]:
    """Return notes for the user on an image that is turned or mirrored.

    `turned_rad`: rotation against the given attitude and mount, rad.
    """
    texts = []
    if mirrored:
        texts.append("the image is mirrored: left and right are exchanged")
    if turned_rad:
        texts.append(f"the image is turned by {np.rad2deg(turned_rad):.0f} deg against the given attitude and mount")
    return tuple(Note(NoteKind.IDENTIFICATION, text) for text in texts)
