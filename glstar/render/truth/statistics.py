"""Statistics of star trails over an exposure: how long each touches the image, where, and whether it saturates."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Mask
from glstar.render.motion.starpaths import ConicPaths, SampledPaths
from glstar.render.readout.rows import RecordedPart, RecordedTimes, RowTimeSearch, recorded_parts, recorded_rows
from glstar.render.scene.scene import Scene

Pixels = NDArray[np.uint8] | NDArray[np.uint16] | Mask

# Samples of the path of a star that crosses the border of the image, for each that its length demands, and of a segment
# at least: it may shake and turn there.
_FINER = 4
_LEAST_SAMPLES = 16
# Side of the cells in which saturated pixels are counted, px.
_CELL_PX = 32


class TrailStatistics:
    """Statistics of each visible star over the exposure, accumulated over blocks of times.

    `touching`, `on_image` (k,): fractions of the exposure in which a star's flux and its centre lie on the image;
    `sum_xy` (2, k): integral of its position over the former; `saturated` (k,) bool: whether one of the `pixels` under
    its centre is saturated (or True, if they are bool); False without pixels; `recorded`: when a rolling shutter
    records each star; None for a global shutter.
    """

    def __init__(self, scene: Scene, pixels: Pixels | None = None, rows: RowTimeSearch | None = None) -> None:
        count = len(scene.visible)
        self.touching = np.zeros(count)
        self.on_image = np.zeros(count)
        self.sum_xy = np.zeros((2, count))
        self.saturated = np.zeros(count, dtype=np.bool_)
        self._nodes_px: list[Float] = []
        saturation = None if pixels is None else _SaturationMap(pixels, scene.sensor.full_dn)
        self.recorded = recorded_rows(scene, scene.visible, rows)
        if self.recorded is not None:
            self._add_recorded(scene, self.recorded, saturation)
            return
        for paths in scene.star_paths(scene.stars.direction_eq[scene.visible]):
            if isinstance(paths, ConicPaths):
                self._nodes_px.append(paths.nodes_px)
                self._add_segments(scene, paths)
            else:
                self._add_samples(scene, paths)
            if saturation is not None:
                near = saturation.near(paths.bounds_px)
                for xy, _ in paths.samples(near):
                    self.saturated[near] |= saturation.crossed_by(xy, scene.camera.contains(xy))

    def _add_segments(self, scene: Scene, paths: ConicPaths) -> None:
        """Add paths, of which only the segments that cross the border of the image are sampled."""
        inside = _Inside.of(scene, *paths.segment_bounds_px)
        self.touching += paths.time_fraction @ inside.touches
        self.on_image += paths.time_fraction @ inside.on_image
        self.sum_xy += paths.weighted_sum_of(inside.touches)
        self._add_crossing(scene, paths, *(~inside.is_known).nonzero())

    def _add_crossing(
        self,
        scene: Scene,
        paths: ConicPaths,
        segment: NDArray[np.intp],
        star: NDArray[np.intp],
        *,
        part: RecordedPart | None = None,
    ) -> None:
        """Add samples of segments of stars, (p,) both, while a rolling shutter records them in a part of its time."""
        count, radius_px = len(self.touching), scene.listed.truncation_radius_px
        for samples in paths.segment_samples(segment, star, _FINER, _LEAST_SAMPLES):
            owner, weight = samples.star, samples.time_fraction
            outside_px, step_px = samples.own_values(scene.camera.distance_outside_px(samples.xy_px))
            touching, on_image = _parts_within(outside_px, step_px, radius_px[owner])
            if part is not None:
                weight = part.recorded_between(samples.begins, samples.begins + weight, owner)
            self.on_image += np.bincount(owner, weight * on_image, count)
            light = weight * touching
            self.touching += np.bincount(owner, light, count)
            # A part of a sample is the one that is farther inside.
            inwards = np.sign(step_px) * (touching - 1) / 2
            for axis, values_px in enumerate(samples.xy_px.T):
                own_px, change_px = samples.own_values(values_px)
                own_px += np.nan_to_num(inwards * change_px)
                moment = np.multiply(light, own_px, out=np.zeros_like(light), where=light > 0)
                self.sum_xy[axis] += np.bincount(owner, moment, count)

    def _add_samples(self, scene: Scene, paths: SampledPaths) -> None:
        """Add the paths of sub-exposures."""
        low, high = (np.moveaxis(px, -1, 0) for px in paths.bounds_px)
        inside = _Inside.of(scene, low, high)
        radius_px = scene.listed.truncation_radius_px
        self.touching += paths.time_fraction.sum() * inside.touches
        self.on_image += paths.time_fraction.sum() * inside.on_image
        self.sum_xy += np.where(inside.touches, paths.weighted_sum_px, 0.0)
        stars = np.flatnonzero(~inside.is_known)
        for xy, time_fraction in paths.samples(stars):
            outside_px = scene.camera.distance_outside_px(xy)
            touching, on_image = _parts_inside(outside_px, radius_px[stars], is_at_rest=paths.is_at_rest)
            self.touching[stars] += time_fraction @ touching
            self.on_image[stars] += time_fraction @ on_image
            for axis, sums in enumerate(self.sum_xy):
                sums[stars] += time_fraction @ np.where(touching > 0, touching * xy[..., axis], 0.0)

    def _add_recorded(self, scene: Scene, times: RecordedTimes, saturation: "_SaturationMap | None") -> None:
        """Add what the rows of a rolling shutter record: each star's path between its own opening and closing."""
        directions = scene.stars.direction_eq[scene.visible]
        recorded = np.zeros(len(directions))
        for part in recorded_parts(scene, directions, times):
            recorded += part.recorded
            if isinstance(part.paths, ConicPaths):
                if not scene.shorts:
                    self._nodes_px.append(part.paths.nodes_px)
                self._add_recorded_segments(scene, part, part.paths)
            else:
                self._add_recorded_samples(scene, part)
            if saturation is not None:
                self._saturate(scene, part, saturation, saturation.near(part.paths.bounds_px))
        recorded = np.maximum(recorded, 1e-12)
        self.touching /= recorded
        self.on_image /= recorded
        self.sum_xy /= recorded

    def _add_recorded_segments(self, scene: Scene, part: RecordedPart, paths: ConicPaths) -> None:
        """Add paths as `_add_segments` does."""
        inside = _Inside.of(scene, *paths.segment_bounds_px)
        touching, sum_xy = paths.integral_between(part.opens, part.closes, inside.touches)
        self.touching += part.scale * touching
        self.sum_xy += part.scale * sum_xy
        self.on_image += part.scale * paths.integral_between(part.opens, part.closes, inside.on_image)[0]
        self._add_crossing(scene, paths, *(~inside.is_known).nonzero(), part=part)

    def _add_recorded_samples(self, scene: Scene, part: RecordedPart) -> None:
        """Add the paths of sub-exposures."""
        radius_px = scene.listed.truncation_radius_px
        for xy, _, weight in part.samples(np.arange(len(radius_px))):
            touching, on_image = _parts_inside(scene.camera.distance_outside_px(xy), radius_px)
            self.on_image += np.einsum("nm,nm->m", weight, on_image)
            light = weight * touching
            self.touching += light.sum(axis=0)
            for axis in range(2):
                self.sum_xy[axis] += np.where(light > 0, light * xy[..., axis], 0.0).sum(axis=0)

    def _saturate(
        self, scene: Scene, part: RecordedPart, saturation: "_SaturationMap", stars: NDArray[np.intp]
    ) -> None:
        """Find which of some stars cross a saturated pixel while they are recorded."""
        for xy, _, weight in part.samples(stars):
            is_recorded = (weight > 0) & (scene.camera.distance_outside_px(xy) < 0)
            self.saturated[stars] |= saturation.crossed_by(xy, is_recorded)

    def chosen_nodes_px(self, stars: NDArray[np.intp]) -> Float | None:
        """Return the `ConicPaths.nodes_px` of some stars over the whole exposure; None where paths are sampled."""
        if not self._nodes_px:
            return None
        *pieces, last = (nodes.take(stars, axis=2) for nodes in self._nodes_px)
        return np.concatenate([*(nodes[:, :-1] for nodes in pieces), last], axis=1) if pieces else last

    @property
    def centroid(self) -> Float:
        """Mean position of each star while it touches the image, (k, 2) px; NaN if it never does."""
        touching = np.where(self.touching > 0, self.touching, np.nan)
        return (self.sum_xy / touching).T


def _parts_inside(
    outside_px: Float, radius_px: Float, *, is_at_rest: bool = False
) -> tuple[Float | Mask, Float | Mask]:
    """Return the parts of samples of paths, 0 to 1, that are within a radius of the image, and on it.

    `outside_px` (n, m): `Camera.distance_outside_px` of n consecutive samples; NaN where a star is not visible;
    `radius_px` (m,); `is_at_rest`: `SampledPaths.is_at_rest`.  Returns `within, on_image` (n, m) or bool.  A sample
    represents the path from halfway to the one before to halfway to the next, unless the star is at rest.
    """
    if is_at_rest or len(outside_px) == 1:
        return outside_px < radius_px, outside_px < 0
    return _parts_within(outside_px, np.gradient(outside_px, axis=0), radius_px)


def _parts_within(outside_px: Float, step_px: Float, radius_px: Float) -> tuple[Float, Float]:
    """Return `_parts_inside` of samples with changes from one to the next, px."""
    step_px = np.abs(step_px)
    # Beside a sample that is not visible, all of it or nothing; and nothing of what is not visible.
    np.fmax(step_px, 1e-9, out=step_px)
    within, on_image = (np.fmax((border_px - outside_px) / step_px + 0.5, 0.0) for border_px in (radius_px, 0.0))
    return np.minimum(within, 1.0), np.minimum(on_image, 1.0)


class _Inside(NamedTuple):
    """Where parts of the paths of m stars are, as far as their bounds say: most touch the image all the time or never.

    Arrays have the shape of the bounds, (..., m).
    """

    touches: Mask  # All the light touches the image
    on_image: Mask  # The centre is on the image all the time
    is_known: Mask  # What is neither is beside the image all the time

    @classmethod
    def of(cls, scene: Scene, low_px: Float, high_px: Float) -> Self:
        """Return it, given the smallest and largest columns and rows, (2, ..., m) px; NaN where a star is hidden."""
        radius_px = scene.listed.truncation_radius_px
        right, bottom = scene.camera.width_px - 0.5, scene.camera.height_px - 0.5
        nearest, farthest = (
            np.maximum(np.maximum(left[0] - right, -0.5 - other[0]), np.maximum(left[1] - bottom, -0.5 - other[1]))
            for left, other in ((low_px, high_px), (high_px, low_px))
        )
        touches, on_image = farthest < radius_px, farthest < 0
        is_known = (touches | (nearest > radius_px)) & (on_image | (nearest > 0))
        return cls(touches & is_known, on_image & is_known, is_known)


class _SaturationMap:
    """Where an image is saturated, to find the stars whose centres cross a saturated pixel."""

    def __init__(self, pixels: Pixels, saturation_dn: int) -> None:
        saturation_dn = 1 if pixels.dtype == np.bool_ else saturation_dn
        self._pixels, self._saturation_dn = pixels, saturation_dn
        # Most rows have no saturated pixel.
        rows = np.flatnonzero(pixels.max(axis=1) >= saturation_dn)
        row_index, columns = np.divmod(np.flatnonzero(pixels[rows] >= saturation_dn), pixels.shape[1])
        cells = np.zeros([side // _CELL_PX + 2 for side in pixels.shape], dtype=np.intp)
        cells[rows[row_index] // _CELL_PX + 1, columns // _CELL_PX + 1] = 1
        # Summed-area table: the number of cells with saturated pixels above and to the left of each.
        self._area_sum = cells.cumsum(axis=0).cumsum(axis=1)

    def near(self, bounds_px: Float) -> NDArray[np.intp]:
        """Return which of m stars have saturated pixels in their bounds, (2, m, 2) px: `SampledPaths.bounds_px`."""
        low, high = np.rint(bounds_px)
        last = np.array(self._pixels.shape[::-1]) - 1
        # A path that is NaN for some time may extend anywhere.
        left, top = np.minimum(np.fmax(low, 0), last).astype(np.intp).T // _CELL_PX
        right, bottom = np.maximum(np.fmin(high, last), 0).astype(np.intp).T // _CELL_PX + 1
        area_sum = self._area_sum
        return np.flatnonzero(
            area_sum[bottom, right] - area_sum[top, right] - area_sum[bottom, left] + area_sum[top, left]
        )

    def crossed_by(self, xy: Float, on_image: Mask) -> Mask:
        """Return which of m stars cross a saturated pixel, (m,).

        `xy` (n, m, 2): positions (x, y) at n times, px; `on_image` (n, m) bool: which of them lie on the image.
        """
        column, row = (np.rint(np.where(on_image, xy[..., axis], 0.0)).astype(np.intp) for axis in (0, 1))
        row *= self._pixels.shape[1]
        row += column
        return np.asarray(((self._pixels.ravel().take(row) >= self._saturation_dn) & on_image).any(axis=0))
