"""What may be drawn over the image: names, constellations, horizon, grids, axis, trails and the truth.

`Overlays.shapes` turns a scene into lines, labels and marks in pixels of the image, without a window and without
OpenGL; `glstar.viewer.ui.overlaydrawing` paints them. All stand where the stars stand in the middle of the exposure,
refracted as the stars are: an altitude or an azimuth that is read off the image is the apparent one.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain
from math import floor, hypot, isfinite
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.scene import Pointing, Scene
from glstar.render.truth import light_centroids
from glstar.sky.apparent import ASTROMETRY, direction
from glstar.sky.catalogue import StarCatalogue
from glstar.sky.constellations import constellations
from glstar.sky.horizon import MOST_LIFT_RAD, ned_direction, ned_to_azimuth_altitude_rad
from glstar.viewer.curves import (
    REFRACTION_BEND,
    Crossings,
    Curves,
    ImageRegion,
    Polylines,
    cut,
    finest_step_rad,
    great_circle,
    inside_window,
    parallel,
    window_planes,
)

__all__ = ["Labels", "Lines", "Mark", "Marks", "Overlay", "Overlays", "Shapes", "StarUnderCursor", "star_at"]

Float = NDArray[np.float64]
Pixels = NDArray[np.float32]

# Grids have a line every so many degrees of declination and altitude, and every so many minutes of right ascension:
# the widest of these that the image's half diagonal spans.
_SPACINGS: Final = ((10, 60), (5, 20), (2, 10), (1, 5))

_WINDS: Final = ("N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE", "S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW")

# The end of a constellation's line is a star if one stands within this; the farthest known is 9".
_SAME_STAR_RAD: Final = np.deg2rad(15 / 3600)
_FAINTEST_OF_A_LINE_VMAG: Final = 7.0

# A label's size on the screen, near enough to keep labels apart; what is drawn measures itself.
_CHARACTER_SCREEN_PX: Final = 7.5
_LINE_SCREEN_PX: Final = 16.0
_GAP_SCREEN_PX: Final = 6.0

# Of the sub-exposures along a trail every 1st, 2nd, 5th, 10th ... has a tick: the first that keeps them this far apart.
_TICK_SPACING_SCREEN_PX: Final = 6.0
# They reach this far beyond the trail's own width.
_TICK_SCREEN_PX: Final = 3.0
_TICKED_STARS: Final = 16

# So many saturated pixels are marked; of more an even share, which looks the same.
_MARKED_PIXELS: Final = 2000


class Overlay(StrEnum):
    """What can be drawn over an image."""

    STAR_NAMES = "star names"
    CONSTELLATIONS = "constellations"
    HORIZON = "horizon"
    ALTAZ_GRID = "altitude-azimuth grid"
    EQUATORIAL_GRID = "equatorial grid"
    AXIS = "optical axis"
    TICKS = "sub-exposure ticks"
    CENTROIDS = "truth centroids"
    SATURATED = "saturated pixels"


class Mark(StrEnum):
    """The form of a mark: all but a pixel have a size on the screen, whatever the zoom."""

    CROSS = "cross"
    TARGET = "target"
    RING = "ring"
    PIXEL = "pixel"


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Polylines of one overlay.

    Attributes
    ----------
    overlay : Overlay
    xy_px : (n, 2) float32
        Their points one after another, px of the image.
    starts : (m,) intp
        Which point is the first of each line.
    """

    overlay: Overlay
    xy_px: Pixels
    starts: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Texts of one overlay.

    Attributes
    ----------
    overlay : Overlay
    text : tuple of str, n long
    xy_px : (n, 2) float32
        Where they belong, px of the image.
    anchor : (n, 2) float32
        Which point of the text stands there, across and down: (0, 0.5) is the middle of its left edge.
    clear_px : float
        How far from there the text begins, px of the image: not on top of a bright star.
    """

    overlay: Overlay
    text: tuple[str, ...]
    xy_px: Pixels
    anchor: Pixels
    clear_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of one overlay.

    Attributes
    ----------
    overlay : Overlay
    mark : Mark
    xy_px : (n, 2) float32
        Their centres, px of the image.
    """

    overlay: Overlay
    mark: Mark
    xy_px: Pixels


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """All that is to be drawn over an image, the lowest first.

    Attributes
    ----------
    lines : tuple of Lines
    labels : tuple of Labels
    marks : tuple of Marks
    """

    lines: tuple[Lines, ...] = ()
    labels: tuple[Labels, ...] = ()
    marks: tuple[Marks, ...] = ()


class StarUnderCursor(NamedTuple):
    """A star that somebody points at.

    Attributes
    ----------
    catalogue : str
    star_id : int
        Its catalogue number.
    name : str
        What people call it; empty where it has no name.
    vmag : float
        Its magnitude.
    altitude_rad, azimuth_rad : float
        Where it appears in the middle of the exposure, with refraction; azimuth from north through east.
    x_px, y_px : float
        Its place on the image in the middle of the exposure, px; NaN where it is then behind the camera or under the
        horizon.
    """

    catalogue: str
    star_id: int
    name: str
    vmag: float
    altitude_rad: float
    azimuth_rad: float
    x_px: float
    y_px: float


class Overlays:
    """Makes the shapes of scenes; keeps what depends only on the catalogue, the epoch and the camera.

    Parameters
    ----------
    catalogue : StarCatalogue
        Where the stars at the ends of the constellations' lines get their proper motions from; the lines of those
        that it does not have end where the stars stood in J2000.
    """

    def __init__(self, catalogue: StarCatalogue) -> None:
        self._constellations = _Constellations(catalogue)
        self._grids: _Grids | None = None
        self._last: tuple[tuple[Any, ...], Scene, NDArray[Any] | None, Shapes] | None = None

    def shapes(
        self,
        scene: Scene,
        which: AbstractSet[Overlay],
        *,
        name_vmag_limit: float,
        pixels: NDArray[Any] | None = None,
        window: ImageRegion | None = None,
        zoom: float = 1.0,
        centroid_vmag_limit: float = 5.0,
    ) -> Shapes:
        """Return what is to be drawn over the image of a scene.

        Parameters
        ----------
        scene : Scene
        which : set of Overlay
        name_vmag_limit : float
            The faintest magnitude of a star that is named.
        pixels : (height, width) uint8 or uint16, optional
            The developed image, in which saturated pixels are looked for; without it the stars are marked whose peak
            should saturate.
        window : ImageRegion, optional
            The part of the image that is seen: lines end and grids are labelled at its edge.  The whole image without.
        zoom : float
            Pixels of the screen for one of the image: labels and ticks keep their distance on the screen.
        centroid_vmag_limit : float
            The faintest magnitude of a star whose centroid is marked.

        Returns
        -------
        Shapes
        """
        key = (frozenset(which), name_vmag_limit, window, zoom, centroid_vmag_limit)
        if self._last is not None and self._last[0] == key and self._last[1] is scene and self._last[2] is pixels:
            return self._last[3]
        if self._grids is None or self._grids.camera != scene.camera:
            self._grids = _Grids(scene.camera)
        canvas = _Canvas(scene, window, zoom, self._grids.reach_rad)
        among_eq = {
            Overlay.EQUATORIAL_GRID: self._grids.equatorial,
            Overlay.CONSTELLATIONS: self._constellations.curves(scene.stars.epoch_utc_s, scene.camera),
        }
        among_ned = {Overlay.ALTAZ_GRID: self._grids.altaz, Overlay.HORIZON: self._grids.horizon}
        crossings = canvas.sky_lines(
            {overlay: curves for overlay, curves in among_eq.items() if overlay in which},
            {overlay: curves for overlay, curves in among_ned.items() if overlay in which},
        )
        # Who comes first is written first.
        if Overlay.HORIZON in which:
            _compass(canvas, self._grids.winds)
        if Overlay.AXIS in which:
            _axis(canvas)
        if Overlay.STAR_NAMES in which:
            _star_names(canvas, name_vmag_limit)
        if Overlay.CONSTELLATIONS in which:
            self._constellations.write_names(canvas)
        for overlay, text in self._grids.text.items():
            if overlay in which:
                _edge_labels(canvas, overlay, text, crossings[overlay])
        if Overlay.TICKS in which:
            _ticks(canvas)
        if Overlay.SATURATED in which:
            _saturated(canvas, pixels)
        if Overlay.CENTROIDS in which:
            bright = scene.stars.vmag[scene.visible] <= centroid_vmag_limit
            canvas.mark(Overlay.CENTROIDS, Mark.CROSS, light_centroids(scene, bright))
        shapes = canvas.shapes()
        self._last = (key, scene, pixels, shapes)
        return shapes


def star_at(scene: Scene, x_px: float, y_px: float, *, within_px: float) -> StarUnderCursor | None:
    """Return the star whose trail passes near a place on the image.

    Parameters
    ----------
    scene : Scene
    x_px, y_px : float
        The place, px.
    within_px : float
        How far off the trail may be, px.  Of several stars the nearest is taken, where a magnitude counts as a tenth
        of this.

    Returns
    -------
    StarUnderCursor or None
    """
    place = np.array([x_px, y_px])
    # First every so many sub-exposures, with a margin for what the camera does between; then all, for what is near.
    stride = max(1, len(scene.pointing) // 8)
    few = scene.pointing[::stride]
    way = scene.camera.project(few.to_camera(scene.stars.direction_eq[scene.visible]))
    margin_px = _swing_px(scene, few, stride)
    around = np.flatnonzero(_distance_to_trail_px(way, place) <= within_px + margin_px + 1)
    nearest_px = np.full(len(around), np.inf)
    for moments in scene.pointing.blocks(len(around), overlap=1):
        xy = scene.camera.project(moments.to_camera(scene.stars.direction_eq[scene.visible[around]]))
        nearest_px = np.fmin(nearest_px, _distance_to_trail_px(xy, place))
    near = np.flatnonzero(nearest_px <= within_px)
    if not near.size:
        return None
    stars = scene.visible[around[near]]
    star = stars[np.argmin(nearest_px[near] / max(within_px, 1e-9) + 0.1 * scene.stars.vmag[stars])]
    in_camera = scene.shutter[1:2].to_camera(scene.stars.direction_eq[star : star + 1], through_ground=True)[0, 0]
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(in_camera @ _C_camera_ned(scene.shutter[1:2]))
    x, y = scene.camera.project(in_camera) if altitude_rad >= 0 else (np.nan, np.nan)
    return StarUnderCursor(
        catalogue=scene.stars.catalogue,
        star_id=int(scene.stars.star_id[star]),
        name=scene.stars.name[star],
        vmag=float(scene.stars.vmag[star]),
        altitude_rad=float(altitude_rad),
        azimuth_rad=float(azimuth_rad),
        x_px=float(x),
        y_px=float(y),
    )


def _swing_px(scene: Scene, few: Pointing, stride: int) -> float:
    """Return a bound on how far a star on the image is from where it was at the last of a few moments, px."""
    C_camera_eq = scene.pointing.C_camera_eq
    chord = C_camera_eq - np.repeat(few.C_camera_eq, stride, axis=0)[: len(C_camera_eq)]
    # The Frobenius norm of the difference of two rotations is sqrt(8) sin(angle / 2).
    swing_rad = 2 * np.arcsin(np.clip(np.sqrt((chord**2).sum(axis=(1, 2)).max() / 8), 0, 1))
    return float(swing_rad * scene.camera.most_px_per_rad)


def _distance_to_trail_px(xy: Float, place: Float) -> Float:
    """Return how far a place is from the trails (n, m, 2), (m,) px; NaN for stars without a place on the image."""
    if len(xy) == 1:
        return np.asarray(np.hypot(*np.moveaxis(xy[0] - place, -1, 0)))
    step = np.diff(xy, axis=0)
    to_place = place - xy[:-1]
    length2 = np.maximum(np.sum(step * step, axis=-1), 1e-18)
    along = np.clip(np.sum(step * to_place, axis=-1) / length2, 0, 1)
    off = to_place - along[..., np.newaxis] * step
    return np.asarray(np.fmin.reduce(np.hypot(off[..., 0], off[..., 1]), axis=0))


def _C_camera_ned(pointing: Pointing) -> Float:
    """Return the rotation from north, east, down to the camera at the first of some moments."""
    x, y, z = pointing.zenith_eq[0].tolist()
    from_axis = hypot(x, y)
    # East is the celestial pole x the zenith; on the Earth's axis any direction is as good a meridian as another.
    cosine, sine = (x / from_axis, y / from_axis) if from_axis > 1e-12 else (1.0, 0.0)
    C_ned_eq = np.array([[-z * cosine, -z * sine, from_axis], [-sine, cosine, 0.0], [-x, -y, -z]])
    return np.asarray(pointing.C_camera_eq[0] @ C_ned_eq.T)


def _away(vector: Float) -> Float:
    """Return vectors (n, 2) as labels are pushed by them: the larger component is 1 or -1; rightwards for none."""
    with np.errstate(invalid="ignore"):
        largest = np.abs(vector).max(axis=1, keepdims=True)
        sound = largest > 1e-6
    return np.where(sound, vector / np.where(sound, largest, 1.0), [1.0, 0.0])


class _Canvas:
    """One image that is being drawn over: its geometry, and the shapes so far."""

    def __init__(self, scene: Scene, window: ImageRegion | None, zoom: float, reach_rad: float) -> None:
        self.scene = scene
        self.camera: Camera = scene.camera
        whole = ImageRegion(-0.5, -0.5, self.camera.width_px - 0.5, self.camera.height_px - 0.5)
        self.window = whole if window is None else _common(whole, window)
        self.screen_px = 1 / zoom
        self.middle = scene.shutter[1:2]
        self.C_camera_ned = _C_camera_ned(self.middle)
        # The window's, and the horizon.
        self.planes = np.vstack([window_planes(self.camera, self.window), -self.C_camera_ned[:, 2]])
        self.reach_rad = reach_rad
        self._star_xy: Float | None = None
        self._trail_px: Float | None = None
        self._lines: list[Lines] = []
        self._marks: list[Marks] = []
        self._labels: dict[Overlay, list[tuple[str, tuple[float, float], tuple[float, float]]]] = {}
        # What is written already: from where to where, in every row of text on the screen.
        self._rows: defaultdict[int, list[tuple[float, float]]] = defaultdict(list)
        self._character_px = _CHARACTER_SCREEN_PX * self.screen_px
        self._line_px, self._gap_px = _LINE_SCREEN_PX * self.screen_px, _GAP_SCREEN_PX * self.screen_px

    @property
    def star_xy(self) -> Float:
        """Where the visible stars are as the shutter opens, in the middle, and as it closes, (3, k, 2) px."""
        if self._star_xy is None:
            directions = self.scene.stars.direction_eq[self.scene.visible]
            self._star_xy = self.camera.project(self.scene.shutter.to_camera(directions))
        return self._star_xy

    @property
    def trail_px(self) -> Float:
        """How long the trails of the visible stars are, (k,) px; NaN for those that are not whole."""
        if self._trail_px is None:
            step = self.star_xy[1:] - self.star_xy[:-1]
            self._trail_px = np.hypot(step[..., 0], step[..., 1]).sum(axis=0)
        return self._trail_px

    def sky_lines(
        self, among_eq: Mapping[Overlay, Curves], among_ned: Mapping[Overlay, Curves]
    ) -> dict[Overlay, Crossings]:
        """Add what the window shows of curves on the sky.

        Parameters
        ----------
        among_eq : mapping of Overlay to Curves
            Among geocentric apparent directions; they end at the horizon.
        among_ned : mapping of Overlay to Curves
            Among apparent directions north, east, down.

        Returns
        -------
        dict of Overlay to Crossings
            Where the curves of each cross the window's edge, counted from its own first curve.
        """
        near_eq = [
            curves.near(self.middle.boresight_eq[0], self.reach_rad + MOST_LIFT_RAD) for curves in among_eq.values()
        ]
        near_ned = [curves.near(self.C_camera_ned[2], self.reach_rad) for curves in among_ned.values()]
        if not near_eq + near_ned:
            return {}
        refracted = self.middle.to_camera(
            np.concatenate([np.empty((0, 3)), *(v for v, _, _ in near_eq)]), through_ground=True
        )
        turned = np.concatenate([np.empty((0, 3)), *(v for v, _, _ in near_ned)]) @ self.C_camera_ned.T
        vector = np.concatenate([refracted[0], turned])
        inside = vector @ self.planes.T
        if self.camera.lens is not None:
            # Behind a lens a window has no planes, but its edges are as straight as ever on the image.
            inside[:, :4] = inside_window(self.camera.project(vector), self.window)
        # What is drawn among apparent directions does not end at the horizon: some of it is the horizon.
        inside[len(refracted[0]) :, -1] = 1.0

        curves = [*among_eq.values(), *among_ned.values()]
        firsts = np.cumsum([0, *(each.count for each in curves)]).tolist()
        near = [*near_eq, *near_ned]
        curve = np.concatenate([own + first for (_, own, _), first in zip(near, firsts, strict=False)])
        joined = np.concatenate([own for _, _, own in near])
        seen_by_lens = np.isfinite(inside[:, 0])
        joined[:-1] &= seen_by_lens[:-1] & seen_by_lens[1:]
        lines, crossings = cut(vector, inside, joined, curve, self.camera)
        seen = {}
        for overlay, first, last in zip([*among_eq, *among_ned], firsts, firsts[1:], strict=False):
            self.line(overlay, lines.of_curves(first, last))
            seen[overlay] = crossings.of_curves(first, last)
        return seen

    def line(self, overlay: Overlay, lines: Polylines) -> None:
        """Add polylines."""
        if len(lines.starts):
            self._lines.append(Lines(overlay, lines.xy_px.astype(np.float32), lines.starts))

    def strokes(self, overlay: Overlay, ends_px: Float) -> None:
        """Add straight lines (n, 2, 2)."""
        if len(ends_px):
            starts = np.arange(0, 2 * len(ends_px), 2)
            self._lines.append(Lines(overlay, ends_px.reshape(-1, 2).astype(np.float32), starts))

    def mark(self, overlay: Overlay, mark: Mark, xy_px: Float) -> None:
        """Add marks, those of them that are in the window."""
        seen = xy_px[self.window.contains(xy_px)]
        if len(seen):
            self._marks.append(Marks(overlay, mark, seen.astype(np.float32)))

    def label(self, overlay: Overlay, text: str, xy_px: Sequence[float], anchor: Sequence[float]) -> bool:
        """Add a label where nothing is written yet, moved into the window, and tell whether there was room."""
        (x, y), (across, down) = xy_px, anchor
        rows = text.count("\n") + 1
        longest = len(text) if rows == 1 else max(map(len, text.split("\n")))
        line = self._line_px
        width, height = longest * self._character_px + self._gap_px, line * rows
        left = max(min(x - across * width, self.window.right_px - width), self.window.left_px)
        top = max(min(y - down * height, self.window.bottom_px - height), self.window.top_px)
        right, across, down = left + width, (x - left) / width, (y - top) / height
        first = floor(top / line)
        for row in range(first, first + rows + 1):
            for start, end in self._rows[row]:
                if left < end and start < right:
                    return False
        for row in range(first, first + rows + 1):
            self._rows[row].append((left, right))
        self._labels.setdefault(overlay, []).append((text, (x, y), (across, down)))
        return True

    def shapes(self) -> Shapes:
        """Return all that was added."""
        labels = tuple(
            Labels(
                overlay,
                text,
                np.array(xy, dtype=np.float32),
                np.array(anchor, dtype=np.float32),
                2 * self.scene.sensor.psf_sigma_px if overlay is Overlay.STAR_NAMES else 0.0,
            )
            for overlay, written in self._labels.items()
            for text, xy, anchor in [tuple(zip(*written, strict=True))]
        )
        return Shapes(tuple(self._lines), labels, tuple(self._marks))


def _common(a: ImageRegion, b: ImageRegion) -> ImageRegion:
    """Return what two windows have in common; nothing at all is a window without area."""
    left, top = max(a.left_px, b.left_px), max(a.top_px, b.top_px)
    return ImageRegion(left, top, max(left, min(a.right_px, b.right_px)), max(top, min(a.bottom_px, b.bottom_px)))


class _Grids:
    """The meshes for a camera: as fine as its image needs, no finer."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.reach_rad = camera.reach_rad
        degrees, minutes = next((pair for pair in _SPACINGS if np.deg2rad(pair[0]) <= camera.reach_rad), _SPACINGS[-1])
        last = 90 - degrees
        straight_rad, refracted_rad = finest_step_rad(camera, 0.0), finest_step_rad(camera, REFRACTION_BEND)

        circles, verticals = range(degrees, 90, degrees), range(0, 360, degrees)
        altaz = [_ned(parallel(h, finest_step_rad(camera, np.tan(h)))) for h in np.deg2rad(circles)]
        for azimuth in verticals:
            top = 90 if azimuth % 30 == 0 else last
            altaz.append(great_circle(ned_direction(np.deg2rad(azimuth), np.deg2rad([0, top])), straight_rad))

        parallels, meridians = range(-last, 90, degrees), range(0, 24 * 60, minutes)
        equatorial = [
            parallel(dec, finest_step_rad(camera, REFRACTION_BEND + abs(np.tan(dec)))) for dec in np.deg2rad(parallels)
        ]
        for minute in meridians:
            top = 90 if minute % 180 == 0 else last
            equatorial.append(
                great_circle(direction(np.deg2rad(minute / 4), np.deg2rad([-top, 0, top])), refracted_rad)
            )

        self.altaz, self.equatorial = Curves.of(altaz), Curves.of(equatorial)
        self.horizon = Curves.of([_ned(parallel(0.0, straight_rad))])
        self.winds = ned_direction(np.arange(len(_WINDS)) * (2 * np.pi / len(_WINDS)), 0.0)
        self.text = {
            Overlay.ALTAZ_GRID: (*(f"alt {h}°" for h in circles), *(f"az {az}°" for az in verticals)),
            Overlay.EQUATORIAL_GRID: (*(f"{dec:+d}°" if dec else "0°" for dec in parallels), *map(_hours, meridians)),
        }


def _ned(enu_like: Float) -> Float:
    """Return unit vectors by azimuth and altitude as north, east, down: longitude and latitude, upside down."""
    return enu_like * [1.0, 1.0, -1.0]


def _hours(minutes: int) -> str:
    hours, rest = divmod(minutes, 60)
    return f"{hours}h{rest:02d}" if rest else f"{hours}h"


def _edge_labels(canvas: _Canvas, overlay: Overlay, text: tuple[str, ...], crossings: Crossings) -> None:
    """Write the name of each line of a grid once, where it crosses the window's edge."""
    labelled: set[int] = set()
    for curve, xy, anchor in zip(*(each.tolist() for each in crossings), strict=True):
        if curve not in labelled and canvas.label(overlay, text[curve], xy, anchor):
            labelled.add(curve)


def _compass(canvas: _Canvas, winds_ned: Float) -> None:
    """Write the points of the compass under the horizon."""
    down = canvas.C_camera_ned[:, 2]
    winds = winds_ned @ canvas.C_camera_ned.T
    xy = canvas.camera.project(winds)
    downwards = _away(canvas.camera.project(winds + 1e-3 * down) - xy)
    seen = np.flatnonzero(canvas.window.contains(xy))
    ticks = np.stack([xy[seen], xy[seen] + downwards[seen] * _GAP_SCREEN_PX * canvas.screen_px], axis=1)
    canvas.strokes(Overlay.HORIZON, ticks)
    # The sixteenths give way to the quarters where there is no room for both.
    for wind in sorted(seen.tolist(), key=lambda wind: len(_WINDS[wind])):
        canvas.label(Overlay.HORIZON, _WINDS[wind], xy[wind].tolist(), (0.5 - 0.5 * downwards[wind]).tolist())


def _axis(canvas: _Canvas) -> None:
    """Draw where the optical axis pierces the image, and which way the zenith is from there."""
    camera, (right, down, _) = canvas.camera, -canvas.C_camera_ned[:, 2]
    centre = np.array([camera.cx_px, camera.cy_px])
    if not canvas.window.contains(centre):
        return
    canvas.mark(Overlay.AXIS, Mark.TARGET, centre[np.newaxis])
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(canvas.C_camera_ned[2])
    words = f"alt {np.rad2deg(altitude_rad):.2f}°  az {np.rad2deg(azimuth_rad):.2f}°"
    uphill = np.array([camera.fx_px * right + camera.skew_px * down, camera.fy_px * down])
    steepness = np.linalg.norm(uphill)
    # Straight up or straight down no way is uphill, and there is no roll.
    if np.hypot(right, down) > 1e-6:
        tip = centre + uphill / steepness * (8 * _GAP_SCREEN_PX * canvas.screen_px)
        canvas.strokes(Overlay.AXIS, np.array([[centre, tip]]))
        words += f"\nroll {np.rad2deg(np.arctan2(-right, -down)):+.2f}°"
    canvas.label(Overlay.AXIS, words, centre.tolist(), (0.0, 0.0))


def _star_names(canvas: _Canvas, vmag_limit: float) -> None:
    """Write the names of bright stars where their trails begin, beyond the end; else at the other end, or between."""
    stars, visible = canvas.scene.stars, canvas.scene.visible
    bright = np.flatnonzero(stars.vmag[visible] <= vmag_limit)
    bright = bright[np.argsort(stars.vmag[visible[bright]], kind="stable")]
    start, middle, end = canvas.star_xy[:, bright]
    across = (end - start)[:, ::-1] * [-1, 1]
    ends = np.array([start, end, middle])
    seen = canvas.window.contains(ends)
    chosen = seen.argmax(axis=0), np.arange(len(bright))
    xy = ends[chosen].tolist()
    anchor = (0.5 - 0.5 * _away(np.array([start - middle, end - middle, across])[chosen])).tolist()
    for i in np.flatnonzero(seen.any(axis=0)).tolist():
        if name := stars.name[visible[bright[i]]]:
            canvas.label(Overlay.STAR_NAMES, name, xy[i], anchor[i])


def _ticks(canvas: _Canvas) -> None:
    """Draw strokes across the trails of the brightest stars in sight, one every so many sub-exposures."""
    scene = canvas.scene
    n = scene.exposure.min_sub_exposures if scene.exposure.trail == "analytic" else len(scene.pointing)
    seen = np.flatnonzero(canvas.window.contains(canvas.star_xy).any(axis=0))
    brightest = seen[np.argsort(scene.stars.vmag[scene.visible[seen]], kind="stable")[:_TICKED_STARS]]
    whole = sorted(trail for trail in canvas.trail_px[brightest].tolist() if isfinite(trail))
    median_px = whole[len(whole) // 2] if whole else 0.0
    least_px = _TICK_SPACING_SCREEN_PX * canvas.screen_px
    if median_px < least_px:
        return
    stride = _round_stride(least_px * n / median_px)
    directions = scene.stars.direction_eq[scene.visible[brightest]]
    xy = scene.places(directions, (np.arange(0, n, stride) + 0.5) / n)
    if len(xy) < 2:
        return
    along = np.diff(xy, axis=0)
    along = np.concatenate([along, along[-1:]])
    length = np.hypot(along[..., :1], along[..., 1:])
    drawn = canvas.window.contains(xy) & (length[..., 0] > 1e-9)
    across = (
        along[drawn][:, ::-1]
        * [-1, 1]
        / length[drawn]
        * (_TICK_SCREEN_PX * canvas.screen_px + 2 * scene.sensor.psf_sigma_px)
    )
    ends = np.stack([xy[drawn] - across, xy[drawn] + across], axis=1)
    canvas.strokes(Overlay.TICKS, ends)


def _round_stride(least: float) -> int:
    """Return the smallest of 1, 2, 5, 10, 20, 50 ... that is not less."""
    stride = 1
    for factor in chain((1,), (factor for _ in range(12) for factor in (2, 2.5, 2))):
        stride = round(stride * factor)
        if stride >= least:
            break
    return stride


def _saturated(canvas: _Canvas, pixels: NDArray[Any] | None) -> None:
    """Mark the pixels at the sensor's limit, or, without an image, the stars whose peak should reach it."""
    scene = canvas.scene
    if pixels is not None:
        left, top, right, bottom = (round(edge) for edge in canvas.window)
        seen = pixels[max(top, 0) : bottom + 1, max(left, 0) : right + 1]
        # Row by row, most of which have none: over twice as fast as to look at every pixel.
        rows = np.flatnonzero(seen.max(axis=1, initial=0) >= scene.sensor.saturation_dn)
        row, column = np.nonzero(seen[rows] >= scene.sensor.saturation_dn)
        xy = np.stack([column + max(left, 0), rows[row] + max(top, 0)], axis=1)
        xy = xy[:: max(1, -(-len(xy) // _MARKED_PIXELS))]
        canvas.mark(Overlay.SATURATED, Mark.PIXEL, xy.astype(np.float64))
        return
    sensor, index = scene.sensor, scene.visible
    spread_over = np.maximum(1.0, canvas.trail_px / (sensor.drawn_sigma_px * np.sqrt(2 * np.pi)))
    amplitude_dn = (
        sensor.peak_dn(scene.stars.camera_mag[index], scene.exposure.duration_s) * sensor.drawn_peak / spread_over
    )
    reaches = amplitude_dn + sensor.sky_mean_dn >= sensor.saturation_dn
    canvas.mark(Overlay.SATURATED, Mark.RING, canvas.star_xy[1, reaches])


class _Constellations:
    """The constellations' lines, brought to the epoch of a star field and as fine as a camera needs, once for both."""

    def __init__(self, catalogue: StarCatalogue) -> None:
        parts = constellations()
        self._names = tuple(part.name for part in parts)
        self._labels = np.array([part.label_rad for part in parts])
        lines = [line for part in parts for line in part.lines_rad]
        self._lengths = [len(line) for line in lines]
        self._ends = _with_motion(np.concatenate(lines), catalogue)
        self._made_for: tuple[float, Camera] | None = None
        self._curves = Curves.of([])
        self._label_eq = np.empty((0, 3))

    def curves(self, epoch_utc_s: float, camera: Camera) -> Curves:
        """Return the lines among geocentric apparent directions."""
        self._prepare(epoch_utc_s, camera)
        return self._curves

    def write_names(self, canvas: _Canvas) -> None:
        """Write the names where they have room."""
        self._prepare(canvas.scene.stars.epoch_utc_s, canvas.camera)
        near = np.flatnonzero(self._label_eq @ canvas.middle.boresight_eq[0] > np.cos(canvas.reach_rad + MOST_LIFT_RAD))
        xy = canvas.camera.project(canvas.middle.to_camera(self._label_eq[near])[0])
        for i in np.flatnonzero(canvas.window.contains(xy)).tolist():
            canvas.label(Overlay.CONSTELLATIONS, self._names[near[i]], xy[i].tolist(), (0.5, 0.5))

    def _prepare(self, epoch_utc_s: float, camera: Camera) -> None:
        if self._made_for == (epoch_utc_s, camera):
            return
        # Either road of astrometry will do: they agree to 0.7".
        to_apparent = ASTROMETRY["erfa"].apparent_directions
        ends = np.split(to_apparent(*self._ends, epoch_utc_s), np.cumsum(self._lengths)[:-1])
        step_rad = finest_step_rad(camera, REFRACTION_BEND)
        self._curves = Curves.of([great_circle(line, step_rad) for line in ends])
        still = np.zeros(len(self._labels))
        self._label_eq = to_apparent(self._labels[:, 0], self._labels[:, 1], still, still, epoch_utc_s)
        self._made_for = (epoch_utc_s, camera)


def _with_motion(places_rad: Float, catalogue: StarCatalogue) -> tuple[Float, Float, Float, Float]:
    """Return places (n, 2) of J2000 as the stars' own, with their proper motions: as the catalogue's columns."""
    ra_rad, dec_rad = places_rad.T.copy()
    pm_ra, pm_dec = np.zeros_like(ra_rad), np.zeros_like(ra_rad)
    bright = np.flatnonzero(catalogue.vmag <= _FAINTEST_OF_A_LINE_VMAG)
    bright = bright[np.argsort(catalogue.dec_rad[bright])]
    star_dec = catalogue.dec_rad[bright]
    star_direction, place = catalogue.direction[bright], direction(ra_rad, dec_rad)
    south = np.searchsorted(star_dec, dec_rad - _SAME_STAR_RAD)
    north = np.searchsorted(star_dec, dec_rad + _SAME_STAR_RAD)
    for i, (first, last) in enumerate(zip(south.tolist(), north.tolist(), strict=True)):
        chord = np.linalg.norm(star_direction[first:last] - place[i], axis=1)
        if chord.size and chord.min() < _SAME_STAR_RAD:
            star = bright[first + int(chord.argmin())]
            ra_rad[i], dec_rad[i] = catalogue.ra_rad[star], catalogue.dec_rad[star]
            pm_ra[i], pm_dec[i] = catalogue.pm_ra_cosdec_rad_per_yr[star], catalogue.pm_dec_rad_per_yr[star]
    return ra_rad, dec_rad, pm_ra, pm_dec
