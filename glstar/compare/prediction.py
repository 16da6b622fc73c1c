"""Predicted star trails: the stars to search for in a real image, and their paths while the shutter is open.

Paths are sampled for single exposures, rolling shutters and stacked exposures.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Mask
from glstar.render.readout.rows import recorded_paths
from glstar.render.scene.scene import Frame, Scene

Number = TypeVar("Number", bound=np.generic)

# Largest number of samples along a path.
_MAX_SAMPLES = 240
# Smallest number of samples in each piece of the path of a stacked image: a rate at its ends needs three.
_LEAST_SAMPLES = 3
# Number of samples along a path that a rolling shutter records.
_ROLLING_SAMPLES = 64
# Half the width of the aperture along a path, in sigma: it holds all but 0.2 % of the flux.
_APERTURE_SIGMA = 3.5
# Distance from the image's edge to the aperture of a complete trail, px: room for the fit to move.
_EDGE_PX = 5.0
# A star is blended if other stars add more than this fraction of its flux to its aperture.
_BLENDED_FRACTION = 0.05
# Number of small motions: rotations, a delay, a readout time, and rotations that grow.
_MOTIONS = 8
# Shorter trails, in sigma, do not determine a length or a direction.
_MIN_TRAIL_SIGMA = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class ExposedPaths:
    """Paths of stars at n times that are evenly spaced while the shutter is open."""

    in_camera: Float  # (n, k, 3) vectors in the camera frame; NaN below the horizon
    step_s: float  # Time between two samples of one piece, s
    exposed_fraction: Float  # (k,) how long each star is recorded over the exposure time
    # (n,) times after the middle, over the time from the first opening to the last closing: -1/2 to 1/2.
    since_mid: Float
    pieces: int = 1  # short exposures of a stacked image, each with the same number of samples

    def rate_of(self, values: Float) -> Float:
        """Return the derivative by time of values at the samples, (n, ...) float64, 1/s, each piece by itself."""
        pieces = values.reshape(self.pieces, len(values) // self.pieces, *values.shape[1:])
        return np.asarray(np.gradient(pieces, self.step_s, axis=1, edge_order=2).reshape(values.shape))


def exposed_paths(scene: Scene, direction_eq: Float) -> ExposedPaths:
    """Return the sampled paths of stars while the shutter is open.

    `scene`: of a single exposure, or of a stacked image; `direction_eq` (k, 3): geocentric apparent unit vectors, true
    equator and equinox.  Under a rolling shutter a path is sampled while the row of its star is open; a delay of the
    exposure also delays its rows, so the time between samples is as for a star at rest.
    """
    if not scene.shorts:
        return _single(scene, direction_eq)
    parts = [_single(short, direction_eq) for short in scene.shorts]
    # Each short exposure has the same weight in the centre of the trail.
    count = min(max(_MAX_SAMPLES // len(parts), _LEAST_SAMPLES), *(len(part.in_camera) for part in parts))
    even = (np.arange(count) + 0.5) / count
    starts_s = scene.exposure.short_times_s()[:, 0] - scene.exposure.start_utc_s
    duration_s = scene.exposure.duration_s
    # Time from the first opening to the last closing of any row: all rows are delayed alike.
    open_s = scene.exposure.span_s - scene.exposure.readout_s
    since_start_s = (starts_s[:, np.newaxis] + even * duration_s).ravel()
    return ExposedPaths(
        np.concatenate([part.in_camera[(even * len(part.in_camera)).astype(np.intp)] for part in parts]),
        duration_s / count,
        np.mean([part.exposed_fraction for part in parts], axis=0),
        since_start_s / open_s - 0.5,
        len(parts),
    )


def _single(scene: Scene, direction_eq: Float) -> ExposedPaths:
    """Return the paths of a single exposure."""
    duration_s = scene.exposure.duration_s
    if scene.exposure.readout_s and scene.motion is not None:
        in_camera, exposed_s = recorded_paths(scene, direction_eq, _ROLLING_SAMPLES)
        step_s, exposed_fraction = duration_s / _ROLLING_SAMPLES, exposed_s / duration_s
    else:
        step = max(1, len(scene.trails.pointing) // _MAX_SAMPLES)
        in_camera = scene.trails.pointing[step // 2 :: step].to_camera(direction_eq)
        step_s = duration_s * step / max(len(scene.trails.pointing), 1)
        exposed_fraction = np.ones(len(direction_eq))
    since_mid = (np.arange(len(in_camera)) + 0.5) / len(in_camera) - 0.5
    return ExposedPaths(in_camera, step_s, exposed_fraction, since_mid)


@dataclass(frozen=True, slots=True, eq=False)
class Trails:
    """Star trails of one simulated image that can be measured: complete, isolated and above the noise."""

    catalogue: str  # The catalogue that numbers the stars; empty if it is unknown
    star_id: NDArray[np.int32]  # (k,) int32: their numbers there; 0 for an unknown star
    name: tuple[str, ...]
    vmag: Float  # (k,) magnitudes; NaN if unknown
    # (n, k, 2) the star paths: positions (x, y) at n times; of a stacked image while each short exposure is open.
    path_px: Float
    # (height, width) float32: the noiseless signal above the background, DN, without saturation.
    signal_dn: NDArray[np.float32]
    # (height, width) float32: the simulated image minus its sky level, DN: with noise, quantisation and saturation.
    pixels_dn: NDArray[np.float32]
    headroom_dn: float  # Signal above the sky at which a pixel saturates, DN
    sigma_px: float  # Standard deviation of a star, including the pixel's width, px
    # (k, 4, m) derivatives of each trail's shift along x and y (px), stretch (a fraction) and turn (rad) by each of m
    # small motions of the camera.
    jacobian: Float
    signal_to_noise: Float  # (k,) signal-to-noise ratio of the whole trail on the real image, if it is as bright there
    blended: int = 0  # stars that were excluded because they overlap another one
    cut_off: int = 0  # stars that were excluded because they leave the image

    def __len__(self) -> int:
        return len(self.star_id)

    @property
    def half_width_px(self) -> float:
        """Half the width of the aperture along a path, px."""
        return _APERTURE_SIGMA * self.sigma_px + 0.5

    @property
    def length_px(self) -> Float:
        """Lengths of the paths, (k,) float64, px."""
        return np.asarray(np.hypot(*np.moveaxis(np.diff(self.path_px, axis=0), -1, 0)).sum(axis=0))

    @property
    def elongated(self) -> Mask:
        """Mask of trails long enough to have a length and a direction, (k,) bool."""
        return np.asarray(self.length_px > _MIN_TRAIL_SIGMA * self.sigma_px)

    def only(self, which: NDArray[np.intp]) -> "Trails":
        """Return some of the trails, by index."""
        return replace(
            self,
            star_id=self.star_id[which],
            name=tuple(self.name[k] for k in which),
            vmag=self.vmag[which],
            path_px=self.path_px[:, which],
            jacobian=self.jacobian[which],
            signal_to_noise=self.signal_to_noise[which],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Stamp:
    """The smallest rectangle of an image that holds a trail."""

    left: int  # first column
    top: int  # first row
    mask: Mask  # (h, w) pixels in the trail's aperture

    def of(self, image: NDArray[Number]) -> NDArray[Number]:
        """Return an image's pixels inside, (h, w)."""
        height, width = self.mask.shape
        return image[self.top : self.top + height, self.left : self.left + width]

    def inside(self, shape: tuple[int, ...]) -> bool:
        """Return whether the whole stamp is inside an image."""
        height, width = self.mask.shape
        return self.left >= 0 and self.top >= 0 and self.left + width <= shape[1] and self.top + height <= shape[0]


def stamp_of(path_px: Float, half_width_px: float, *, margin_px: int = 0) -> Stamp:
    """Return the stamp of a path, (n, 2) px; it may extend beyond the image.

    `half_width_px`: half the width of the aperture; `margin_px`: margin of the stamp around the mask.
    """
    low = np.floor(path_px.min(axis=0) - half_width_px).astype(int) - margin_px
    high = np.ceil(path_px.max(axis=0) + half_width_px).astype(int) + margin_px
    width, height = high - low + 1
    mask = np.zeros((height, width), dtype=np.uint8)
    # OpenCV draws in units of 1/16 px; a line of zero length is a disc.
    points = np.rint((path_px - low) * 16).astype(np.int32)[:, np.newaxis]
    cv2.polylines(mask, [points], isClosed=False, color=1, thickness=max(1, round(2 * half_width_px)), shift=4)
    return Stamp(int(low[0]), int(low[1]), mask.astype(np.bool_))


def predicted_trails(scene: Scene, frame: Frame, *, noise_dn: float, least_signal: float, most: int) -> Trails:
    """Return the trails of a scene that can be measured: complete, isolated and above the noise.

    `frame`: the rendered frame, with its noiseless signal; `noise_dn`: standard deviation of the real image's noise,
    DN; `least_signal`: smallest signal-to-noise ratio of a whole trail; `most`: largest number of trails; the trails of
    the highest signal-to-noise ratio are kept.

    The motions of the Jacobian are rotations of the camera about its right, down and forward axes (rad), a delay of the
    exposure (s), and a longer readout time with the same start of the exposure (s).  The last three are rotations about
    the same axes that grow from -1/2 to +1/2 during the exposure (rad).
    """
    assert frame.light_dn is not None
    sensor, camera = scene.sensor, scene.camera
    exposure = scene.exposure
    short_background_dn = sensor.background_mean_dn(exposure.duration_s)
    background_dn = exposure.signal_factor * short_background_dn
    pixels = frame.pixels.astype(np.float32) - np.float32(background_dn)
    vmag = scene.stars.vmag[scene.visible]
    flux_dn = exposure.signal_factor * sensor.flux_dn(sensor.peak_dn(scene.observed_mag, exposure.duration_s))
    # Signal-to-noise ratios of stars without motion.
    upper_bound = flux_dn / (2 * np.sqrt(np.pi) * sensor.effective_sigma_px * noise_dn)
    likely = np.flatnonzero(upper_bound >= least_signal)
    paths = exposed_paths(scene, scene.stars.direction_eq[scene.visible[likely]])
    flux_dn[likely] *= paths.exposed_fraction
    path = camera.project(paths.in_camera)
    margin_px = _APERTURE_SIGMA * sensor.effective_sigma_px + _EDGE_PX
    whole = camera.contains(path, -margin_px).all(axis=0)
    touching = camera.contains(path).any(axis=0)
    trails = Trails(
        catalogue=scene.stars.catalogue,
        star_id=scene.stars.star_id[scene.visible[likely]],
        name=tuple(scene.stars.name[s] for s in scene.visible[likely]),
        vmag=vmag[likely],
        path_px=path,
        signal_dn=frame.light_dn,
        pixels_dn=pixels,
        # Where one short exposure is saturated, the sum of all is too small.
        headroom_dn=max((sensor.saturation_dn - short_background_dn) * exposure.signal_factor / exposure.frames, 1.0),
        sigma_px=sensor.effective_sigma_px,
        jacobian=np.zeros((len(likely), 4, _MOTIONS)),
        signal_to_noise=upper_bound[likely],
        cut_off=int((touching & ~whole).sum()),
    ).only(np.flatnonzero(whole))
    chosen, selected = _clear_and_alone(trails, flux_dn[likely][whole], noise_dn, least_signal, most)
    return replace(selected, jacobian=_trail_jacobians(scene, paths, np.flatnonzero(whole)[chosen], selected))


def _clear_and_alone(
    trails: Trails, flux_dn: Float, noise_dn: float, least_signal: float, most: int
) -> tuple[NDArray[np.intp], Trails]:
    """Return the indices of the trails that are above the noise and not blended, and these trails."""
    signal = np.zeros(len(trails))
    alone = np.zeros(len(trails), dtype=np.bool_)
    for k in range(len(trails)):
        stamp = stamp_of(trails.path_px[:, k], trails.half_width_px)
        light = stamp.of(trails.signal_dn)[stamp.mask].astype(np.float64)
        signal[k] = float(np.sqrt(light @ light)) / noise_dn
        alone[k] = light.sum() <= (1 + _BLENDED_FRACTION) * flux_dn[k]
    order = np.argsort(-signal, kind="stable")
    chosen = order[(alone & (signal >= least_signal))[order]][:most]
    selected = replace(trails, signal_to_noise=signal).only(chosen)
    return chosen, replace(selected, blended=int((~alone & (signal >= least_signal)).sum()))


def _trail_jacobians(scene: Scene, paths: ExposedPaths, stars: NDArray[np.intp], trails: Trails) -> Float:
    """Return the Jacobians of trails by turns of the camera, time, readout time, and turns that grow, (k, 4, 8)."""
    camera, path, in_camera = scene.camera, trails.path_px, paths.in_camera[:, stars]
    fields = np.zeros((*path.shape, _MOTIONS))
    small_rad = 1e-5
    for axis in range(3):
        # Stars rotate against the camera.
        turn = np.cross(np.eye(3)[axis], in_camera) * small_rad
        fields[..., axis] = (camera.project(in_camera - turn) - camera.project(in_camera + turn)) / (2 * small_rad)
    if len(path) > 2 * paths.pieces:
        fields[..., 3] = paths.rate_of(path)
        # A longer readout time delays each row in proportion to its number.
        fields[..., 4] = _row_fraction(scene, path)[..., np.newaxis] * fields[..., 3]
    fields[..., 5:] = paths.since_mid[:, np.newaxis, np.newaxis, np.newaxis] * fields[..., :3]
    return trail_jacobian(fields, trails)


def _row_fraction(scene: Scene, xy_px: Float) -> Float:
    """Return the fraction of the readout time after which the pixels at some positions open: 0 to 1."""
    whole = scene.exposure.first.with_readout_s(1.0)
    return whole.opening_at_s(xy_px, scene.camera.width_px, scene.camera.height_px)


def trail_jacobian(fields: Float, trails: Trails) -> Float:
    """Return the Jacobian of trails, (k, 4, m): shift along x and y (px), stretch (a fraction) and turn (rad).

    `fields` (n, k, 2, m): displacement of each point of each path per unit of each of m motions, px.  By least squares.
    """
    jacobian = np.zeros((len(trails), 4, fields.shape[-1]))
    jacobian[:, :2] = fields.mean(axis=0)
    offset, along = offsets_and_directions(trails.path_px)
    stretch = along * np.sum(offset * along, axis=-1, keepdims=True)
    turn = np.stack([-offset[..., 1], offset[..., 0]], axis=-1)
    for k in np.flatnonzero(trails.elongated):
        basis = np.column_stack([stretch[:, k].ravel(), turn[:, k].ravel()])
        jacobian[k, 2:] = np.linalg.lstsq(basis, fields[:, k].reshape(len(basis), -1), rcond=None)[0]
    return jacobian


def offsets_and_directions(path_px: Float) -> tuple[Float, Float]:
    """Return the points relative to their path's mean, (n, k, 2) px, and the principal directions, (k, 2)."""
    offset = path_px - path_px.mean(axis=0)
    spread = np.einsum("nki,nkj->kij", offset, offset)
    along = np.linalg.eigh(spread)[1][:, :, 1]
    # From the start to the end of the exposure.
    backwards = np.sum(along * (path_px[-1] - path_px[0]), axis=-1) < 0
    along[backwards] *= -1
    return offset, along


def moved_path(path_px: Float, modes: Float) -> Float:
    """Return a path, (n, 2) px, shifted, stretched and turned about its mean by four modes (x, y, stretch, turn)."""
    middle = path_px.mean(axis=0)
    _, along = offsets_and_directions(path_px[:, np.newaxis])
    return np.asarray(middle + modes[:2] + (path_px - middle) @ deformation(along[0], modes).T)


def deformation(along: Float, modes: Float) -> Float:
    """Return the matrix of a stretch along a direction followed by a rotation, (2, 2)."""
    cosine, sine = np.cos(modes[3]), np.sin(modes[3])
    return np.asarray(np.array([[cosine, -sine], [sine, cosine]]) @ (np.eye(2) + modes[2] * np.outer(along, along)))
