"""The least-squares fit of a camera, and of its attitude in each of its images, to identified stars.

The Jacobian is analytic.  Rotations are composed step by step, so that no parametrisation of the attitude is needed.
"""

from dataclasses import dataclass, replace

import numpy as np

from glstar.arrays import Float, Index
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.identify.rollingshutter import RowTurns
from glstar.calibrate.minimise import Minimum, minimise
from glstar.calibrate.photo.detection import DetectedStars
from glstar.camera.distortion import COEFFICIENTS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn


def projection_jacobian(camera: Camera, direction_camera: Float) -> tuple[Float, Float]:
    """Return distorted positions of directions (n, 3) in the camera frame, and their derivatives.

    The positions (n, 2) are those in the normalized image plane, which the camera matrix maps to pixels.  The
    derivatives of pixels are those by the rotation vector of `glstar.rotation.quaternion_from_turn`, px/rad (n, 2, 3).
    """
    xy, by_turn = camera.project_with_rates(direction_camera, _turned_about_axes(direction_camera))
    return camera.normalized(xy[0]), by_turn.transpose(1, 2, 0)


def _turned_about_axes(direction: Float) -> Float:
    """Return the cross products of vectors (n, 3) with the three axes, (3, n, 3); np.cross takes five times as long."""
    x, y, z = direction.T
    zero = np.zeros(len(direction))
    return np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(0, 2, 1)


# Prior standard deviation of the principal point, over the image's width.
_PRINCIPAL_POINT_SD = 0.02
# Prior of the denominator k4, k5, k6 of a rational lens, and its standard deviation. Without a prior, numerator and
# denominator compensate each other, with a pole just beyond the farthest star.
_DENOMINATOR = (0.5, 0.0, 0.0)
_DENOMINATOR_SD = 0.3
# Residuals beyond this multiple of the noise have a reduced influence (soft L1 loss).
_SOFT_NOISE = 2.0
_MOST_STEPS = 100
# A lens must be one-to-one over the image, and this factor beyond its border.
_BORDER_FACTOR = 1.02
# Stars up to this angle off the axis determine the start of a lens that ends before 90 deg.
_MOST_PERSPECTIVE_RAD = np.deg2rad(88.0)


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedStars:
    """Identified stars of one image."""

    apparent: Float  # (n, 3) apparent unit vectors, true equator and equinox of date
    xy_px: Float  # (n, 2) detected positions on the unmirrored image, px
    # (n, 3) or None: derivative of `apparent` by the readout time of a rolling shutter, 1/s.
    by_readout: Float | None = None

    @staticmethod
    def of(
        detected: DetectedStars,
        apparent: Float,
        solution: PlateSolution,
        star: Index,
        detection: Index,
        rows: RowTurns | None = None,
    ) -> "IdentifiedStars":
        """Return the matched stars of an image.

        `apparent` (m, 3): apparent directions of all reference stars; `solution`: states whether the image is mirrored;
        `star`, `detection` (n,) intp: indices of the pairs; `rows`: with a rolling shutter, how the aircraft turned
        between the rows: directions are turned to the attitude of the middle row.
        """
        xy = detected.xy_px[detection].copy()
        direction, by_readout = apparent[star], None
        if rows is not None:
            by_readout = rows.by_readout(direction, xy, solution.camera)
            direction = rows.turned(direction, xy, solution.camera)
        if solution.mirrored:
            xy[:, 0] = solution.camera.width_px - 1 - xy[:, 0]
        return IdentifiedStars(direction, xy, by_readout)

    def __len__(self) -> int:
        return len(self.xy_px)

    def every(self, count: int) -> "IdentifiedStars":
        """Return every n-th star, bright and faint ones alike."""
        by_readout = None if self.by_readout is None else self.by_readout[::count]
        return IdentifiedStars(self.apparent[::count], self.xy_px[::count], by_readout)

    def residual_px(self, camera: Camera, C_camera_eq: Float) -> Float:
        """Return detected minus predicted positions, (n, 2) float64, px; NaN outside the lens's domain."""
        return self.xy_px - camera.project(self.apparent @ C_camera_eq.T)

    def largest_angle_rad(self, C_camera_eq: Float) -> float:
        """Return the largest angle between a star and the optical axis."""
        x, y, z = (self.apparent @ C_camera_eq.T).T
        return float(np.max(np.arctan2(np.hypot(x, y), z)))

    def corner_fraction(self, camera: Camera) -> float:
        """Return the distance of the outermost star from the principal point, in distances of the farthest corner.

        For a fisheye, over the radius at 90 deg or of its image circle, if that is smaller: there stars may end.
        """
        centre = np.array([camera.cx_px, camera.cy_px])
        corners = [(x, y) for x in (-0.5, camera.width_px - 0.5) for y in (-0.5, camera.height_px - 0.5)]
        farthest = np.linalg.norm(np.array(corners) - centre, axis=1).max()
        outermost = np.linalg.norm(self.xy_px - centre, axis=1).max()
        if camera.lens is not None and camera.lens.model == "fisheye":
            circle_px = camera.fx_px * camera.lens.radius(0.999999 * min(camera.lens.limit_rad, np.pi / 2))
            farthest = np.fmin(farthest, max(circle_px, outermost))
        return float(outermost / farthest)


@dataclass(frozen=True, slots=True, eq=False)
class CameraPoses:
    """One camera and its attitude in each image."""

    camera: Camera
    # Tuple of (3, 3) float64: one for each image: true equator and equinox of date to the camera frame.
    C_camera_eq: tuple[Float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FreeParameters:
    """Which parameters are fitted: an attitude for each image, the focal length, and parts of the lens.

    A step holds three rotation components for each image, then ln f, the principal point over the image's width (if it
    is free) and the free coefficients.
    """

    stars: tuple[IdentifiedStars, ...]  # One for each image
    prior: Camera  # The principal point has a prior at this camera's
    noise_px: tuple[float, ...]  # Standard deviation of the detected positions of each image, px
    coefficients: tuple[int, ...]  # Indices of the lens's free coefficients
    principal_point: bool  # Whether the principal point is free

    @property
    def focal_column(self) -> int:
        """The index of ln f in a step."""
        return 3 * len(self.stars)

    @property
    def lens_column(self) -> int:
        """The index of the first coefficient in a step."""
        return self.focal_column + 1 + 2 * self.principal_point

    @property
    def denominator(self) -> tuple[int, ...]:
        """The free coefficients of a rational lens's denominator."""
        return tuple(k for k in self.coefficients if 5 <= k <= 7)

    def stepped(self, state: CameraPoses, step: Float) -> CameraPoses:
        """Return the camera and the attitudes a step away."""
        camera, f = state.camera, self.focal_column
        lens = camera.lens
        if lens is not None:
            values = np.array(lens.coefficients)
            values[list(self.coefficients)] += step[self.lens_column :]
            lens = replace(lens, coefficients=tuple(values.tolist()))
        right, down = step[f + 1 : f + 3] * camera.width_px if self.principal_point else (0.0, 0.0)
        factor = float(np.exp(np.clip(step[f], -1.0, 1.0)))
        camera = replace(
            camera,
            fx_px=camera.fx_px * factor,
            fy_px=camera.fy_px * factor,
            cx_px=camera.cx_px + float(right),
            cy_px=camera.cy_px + float(down),
            skew_px=camera.skew_px * factor,
            lens=lens,
        )
        turns = step[:f].reshape(-1, 3)
        return CameraPoses(
            camera,
            tuple(
                matrix_from_quaternion(quaternion_from_turn(turn)) @ C
                for turn, C in zip(turns, state.C_camera_eq, strict=True)
            ),
        )

    def residuals(self, state: CameraPoses) -> tuple[Float, Float]:
        """Return predicted minus detected positions over the noise, then the prior's residuals, and their Jacobian."""
        blocks = [self._image_residuals(state, image) for image in range(len(self.stars))]
        residual, jacobian = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        from_prior, by_step = self._prior_residuals(state.camera, jacobian.shape[1])
        return np.concatenate([residual, from_prior]), np.concatenate([jacobian, by_step])

    def _image_residuals(self, state: CameraPoses, image: int) -> tuple[Float, Float]:
        camera, stars, f = state.camera, self.stars[image], self.focal_column
        width_px, matrix = camera.width_px, camera.K[:2, :2]
        direction = stars.apparent @ state.C_camera_eq[image].T
        distorted, by_turn = projection_jacobian(camera, direction)
        jacobian = np.zeros((len(distorted), 2, self.lens_column + len(self.coefficients)))
        jacobian[:, :, 3 * image : 3 * image + 3] = by_turn
        jacobian[:, :, f] = distorted @ matrix.T
        if self.principal_point:
            jacobian[:, :, f + 1 : f + 3] = width_px * np.eye(2)
        if camera.lens is not None and self.coefficients:
            by_coefficient = _coefficient_jacobian(camera.lens, direction)[:, :, list(self.coefficients)]
            jacobian[:, :, self.lens_column :] = matrix @ by_coefficient
        residual = distorted @ matrix.T + (camera.cx_px, camera.cy_px) - stars.xy_px
        # A star outside the lens's domain has a large constant residual.
        outside = ~np.isfinite(residual).all(axis=1) | ~np.isfinite(jacobian).all(axis=(1, 2))
        residual[outside], jacobian[outside] = width_px, 0.0
        values = residual.ravel() / self.noise_px[image]
        return values, jacobian.reshape(len(values), -1) / self.noise_px[image]

    def _prior_residuals(self, camera: Camera, columns: int) -> tuple[Float, Float]:
        residual, jacobian = np.zeros(0), np.zeros((0, columns))
        if self.principal_point:
            offset = np.array([camera.cx_px - self.prior.cx_px, camera.cy_px - self.prior.cy_px])
            residual = offset / (camera.width_px * _PRINCIPAL_POINT_SD)
            jacobian = np.eye(2, columns, self.focal_column + 1) / _PRINCIPAL_POINT_SD
        for k in self.denominator:
            assert camera.lens is not None
            deviation = (camera.lens.coefficients[k] - _DENOMINATOR[k - 5]) / _DENOMINATOR_SD
            column = self.lens_column + self.coefficients.index(k)
            residual = np.append(residual, deviation)
            jacobian = np.vstack([jacobian, np.eye(1, columns, column) / _DENOMINATOR_SD])
        return residual, jacobian


def fit_parameters(free: FreeParameters, start: CameraPoses, model: LensModel | None) -> Minimum[CameraPoses] | None:
    """Return the camera with a lens of a model, and the attitudes, that fit the stars best.

    `model` is None for a pinhole.  The result is None if there is no minimum; its lens need not be one-to-one over the
    image (`is_one_to_one`).
    """
    start_camera = start.camera
    angle_rad = max(stars.largest_angle_rad(C) for stars, C in zip(free.stars, start.C_camera_eq, strict=True))
    camera = replace(
        start_camera,
        cx_px=start_camera.cx_px if free.principal_point else free.prior.cx_px,
        cy_px=start_camera.cy_px if free.principal_point else free.prior.cy_px,
        lens=None if model is None else _lens_like(start_camera.lens, model, free.coefficients, angle_rad),
    )
    positions = 2 * sum(map(len, free.stars))
    priors = 2 * free.principal_point + len(free.denominator)
    # The prior keeps its full weight.
    scale = np.append(np.full(positions, _SOFT_NOISE), np.full(priors, np.inf))
    try:
        return minimise(
            replace(start, camera=camera), free.residuals, free.stepped, scale=scale, most_steps=_MOST_STEPS
        )
    except (ValueError, np.linalg.LinAlgError, CalibrationError):
        return None


# The image is divided into this number of parts along each side, whose residuals may be correlated.
_PARTS = 4


def standard_errors(fit: Minimum[CameraPoses], free: FreeParameters) -> dict[str, float]:
    """Return the standard errors of ``fx_px``, and of ``cx_px``, ``cy_px`` and the coefficients if they were free.

    The larger of two estimates: from the scatter of stars, and from the scatter of parts of the images, because a lens
    that is not quite of the model shifts all stars of a part.
    """
    camera, f = fit.state.camera, free.focal_column
    degrees = max(len(fit.residual) - fit.slopes.shape[1], 1)
    inverse = np.linalg.pinv(fit.information)
    by_star = np.diag(inverse) * max(2 * fit.cost / degrees, 1e-12)
    by_part = np.sum((_scores_of_parts(fit, free) @ inverse) ** 2, axis=0) * len(fit.residual) / degrees
    sd = np.sqrt(np.maximum(by_star, by_part))
    errors = {"fx_px": float(sd[f] * camera.fx_px)}
    if free.principal_point:
        errors |= {"cx_px": float(sd[f + 1] * camera.width_px), "cy_px": float(sd[f + 2] * camera.width_px)}
    names = () if camera.lens is None else COEFFICIENTS[camera.lens.model]
    return errors | {names[k]: float(sd[free.lens_column + i]) for i, k in enumerate(free.coefficients)}


def _scores_of_parts(fit: Minimum[CameraPoses], free: FreeParameters) -> Float:
    """Return the scores of the parts of all images, (parts, k), larger by what the sum of few squares lacks.

    Liang & Zeger 1986, *Biometrika* 73.
    """
    size_px = np.array([fit.state.camera.width_px, fit.state.camera.height_px])
    parts = []
    for image, stars in enumerate(free.stars):
        column, row = np.clip((_PARTS * stars.xy_px / size_px).astype(np.intp), 0, _PARTS - 1).T
        parts.append((image * _PARTS + row) * _PARTS + column)
    _, part = np.unique(np.concatenate(parts), return_inverse=True)
    positions = 2 * len(part)
    score = fit.slopes[:positions] * (fit.residual / fit.root)[:positions, np.newaxis]
    count = int(part.max()) + 1
    of_part = np.zeros((count, score.shape[1]))
    np.add.at(of_part, np.repeat(part, 2), score)
    return np.asarray(of_part * np.sqrt(count / max(count - 1, 1)))


def is_one_to_one(camera: Camera) -> bool:
    """Return whether each pixel of the image, and of a narrow border around it, maps to one direction.

    The corners may lie outside the image circle of a fisheye of 180 deg or more.
    """
    if camera.lens is None or (camera.lens.model == "fisheye" and camera.lens.limit_rad >= np.pi / 2):
        return True
    middle = np.array([camera.cx_px, camera.cy_px])
    border = np.array(
        [(x, y) for x in np.linspace(-0.5, camera.width_px - 0.5, 9) for y in (-0.5, camera.height_px - 0.5)]
        + [(x, y) for x in (-0.5, camera.width_px - 0.5) for y in np.linspace(-0.5, camera.height_px - 0.5, 9)]
    )
    return bool(np.isfinite(camera.unit_vectors(middle + _BORDER_FACTOR * (border - middle))).all())


def _lens_like(similar: Lens | None, model: LensModel, free: tuple[int, ...], angle_rad: float) -> Lens:
    """Return the lens of a model closest to a given lens, or to a pinhole, up to an angle off the axis."""
    theta = np.linspace(0.0, angle_rad, 65)[1:]
    tangent = np.tan(np.where(theta < _MOST_PERSPECTIVE_RAD, theta, np.nan))
    distorted = tangent if similar is None else similar.radius(theta)
    coefficients = np.zeros(max(free, default=-1) + 1)
    if model == "fisheye":
        values, terms = distorted / theta - 1, theta[:, np.newaxis] ** np.array([2, 4, 6, 8])
        radial = list(free)
    else:
        r, factor = tangent, distorted / tangent
        if model == "rational":
            below = [k for k in free if k >= 5]
            coefficients[below] = [_DENOMINATOR[k - 5] for k in below]
            factor = factor * (1 + r[:, np.newaxis] ** (2 * np.array(below) - 8) @ coefficients[below])
        values, terms = factor - 1, r[:, np.newaxis] ** np.array([2, 4, 0, 0, 6])
        radial = [k for k in free if k in {0, 1, 4}]
    valid = np.isfinite(values)
    coefficients[radial] = np.linalg.lstsq(terms[valid][:, radial], values[valid], rcond=None)[0]
    return Lens(model, tuple(coefficients.tolist()), np.pi if similar is None else similar.max_angle_rad)


def _coefficient_jacobian(lens: Lens, direction: Float) -> Float:
    """Return the derivatives of distorted positions by the coefficients, (n, 2, 12), or (n, 2, 4) for a fisheye.

    OpenCV's models; `direction` is (n, 3), in the camera frame.
    """
    x, y, z = direction.T
    if lens.model == "fisheye":
        rho = np.maximum(np.hypot(x, y), 1e-12)
        powers = np.arctan2(rho, z)[:, np.newaxis] ** np.array([3, 5, 7, 9])
        return np.asarray(direction[:, :2, np.newaxis] * (powers / rho[:, np.newaxis])[:, np.newaxis])
    plane = direction[:, :2] / direction[:, 2:]
    x, y = plane.T
    q = x * x + y * y
    k1, k2, _, _, k3, k4, k5, k6 = (*lens.coefficients, *(0.0,) * 8)[:8]
    denominator = 1 + q * (k4 + q * (k5 + q * k6))
    factor = (1 + q * (k1 + q * (k2 + q * k3))) / denominator
    powers = np.column_stack([q, q**2, q**3]) / denominator[:, np.newaxis]
    by_numerator = plane[:, :, np.newaxis] * powers[:, np.newaxis]
    by_denominator = -factor[:, np.newaxis, np.newaxis] * by_numerator
    by_decentring = np.array([[2 * x * y, q + 2 * x * x], [q + 2 * y * y, 2 * x * y]]).transpose(2, 0, 1)
    zero = np.zeros_like(q)
    by_prism = np.array([[q, q**2, zero, zero], [zero, zero, q, q**2]]).transpose(2, 0, 1)
    parts = [by_numerator[:, :, :2], by_decentring, by_numerator[:, :, 2:], by_denominator, by_prism]
    return np.concatenate(parts, axis=-1)
