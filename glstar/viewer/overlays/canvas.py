"""The canvas of the overlays: the geometry of one image, and the lines, labels and marks added to it, in its pixels."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain
from math import floor, hypot, log10

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.motion.pointing import Pointing
from glstar.render.readout.rows import recorded_positions
from glstar.render.scene.scene import Scene
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.viewer.overlays.curves import Crossings, Curves, ImageRegion, Polylines, cut, inside_region, region_planes

Pixels = NDArray[np.float32]


class Mark(StrEnum):
    """The form of a mark: all but a pixel have a fixed size on the screen, whatever the zoom."""

    CROSS = "cross"
    TARGET = "target"
    RING = "ring"
    PIXEL = "pixel"


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Polylines of one overlay."""

    overlay: str  # A member of `glstar.viewer.overlays.table.Overlay`
    xy_px: Pixels  # (n, 2) float32: the points of all lines, one line after another, px of the image
    starts: NDArray[np.intp]  # (m,) intp: index of the first point of each line


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Texts of one overlay."""

    overlay: str  # A member of `glstar.viewer.overlays.table.Overlay`
    text: tuple[str, ...]
    xy_px: Pixels  # (n, 2) float32: the labelled positions, px of the image
    # (n, 2) float32: the point of the text that lies there, across and down: (0, 0.5) is the middle of its left edge.
    anchor: Pixels
    # Distance from the position to the text, px of the image, so that it does not cover a bright star.
    clear_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of one overlay."""

    overlay: str  # A member of `glstar.viewer.overlays.table.Overlay`
    mark: Mark
    xy_px: Pixels  # (n, 2) float32: their centres, px of the image


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Everything that is drawn over an image, in the order of drawing."""

    lines: tuple[Lines, ...] = ()
    labels: tuple[Labels, ...] = ()
    marks: tuple[Marks, ...] = ()


# Approximate size of a label on the screen, px, used to keep labels from overlapping; imgui draws the text.
_CHARACTER_SCREEN_PX = 7.5
_LINE_SCREEN_PX = 16.0
# Distance of a label from its position, screen px.
GAP_SCREEN_PX = 6.0
# Nine of ten arrows of residuals are at most this long, screen px, by default.
_LONG_SCREEN_PX = 60.0


class Canvas:
    """One image with the shapes drawn over it.

    Shapes belong to the overlay `current`, which the caller sets before it draws an overlay.

    Parameters
    ----------
    scene : Scene
    region : ImageRegion or None
        The visible part of the image; None for the complete image.
    zoom : float
        Screen pixels to one image pixel.
    radius_rad : float
        The largest angle from the boresight to a point of the image, rad.

    Attributes
    ----------
    current : str
        The overlay that is drawn.
    selected : str
        The name of the selected object, which no label repeats.
    label_clear_px : float
        Distance of its labels from their positions, px of the image.
    camera : Camera
    region : ImageRegion
    screen_px : float
        The size of a screen pixel, px of the image.
    middle : Pointing
        Pointing in the middle of the exposure.
    C_camera_ned : (3, 3) float64
        At the middle of the exposure.
    crossings : dict of str to Crossings
        Where the curves of each overlay cross the edge of the region, numbered from its own first curve.
    """

    def __init__(self, scene: Scene, region: ImageRegion | None, zoom: float, radius_rad: float) -> None:
        self.scene = scene
        self.current = ""
        self.selected = ""
        self.label_clear_px = 0.0
        self.camera: Camera = scene.camera
        complete = ImageRegion.complete(self.camera)
        self.region = complete if region is None else complete.intersection(region)
        self.screen_px = 1 / zoom
        self.middle = scene.shutter[1:2]
        self.C_camera_ned = ned_to_camera_matrix(self.middle)
        self.radius_rad = radius_rad
        self.crossings: dict[str, Crossings] = {}
        # (5, 3) inward normals of the region's edges and of the horizon.
        self._planes = np.vstack([region_planes(self.camera, self.region), -self.C_camera_ned[:, 2]])
        self._star_xy: Float | None = None
        self._trail_px: Float | None = None
        self._lines: list[Lines] = []
        self._marks: list[Marks] = []
        self._labels: dict[tuple[str, float], list[tuple[str, tuple[float, float], tuple[float, float]]]] = {}
        # The intervals of x that labels occupy in each row of text on the screen.
        self._rows: defaultdict[int, list[tuple[float, float]]] = defaultdict(list)
        self._character_px = _CHARACTER_SCREEN_PX * self.screen_px
        self._line_px, self._gap_px = _LINE_SCREEN_PX * self.screen_px, GAP_SCREEN_PX * self.screen_px

    @property
    def star_xy(self) -> Float:
        """Pixel positions of the visible stars when the shutter opens, in the middle, and when it closes, (3, k, 2)."""
        if self._star_xy is None:
            directions = self.scene.stars.direction_eq[self.scene.visible]
            self._star_xy = self.camera.project(self.scene.shutter.to_camera(directions))
        return self._star_xy

    def recorded_xy(self, stars: NDArray[np.intp] | NDArray[np.bool_]) -> Float:
        """Return positions of some visible stars as the row of each opens, in between, and as it closes, (3, k, 2)."""
        scene = self.scene
        if scene.exposure.readout_s == 0:
            return self.star_xy[:, stars]
        directions = scene.stars.direction_eq[scene.visible[stars]]
        return recorded_positions(scene, directions, np.array([0.0, 0.5, 1.0]))

    @property
    def trail_px(self) -> Float:
        """Lengths of the visible stars' trails, (k,) px; NaN for a trail that is partly behind the camera."""
        if self._trail_px is None:
            step = self.star_xy[1:] - self.star_xy[:-1]
            self._trail_px = np.hypot(step[..., 0], step[..., 1]).sum(axis=0)
        return self._trail_px

    def ring_stars(self, C_camera_estimated: Float, vmag_limit: float) -> None:
        """Ring the positions that bright stars have in the middle of the exposure by another attitude.

        `C_camera_estimated` (3, 3): rotation from the camera frame of that attitude to the true one.
        """
        scene = self.scene
        stars = scene.visible[scene.stars.vmag[scene.visible] <= vmag_limit]
        xy_px = self.camera.project(self.middle.to_camera(scene.stars.direction_eq[stars])[0] @ C_camera_estimated)
        self.mark(Mark.RING, xy_px[self.region.contains(xy_px)])

    def sky_lines(self, among_eq: Mapping[str, Curves], among_ned: Mapping[str, Curves]) -> None:
        """Add the visible parts of curves on the sky, and fill in `crossings`.

        Parameters
        ----------
        among_eq : mapping of overlay to Curves
            In geocentric apparent directions; they end at the horizon.
        among_ned : mapping of overlay to Curves
            In apparent directions north, east, down.
        """
        near_eq = [
            curves.near(self.middle.boresight_eq[0], self.radius_rad + MAX_REFRACTION_RAD)
            for curves in among_eq.values()
        ]
        near_ned = [curves.near(self.C_camera_ned[2], self.radius_rad) for curves in among_ned.values()]
        if not near_eq + near_ned:
            return
        apparent = np.concatenate([np.empty((0, 3)), *(v for v, _, _ in near_eq)])
        refracted = self.middle.to_camera(apparent, below_horizon=True)
        rotated = np.concatenate([np.empty((0, 3)), *(v for v, _, _ in near_ned)]) @ self.C_camera_ned.T
        vector = np.concatenate([refracted[0], rotated])
        inside = vector @ self._planes.T
        if self.camera.lens is not None:
            # With distortion the edges of the region are no planes in space, but they are straight on the image.
            inside[:, :4] = inside_region(self.camera.project(vector), self.region)
        above = inside[: len(refracted[0]), -1]
        above[:] = self.middle.above_horizon(apparent, self.middle.zenith_eq[0], above)
        # Curves among apparent directions do not end at the horizon: one of them is the horizon.
        inside[len(refracted[0]) :, -1] = 1.0

        curves = [*among_eq.values(), *among_ned.values()]
        firsts = np.cumsum([0, *(each.count for each in curves)]).tolist()
        near = [*near_eq, *near_ned]
        curve = np.concatenate([own + first for (_, own, _), first in zip(near, firsts, strict=False)])
        joined = np.concatenate([own for _, _, own in near])
        can_project = np.isfinite(inside[:, 0])
        joined[:-1] &= can_project[:-1] & can_project[1:]
        lines, crossings = cut(vector, inside, joined, curve, self.camera)
        for overlay, first, last in zip([*among_eq, *among_ned], firsts, firsts[1:], strict=False):
            self._add_polylines(overlay, lines.of_curves(first, last))
            self.crossings[overlay] = crossings.of_curves(first, last)

    def _add_polylines(self, overlay: str, lines: Polylines) -> None:
        if len(lines.starts):
            self._lines.append(Lines(overlay, lines.xy_px.astype(np.float32), lines.starts))

    def strokes(self, ends_px: Float) -> None:
        """Add straight lines.

        Parameters
        ----------
        ends_px : (n, 2, 2) float64
            Their ends, px of the image.
        """
        if len(ends_px):
            starts = np.arange(0, 2 * len(ends_px), 2)
            self._lines.append(Lines(self.current, ends_px.reshape(-1, 2).astype(np.float32), starts))

    def mark(self, mark: Mark, xy_px: Float) -> None:
        """Add marks; those outside the region are left out.

        Parameters
        ----------
        mark : Mark
        xy_px : (n, 2) float64
            Their centres, px of the image.
        """
        visible = xy_px[self.region.contains(xy_px)]
        if len(visible):
            self._marks.append(Marks(self.current, mark, visible.astype(np.float32)))

    def label(self, text: str, xy_px: Sequence[float], anchor: Sequence[float]) -> bool:
        """Add a label, moved into the region, unless it would overlap another one or repeat the selected name.

        Parameters
        ----------
        text : str
        xy_px : (2,) sequence of float
            The labelled position, px of the image.
        anchor : (2,) sequence of float
            The point of the text that lies there, across and down, 0 to 1.

        Returns
        -------
        bool
            Whether it was added.
        """
        if text == self.selected:
            return False
        (x, y), (across, down) = xy_px, anchor
        rows = text.count("\n") + 1
        longest = len(text) if rows == 1 else max(map(len, text.split("\n")))
        line = self._line_px
        width, height = longest * self._character_px + self._gap_px, line * rows
        left = max(min(x - across * width, self.region.right_px - width), self.region.left_px)
        top = max(min(y - down * height, self.region.bottom_px - height), self.region.top_px)
        right = left + width
        across, down = (x - left) / width, (y - top) / height
        occupied = range(floor(top / line), floor(top / line) + rows + 1)
        if any(left < end and start < right for row in occupied for start, end in self._rows[row]):
            return False
        self._occupy(left, right, occupied)
        self._labels.setdefault((self.current, self.label_clear_px), []).append((text, (x, y), (across, down)))
        return True

    def reserve(self, region: ImageRegion) -> None:
        """Keep labels out of a part of the image.

        Parameters
        ----------
        region : ImageRegion
        """
        first, last = floor(region.top_px / self._line_px), floor(region.bottom_px / self._line_px)
        self._occupy(region.left_px, region.right_px, range(first, last + 1))

    def _occupy(self, left: float, right: float, rows: range) -> None:
        for row in rows:
            self._rows[row].append((left, right))

    def shapes(self) -> Shapes:
        """Return everything that was added.

        Returns
        -------
        Shapes
        """
        labels = tuple(
            Labels(overlay, text, np.array(xy, dtype=np.float32), np.array(anchor, dtype=np.float32), clear_px)
            for (overlay, clear_px), written in self._labels.items()
            for text, xy, anchor in [tuple(zip(*written, strict=True))]
        )
        return Shapes(tuple(self._lines), labels, tuple(self._marks))


def ned_to_camera_matrix(pointing: Pointing) -> Float:
    """Return the rotation from north, east, down to the camera frame at the first time of a pointing, (3, 3)."""
    x, y, z = pointing.zenith_eq[0].tolist()
    from_axis = hypot(x, y)
    # East is the celestial pole x the zenith; at the Earth's poles any meridian serves.
    cosine, sine = (x / from_axis, y / from_axis) if from_axis > 1e-12 else (1.0, 0.0)
    C_ned_eq = np.array([[-z * cosine, -z * sine, from_axis], [-sine, cosine, 0.0], [-x, -y, -z]])
    return np.asarray(pointing.C_camera_eq[0] @ C_ned_eq.T)


def unit_by_larger_component(vector: Float) -> Float:
    """Return vectors (n, 2) scaled so that the larger component is 1 or -1, which moves a label beside a position.

    A vector of zero length or NaN becomes (1, 0).
    """
    with np.errstate(invalid="ignore"):
        larger = np.abs(vector).max(axis=1, keepdims=True)
        is_long = larger > 1e-6
    return np.where(is_long, vector / np.where(is_long, larger, 1.0), [1.0, 0.0])


def round_stride(minimum: float) -> int:
    """Return the smallest of 1, 2, 5, 10, 20, 50 ... that is at least the minimum."""
    stride = 1
    for factor in chain((1,), (factor for _ in range(12) for factor in (2, 2.5, 2))):
        stride = round(stride * factor)
        if stride >= minimum:
            break
    return stride


def arrow_strokes(tails_px: Float, tips_px: Float, barb_px: float) -> Float:
    """Return the strokes of arrows: (3 n, 2, 2) ends of the shafts and of both barbs, px.

    `tails_px`, `tips_px` (n, 2): they differ; `barb_px`: length of a barb along the arrow, at most that of the arrow.
    """
    length_px = np.linalg.norm(tips_px - tails_px, axis=1, keepdims=True)
    along = (tips_px - tails_px) / length_px
    across = along[:, ::-1] * [-1, 1]
    barb = np.minimum(barb_px, length_px)
    sides = [tips_px - barb * (along + side * 0.5 * across) for side in (1, -1)]
    return np.concatenate([np.stack([start, tips_px], axis=1) for start in (tails_px, *sides)])


def residual_scale(shift_px: Float, screen_px: float, long_screen_px: float = _LONG_SCREEN_PX) -> float:
    """Return the factor that lengthens arrows: the largest of 1, 2, 5, 10 ... with which nine of ten are short enough.

    `shift_px` (n, 2): px of the image; `screen_px`: size of a screen pixel, px of the image; `long_screen_px`: the
    length that one in ten may exceed, screen px.
    """
    typical_px = max(float(np.percentile(np.linalg.norm(shift_px, axis=1), 90)), 1e-4)
    most = max(long_screen_px * screen_px / typical_px, 1.0)
    power = 10.0 ** floor(log10(most))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= most)
