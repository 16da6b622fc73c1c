"""The overlays: one table of what can be drawn over the image, with a function each.

`Overlays.shapes` turns a scene into lines, labels and marks in pixels of the image, without a window and without
OpenGL; `glstar.viewer.ui.panels.imagelayers` draws them.  Everything is drawn where the sky is in the middle of the
exposure, with refraction: an altitude or azimuth read off the image is the apparent one.

To add an overlay, write its function and add a row to the table `Overlay`.  The menu, the keys, ``--show``, the
checkboxes and the table of keys in the manual are made from the rows.
"""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from math import isfinite
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.render.readout.rows import recorded_positions
from glstar.render.scene.scene import Scene
from glstar.render.truth.frame import trail_centroids
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.sky.catalogue.messier import messier_objects
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.viewer.overlays.belief import Belief
from glstar.viewer.overlays.canvas import (
    GAP_SCREEN_PX,
    Canvas,
    Mark,
    Shapes,
    arrow_strokes,
    ned_to_camera_matrix,
    residual_scale,
    round_stride,
    unit_by_larger_component,
)
from glstar.viewer.overlays.curves import (
    COMPASS_POINTS,
    ConstellationFigures,
    Curves,
    Grids,
    ImageRegion,
    compass_ned,
    horizon_curve,
)
from glstar.viewer.picture.fitting import TrailResiduals

Rgba = tuple[int, int, int, int]

# Ticks along a trail: every 1st, 2nd, 5th, 10th ... sub-exposure, at least this distance from each other.
_TICK_SPACING_SCREEN_PX = 6.0
# Length of a tick beyond the width of the trail, to either side.
_TICK_SCREEN_PX = 3.0
# Number of the brightest visible stars whose trails have ticks.
_TICKED_STARS = 16

# Largest number of saturated pixels that are marked; of more, every second, third ... one is marked.
_MARKED_PIXELS = 2000


@dataclass(frozen=True, slots=True, eq=False)
class DrawingInputs:
    """Inputs of the functions of the overlays, besides the scene."""

    grids: Grids
    constellations: ConstellationFigures
    name_vmag_limit: float  # Magnitude limit of star names
    centroid_vmag_limit: float  # Magnitude limit of centroids
    # (height, width) the developed image, uint8 or uint16; or bool: where a short exposure of a stacked one is
    # saturated.
    pixels: NDArray[Any] | None
    beliefs: tuple[Belief, ...] = ()  # What the navigator believes
    residuals: TrailResiduals | None = None  # Residuals of the real image


class SkyCurves(NamedTuple):
    """Curves of an overlay that are cut at the edges of the image."""

    # Geocentric apparent directions, which end at the horizon; or apparent directions north, east, down.
    frame: Literal["eq", "ned"]
    of: Callable[[Scene, DrawingInputs], Curves]  # Returns the curves for a scene


@dataclass(frozen=True, slots=True)
class OverlaySpec:
    """An overlay.

    Attributes
    ----------
    label : str
        In the menu; ``--show`` accepts it in lower case.
    key : str
        The key that shows and hides it.
    rank : int
        Labels of an overlay of lower rank are placed first, and its curves are drawn on top.
    colour : tuple of int
        Red, green, blue, opacity, 0 to 255; labels are opaque.
    night_red : int
        Its red by night, when overlays differ in brightness instead of hue.
    thickness : float
        Of lines, screen px.
    curves : SkyCurves or None
    draw : callable or None
        Adds labels, marks and strokes to the canvas, after the curves.
    clears_stars : bool
        Whether its labels keep clear of the light of the star at their position.
    """

    label: str
    key: str
    rank: int
    colour: Rgba
    night_red: int
    thickness: float = 1.0
    curves: SkyCurves | None = None
    draw: Callable[[Canvas, DrawingInputs], None] | None = None
    clears_stars: bool = False


# --- the functions of the overlays ---


def _draw_edge_labels(canvas: Canvas, text: tuple[str, ...]) -> None:
    """Label each curve of a grid once, where it crosses the edge of the region."""
    labelled: set[int] = set()
    crossings = canvas.crossings[canvas.current]
    for curve, xy, anchor in zip(*(each.tolist() for each in crossings), strict=True):
        if curve not in labelled and canvas.label(text[curve], xy, anchor):
            labelled.add(curve)


def _draw_altaz_labels(canvas: Canvas, inputs: DrawingInputs) -> None:
    _draw_edge_labels(canvas, inputs.grids.altaz_labels)


def _draw_equatorial_labels(canvas: Canvas, inputs: DrawingInputs) -> None:
    _draw_edge_labels(canvas, inputs.grids.equatorial_labels)


def _draw_compass(canvas: Canvas, _: DrawingInputs) -> None:
    """Draw the compass points below the horizon."""
    down = canvas.C_camera_ned[:, 2]
    points = compass_ned(canvas.scene.sine_horizon, canvas.scene.shutter.profile) @ canvas.C_camera_ned.T
    xy = canvas.camera.project(points)
    downwards = unit_by_larger_component(canvas.camera.project(points + 1e-3 * down) - xy)
    visible = np.flatnonzero(canvas.region.contains(xy))
    ticks = np.stack([xy[visible], xy[visible] + downwards[visible] * GAP_SCREEN_PX * canvas.screen_px], axis=1)
    canvas.strokes(ticks)
    # Points with short names, the quarters, are placed first.
    for point in sorted(visible.tolist(), key=lambda point: len(COMPASS_POINTS[point])):
        canvas.label(COMPASS_POINTS[point], xy[point].tolist(), (0.5 - 0.5 * downwards[point]).tolist())


def _draw_axis(canvas: Canvas, _: DrawingInputs) -> None:
    """Draw the principal point, its altitude and azimuth, and the direction of the zenith from there."""
    camera, (right, down, _) = canvas.camera, -canvas.C_camera_ned[:, 2]
    centre = np.array([camera.cx_px, camera.cy_px])
    if not canvas.region.contains(centre):
        return
    canvas.mark(Mark.TARGET, centre[np.newaxis])
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(canvas.C_camera_ned[2])
    text = f"alt {np.rad2deg(altitude_rad):.2f}°  az {np.rad2deg(azimuth_rad):.2f}°"
    zenithwards = np.array([camera.fx_px * right + camera.skew_px * down, camera.fy_px * down])
    # A camera that points straight up or down has no roll.
    if np.hypot(right, down) > 1e-6:
        tip = centre + zenithwards / np.linalg.norm(zenithwards) * (8 * GAP_SCREEN_PX * canvas.screen_px)
        canvas.strokes(np.array([[centre, tip]]))
        text += f"\nroll {np.rad2deg(np.arctan2(-right, -down)):+.2f}°"
    canvas.label(text, centre.tolist(), (0.0, 0.0))


def _draw_star_names(canvas: Canvas, inputs: DrawingInputs) -> None:
    """Write the names of bright stars beyond an end of their trails or beside the middle, and of satellites."""
    stars, visible = canvas.scene.stars, canvas.scene.visible
    bright = np.flatnonzero(stars.vmag[visible] <= inputs.name_vmag_limit)
    bright = bright[np.argsort(stars.vmag[visible[bright]], kind="stable")]
    start, middle, end = canvas.recorded_xy(bright)
    across = (end - start)[:, ::-1] * [-1, 1]
    ends = np.array([start, end, middle])
    inside = canvas.region.contains(ends)
    chosen = inside.argmax(axis=0), np.arange(len(bright))
    xy = ends[chosen].tolist()
    outwards = unit_by_larger_component(np.array([start - middle, end - middle, across])[chosen])
    anchor = (0.5 - 0.5 * outwards).tolist()
    for i in np.flatnonzero(inside.any(axis=0)).tolist():
        if name := stars.name[visible[bright[i]]]:
            canvas.label(name, xy[i], anchor[i])
    for satellite in canvas.scene.satellites:
        (at,) = satellite.camera.project(satellite.shutter[1:2].to_camera(satellite.stars.direction_eq))[0]
        if canvas.region.contains(at):
            canvas.label(satellite.stars.name[0], at.tolist(), (0.0, 0.0))


@lru_cache(maxsize=4)
def _deep_sky_eq(epoch_utc_s: float) -> NDArray[np.float64]:
    """Return the apparent directions of Messier's objects, (110, 3)."""
    ra_rad, dec_rad = np.array([(each.ra_rad, each.dec_rad) for each in messier_objects()]).T
    none = np.zeros(ra_rad.size)
    return np.asarray(ASTROMETRY["erfa"].apparent_directions(ra_rad, dec_rad, none, none, epoch_utc_s))


def _draw_deep_sky(canvas: Canvas, _: DrawingInputs) -> None:
    """Draw a ring around each of Messier's objects, the brightest first, with its number."""
    direction_eq = _deep_sky_eq(canvas.scene.stars.epoch_utc_s)
    xy = canvas.camera.project(canvas.middle.to_camera(direction_eq)[0])
    visible = np.flatnonzero(canvas.region.contains(xy))
    canvas.mark(Mark.RING, xy[visible])
    objects = messier_objects()
    for i in sorted(visible.tolist(), key=lambda i: objects[i].vmag):
        canvas.label(objects[i].label, (xy[i] + GAP_SCREEN_PX * canvas.screen_px * 0.7).tolist(), (0.0, 0.0))


def _draw_constellation_names(canvas: Canvas, inputs: DrawingInputs) -> None:
    figures = inputs.constellations
    label_eq = figures.label_eq(canvas.scene.stars.epoch_utc_s, canvas.camera)
    near = np.flatnonzero(label_eq @ canvas.middle.boresight_eq[0] > np.cos(canvas.radius_rad + MAX_REFRACTION_RAD))
    xy = canvas.camera.project(canvas.middle.to_camera(label_eq[near])[0])
    for i in np.flatnonzero(canvas.region.contains(xy)).tolist():
        canvas.label(figures.names[near[i]], xy[i].tolist(), (0.5, 0.5))


def _draw_ticks(canvas: Canvas, _: DrawingInputs) -> None:
    """Draw ticks across the trails of the brightest visible stars at evenly spaced sub-exposures."""
    scene = canvas.scene
    n = scene.exposure.min_sub_exposures if scene.exposure.trail == "analytic" else len(scene.trails.pointing)
    inside = np.flatnonzero(canvas.region.contains(canvas.star_xy).any(axis=0))
    brightest = inside[np.argsort(scene.stars.vmag[scene.visible[inside]], kind="stable")[:_TICKED_STARS]]
    lengths_px = sorted(length for length in canvas.trail_px[brightest].tolist() if isfinite(length))
    median_px = lengths_px[len(lengths_px) // 2] if lengths_px else 0.0
    spacing_px = _TICK_SPACING_SCREEN_PX * canvas.screen_px
    if median_px < spacing_px:
        return
    stride = round_stride(spacing_px * n / median_px)
    if scene.exposure.readout_s > 0:  # each row records a part of the time
        n = max(1, round(n * scene.exposure.frames * scene.exposure.duration_s / scene.exposure.span_s))
    directions = scene.stars.direction_eq[scene.visible[brightest]]
    xy = recorded_positions(scene, directions, (np.arange(0, n, stride) + 0.5) / n)
    if len(xy) < 2:
        return
    along = np.diff(xy, axis=0)
    along = np.concatenate([along, along[-1:]])
    length = np.hypot(along[..., :1], along[..., 1:])
    drawn = canvas.region.contains(xy) & (length[..., 0] > 1e-9)
    across = (
        along[drawn][:, ::-1]
        * [-1, 1]
        / length[drawn]
        * (_TICK_SCREEN_PX * canvas.screen_px + 2 * scene.sensor.psf_sigma_px)
    )
    canvas.strokes(np.stack([xy[drawn] - across, xy[drawn] + across], axis=1))


def _draw_centroids(canvas: Canvas, inputs: DrawingInputs) -> None:
    scene = canvas.scene
    bright = scene.stars.vmag[scene.visible] <= inputs.centroid_vmag_limit
    canvas.mark(Mark.CROSS, trail_centroids(scene, bright))


def _draw_saturated(canvas: Canvas, inputs: DrawingInputs) -> None:
    """Mark the saturated pixels; without an image, the stars whose peak should saturate."""
    scene, pixels = canvas.scene, inputs.pixels
    if pixels is not None:
        left, top, right, bottom = (round(edge) for edge in canvas.region)
        inside = pixels[max(top, 0) : bottom + 1, max(left, 0) : right + 1]
        least = 1 if pixels.dtype == np.bool_ else scene.sensor.saturation_dn
        # Rows first, because most have no saturated pixel: over twice as fast as searching all pixels.
        rows = np.flatnonzero(inside.max(axis=1, initial=0) >= least)
        row, column = np.nonzero(inside[rows] >= least)
        xy = np.stack([column + max(left, 0), rows[row] + max(top, 0)], axis=1)
        xy = xy[:: max(1, -(-len(xy) // _MARKED_PIXELS))]
        canvas.mark(Mark.PIXEL, xy.astype(np.float64))
        return
    sensor = scene.sensor
    spread_over = np.maximum(1.0, canvas.trail_px / (sensor.effective_sigma_px * np.sqrt(2 * np.pi)))
    peak_dn = sensor.peak_dn(scene.observed_mag, scene.exposure.duration_s) * sensor.effective_peak / spread_over
    saturates = peak_dn + sensor.background_mean_dn(scene.exposure.duration_s) >= sensor.saturation_dn
    canvas.mark(Mark.RING, canvas.recorded_xy(saturates)[1])


def _estimated_horizon(scene: Scene, inputs: DrawingInputs) -> Curves:
    """Return the horizon where the estimated attitude has it on the image."""
    C_camera_ned = ned_to_camera_matrix(scene.shutter[1:2])
    horizon = horizon_curve(scene.camera, scene.sine_horizon, scene.shutter.profile)
    for belief in inputs.beliefs:
        if belief.C_estimated_ned is not None:
            return replace(horizon, vector=horizon.vector @ (C_camera_ned.T @ belief.C_estimated_ned).T)
    return Curves.of([])


def _draw_beliefs(canvas: Canvas, inputs: DrawingInputs) -> None:
    """Draw an arrow from the optical axis to the direction that a navigator estimates for it.

    A belief without an attitude is written at the axis.
    """
    camera = canvas.camera
    centre = np.array([camera.cx_px, camera.cy_px])
    for belief in inputs.beliefs:
        if belief.C_camera_estimated is None:
            where = "; position only: on the map" if belief.offset_km is not None else ""
            canvas.label(f"{belief.name}: {belief.figures}{where}", centre.tolist(), (0.5, 1.0))
            continue
        axis = belief.C_camera_estimated[:, 2]
        sideways = np.array([camera.fx_px * axis[0] + camera.skew_px * axis[1], camera.fy_px * axis[1]])
        at = camera.project(axis) if axis[2] > 0 else np.full(2, np.nan)
        if canvas.region.contains(at):
            canvas.mark(Mark.TARGET if belief.C_estimated_ned is not None else Mark.RING, at[np.newaxis])
        else:
            # Towards an axis outside of the image, as far as half of the distance to the edge.
            at = centre + sideways / np.linalg.norm(sideways) * min(camera.width_px, camera.height_px) / 4
        if np.linalg.norm(at - centre) > GAP_SCREEN_PX * canvas.screen_px:
            canvas.strokes(arrow_strokes(centre[np.newaxis], at[np.newaxis], 2 * GAP_SCREEN_PX * canvas.screen_px))
        if belief.has_ghost:
            canvas.ring_stars(belief.C_camera_estimated, inputs.name_vmag_limit)
        below = 0.0 if axis[1] >= 0 else 1.0
        text = f"{belief.name}: {belief.figures}"
        # Two beliefs at the same place: the second one is written on the other side.
        for anchor in ((0.0, below), (0.0, 1.0 - below), (1.0, below)):
            if canvas.label(text, at.tolist(), anchor):
                break


def _draw_residuals(canvas: Canvas, inputs: DrawingInputs) -> None:
    """Draw an arrow from each trail of the real image towards the simulated one, all lengthened alike."""
    residuals = inputs.residuals
    if residuals is None or not len(residuals.shift_px):
        return
    scale = residual_scale(residuals.shift_px, canvas.screen_px)
    canvas.mark(Mark.CROSS, residuals.real_px)
    moved = np.any(residuals.shift_px != 0, axis=1)
    tails_px = residuals.real_px[moved]
    tips_px = tails_px + scale * residuals.shift_px[moved]
    canvas.strokes(arrow_strokes(tails_px, tips_px, GAP_SCREEN_PX * canvas.screen_px))
    corner = canvas.region.left_px, canvas.region.bottom_px
    canvas.label(f"arrows {scale:g} x: from the detected to the simulated trail", corner, (0.0, 1.0))


# --- the table ---


class Overlay(StrEnum):
    """What can be drawn over an image; the value is its short name, which ``--show`` accepts too."""

    spec: OverlaySpec

    def __new__(cls, name: str, spec: OverlaySpec) -> "Overlay":
        """Return a member, which is its name, with its specification."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.spec = spec
        return member

    STAR_NAMES = (
        "star names",
        OverlaySpec("Names of stars", "V", 2, (232, 228, 212, 230), 220, draw=_draw_star_names, clears_stars=True),
    )
    CONSTELLATIONS = (
        "constellations",
        OverlaySpec(
            "Constellations",
            "C",
            3,
            (150, 138, 214, 150),
            140,
            thickness=1.25,
            curves=SkyCurves("eq", lambda s, inputs: inputs.constellations.curves(s.stars.epoch_utc_s, s.camera)),
            draw=_draw_constellation_names,
        ),
    )
    HORIZON = (
        "horizon",
        OverlaySpec(
            "Horizon and compass points",
            "G",
            0,
            (126, 186, 108, 220),
            180,
            thickness=1.5,
            curves=SkyCurves("ned", lambda s, _: horizon_curve(s.camera, s.sine_horizon, s.shutter.profile)),
            draw=_draw_compass,
        ),
    )
    ALTAZ_GRID = (
        "altitude-azimuth grid",
        OverlaySpec(
            "Altitude and azimuth",
            "Z",
            4,
            (206, 150, 92, 96),
            120,
            curves=SkyCurves("ned", lambda _, inputs: inputs.grids.altaz),
            draw=_draw_altaz_labels,
        ),
    )
    EQUATORIAL_GRID = (
        "equatorial grid",
        OverlaySpec(
            "Right ascension and declination",
            "E",
            5,
            (88, 158, 196, 96),
            100,
            curves=SkyCurves("eq", lambda _, inputs: inputs.grids.equatorial),
            draw=_draw_equatorial_labels,
        ),
    )
    DEEP_SKY = (
        "deep-sky objects",
        OverlaySpec("Deep-sky objects of Messier", "O", 3, (145, 205, 210, 220), 150, draw=_draw_deep_sky),
    )
    AXIS = ("optical axis", OverlaySpec("Optical axis and roll", "A", 1, (250, 92, 92, 230), 255, draw=_draw_axis))
    TICKS = (
        "sub-exposure ticks",
        OverlaySpec("Sub-exposures along the trails", "K", 6, (238, 212, 120, 200), 170, draw=_draw_ticks),
    )
    CENTROIDS = (
        "truth centroids",
        OverlaySpec("True centroids", "P", 8, (96, 224, 168, 230), 230, draw=_draw_centroids),
    )
    SATURATED = (
        "saturated pixels",
        OverlaySpec("Saturated pixels", "U", 7, (255, 84, 168, 220), 255, draw=_draw_saturated),
    )
    NAVIGATOR = (
        "navigator",
        OverlaySpec(
            "Estimate and answer",
            "B",
            0,
            (255, 196, 64, 230),
            255,
            thickness=1.5,
            curves=SkyCurves("ned", _estimated_horizon),
            draw=_draw_beliefs,
        ),
    )
    RESIDUALS = (
        "residuals",
        OverlaySpec(
            "Residuals: from trails of the real image to the simulated ones",
            "Shift+R",
            1,
            (64, 232, 255, 240),
            240,
            thickness=1.5,
            draw=_draw_residuals,
        ),
    )

    @classmethod
    def named(cls) -> "dict[str, Overlay]":
        """Return the overlays by their labels in lower case, in the order of the menu."""
        return {overlay.spec.label.lower(): overlay for overlay in cls}


class Overlays:
    """Computes the shapes of scenes; caches what depends only on the catalogue, the epoch and the camera."""

    def __init__(self, catalogue: StarCatalogue) -> None:
        self._constellations = ConstellationFigures(catalogue)
        self._grids: Grids | None = None
        self._last: tuple[tuple[Any, ...], Scene, NDArray[Any] | None, Shapes] | None = None

    def shapes(
        self,
        scene: Scene,
        which: AbstractSet[Overlay],
        *,
        name_vmag_limit: float,
        pixels: NDArray[Any] | None = None,
        region: ImageRegion | None = None,
        zoom: float = 1.0,
        centroid_vmag_limit: float = 5.0,
        beliefs: tuple[Belief, ...] = (),
        residuals: TrailResiduals | None = None,
        reserved: tuple[ImageRegion, ...] = (),
        selected: str = "",
    ) -> Shapes:
        """Return the shapes to draw over the image of a scene.

        `pixels`: see `DrawingInputs`, as the other inputs; without them the stars whose peak should saturate are
        marked.  `region`: the visible part of the image, by default all of it: lines end and grids are labelled at its
        edge.  `zoom`: screen pixels to one image pixel: the size of labels and ticks on the screen does not depend on
        it.  `reserved`: parts of the image without labels.  `selected`: name of the selected object, which no label
        repeats.
        """
        names = (name_vmag_limit, reserved, selected)
        key = (frozenset(which), names, region, zoom, centroid_vmag_limit, beliefs, residuals)
        if self._last is not None and self._last[0] == key and self._last[1] is scene and self._last[2] is pixels:
            return self._last[3]
        if self._grids is None or self._grids.camera != scene.camera:
            self._grids = Grids(scene.camera)
        inputs = DrawingInputs(
            self._grids,
            self._constellations,
            name_vmag_limit,
            centroid_vmag_limit,
            pixels=pixels,
            beliefs=beliefs,
            residuals=residuals,
        )
        canvas = Canvas(scene, region, zoom, scene.camera.field_radius_rad)
        canvas.selected = selected
        for part in reserved:
            canvas.reserve(part)
        by_rank = sorted(which, key=lambda overlay: overlay.spec.rank)
        curves: dict[str, dict[str, Curves]] = {"eq": {}, "ned": {}}
        for overlay in reversed(by_rank):
            if overlay.spec.curves is not None:
                curves[overlay.spec.curves.frame][overlay] = overlay.spec.curves.of(scene, inputs)
        canvas.sky_lines(curves["eq"], curves["ned"])
        for overlay in by_rank:
            canvas.current = overlay
            canvas.label_clear_px = 2 * scene.sensor.psf_sigma_px if overlay.spec.clears_stars else 0.0
            if overlay.spec.draw is not None:
                overlay.spec.draw(canvas, inputs)
        self._last = (key, scene, pixels, canvas.shapes())
        return self._last[3]
