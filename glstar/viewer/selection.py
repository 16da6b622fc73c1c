"""The object of the sky that the user has selected, and what is known of it in the exposure shown."""

import json
from dataclasses import dataclass
from math import erf, pi, sqrt
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.render.recordedpaths import recorded_positions
from glstar.render.scene import Frame, Scene
from glstar.render.simulator import Simulator
from glstar.render.truth import frame_truth
from glstar.sky.catalogue import StarCatalogue
from glstar.viewer.objectplace import ObjectPlace, object_place, time_in_image_s
from glstar.viewer.skysearch import ObjectKind, SkyObject, SkySearch, object_direction_eq

__all__ = ["CutOut", "Selection", "star_cut_out", "star_signal_to_noise"]

Float = NDArray[np.float64]
Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_erf = np.vectorize(erf, otypes=[np.float64])

# Half the side of the cut-out and half the length of its profile, px.
_CUT_OUT_PX: Final = 12
# Interval around the middle of the exposure over which the star's speed is measured, as a fraction of the exposure.
_SPEED_FRACTION: Final = 0.01


class Selection:
    """The selected object.

    Attributes
    ----------
    selected : SkyObject or None
    """

    def __init__(self) -> None:
        self.selected: SkyObject | None = None
        self._search: tuple[StarCatalogue, SkySearch] | None = None
        self._direction: tuple[tuple[object, ...], Float | None] | None = None
        self._truth: tuple[tuple[object, ...], dict[str, Any] | None] | None = None

    def search(self, catalogue: StarCatalogue) -> SkySearch:
        """Return the search of a catalogue, made when it is first needed.

        Parameters
        ----------
        catalogue : StarCatalogue

        Returns
        -------
        SkySearch
        """
        if self._search is None or self._search[0] is not catalogue:
            self._search = catalogue, SkySearch(catalogue)
        return self._search[1]

    def select(self, found: SkyObject | None, simulator: Simulator, scene: Scene) -> str:
        """Select an object, or none.

        Parameters
        ----------
        found : SkyObject or None
        simulator : Simulator
        scene : Scene
            The exposure shown.

        Returns
        -------
        str
            Where the object is, as a message; empty if nothing was selected.
        """
        self.selected = found
        if found is None or (place := self.place(simulator, scene)) is None:
            return ""
        return place.message(found.name)

    def direction_eq(self, simulator: Simulator, scene: Scene) -> Float | None:
        """Return the direction of the selected object in the exposure shown.

        Parameters
        ----------
        simulator : Simulator
        scene : Scene

        Returns
        -------
        (3,) float64 or None
            Apparent unit vector, true equator and equinox; None without a selection, and for a star that is fainter
            than the magnitude limit or belongs to another catalogue.
        """
        if self.selected is None:
            return None
        inputs = (self.selected, scene)
        if self._direction is None or self._direction[0] != inputs:
            try:
                direction_eq = object_direction_eq(
                    self.selected, simulator.sky, scene.stars, scene.exposure.mid_utc_s, scene.site
                )
            except KeyError:
                direction_eq = None
            self._direction = inputs, direction_eq
        return self._direction[1]

    def place(self, simulator: Simulator, scene: Scene) -> ObjectPlace | None:
        """Return where the selected object is in the exposure shown; None if that is not known.

        Parameters
        ----------
        simulator : Simulator
        scene : Scene

        Returns
        -------
        ObjectPlace or None
        """
        direction_eq = self.direction_eq(simulator, scene)
        return None if direction_eq is None else object_place(scene, direction_eq)

    def next_in_image_s(self, simulator: Simulator, scene: Scene) -> float | None:
        """Return when the selected object is on the image next: see `time_in_image_s`.

        Parameters
        ----------
        simulator : Simulator
        scene : Scene

        Returns
        -------
        float or None
            UTC seconds since 1970.
        """
        direction_eq = self.direction_eq(simulator, scene)
        if direction_eq is None:
            return None
        return time_in_image_s(simulator, direction_eq, scene.exposure.stop_utc_s)

    def star_truth(self, scene: Scene, pixels: Pixels) -> dict[str, Any] | None:
        """Return the line of truth of the selected star in the exposure shown.

        Parameters
        ----------
        scene : Scene
        pixels : (height, width) uint8 or uint16
            The image.

        Returns
        -------
        dict or None
            The keys of a star in `frame_truth`; None if the selection is no star or its flux does not touch the image.
        """
        found = self.selected
        if found is None or found.kind is not ObjectKind.STAR:
            return None
        inputs = (found, scene, id(pixels))
        if self._truth is None or self._truth[0] != inputs:
            index = np.flatnonzero(scene.stars.star_id[scene.visible] == found.star_id)
            line = frame_truth(scene.with_visible(index), Frame(pixels, scene.exposure, seed=0), number=0, file="")
            stars = [star for star in json.loads(line)["stars"] if star["star_id"] == found.star_id]
            self._truth = inputs, stars[0] if stars else None
        return self._truth[1]


def star_signal_to_noise(scene: Scene, star_id: int) -> float:
    """Return the expected signal-to-noise ratio of a star in an exposure, as truth has it.

    Parameters
    ----------
    scene : Scene
    star_id : int
        In the catalogue.

    Returns
    -------
    float
        NaN if its flux does not touch the image.
    """
    index = np.flatnonzero(scene.stars.star_id[scene.visible] == star_id)
    if not index.size:
        return float("nan")
    dark = np.broadcast_to(np.uint8(0), (scene.camera.height_px, scene.camera.width_px))
    line = frame_truth(scene.with_visible(index), Frame(dark, scene.exposure, seed=0), number=0, file="")
    found = [star["snr"] for star in json.loads(line)["stars"] if star["star_id"] == star_id and "snr" in star]
    return float(found[0]) if found else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class CutOut:
    """The pixels around a star, and its profile across the trail.

    Attributes
    ----------
    pixels : (n, m) uint8 or uint16
    left_px, top_px : int
        Column and row of its first pixel.
    offset_px : (k,) float64
        Distances from the trail, px.
    measured_dn : (k,) float64
        The image there, interpolated bilinearly, DN.
    expected_dn : (k,) float64
        The median of the cut-out plus the star as a straight trail with the point spread function's width, DN.
    """

    pixels: Pixels
    left_px: int
    top_px: int
    offset_px: Float
    measured_dn: Float
    expected_dn: Float

    def saturated(self, tested: Pixels, saturation_dn: int) -> NDArray[np.bool_]:
        """Return which of its pixels are saturated, (n, m).

        Parameters
        ----------
        tested : (height, width) uint8, uint16 or bool
            The image, or of a stacked one where a short exposure is saturated.
        saturation_dn : int
            The largest digital number of the sensor.
        """
        rows, columns = self.pixels.shape
        around = tested[self.top_px : self.top_px + rows, self.left_px : self.left_px + columns]
        return np.asarray(around >= (1 if around.dtype == np.bool_ else saturation_dn))


def star_cut_out(scene: Scene, pixels: Pixels, direction_eq: Float, flux_dn: float) -> CutOut | None:
    """Return the surroundings of a star in the middle of its exposure.

    Parameters
    ----------
    scene : Scene
    pixels : (height, width) uint8 or uint16
    direction_eq : (3,) float64
        Of the star.
    flux_dn : float
        Sum of its flux over the image, DN.

    Returns
    -------
    CutOut or None
        None if the star is then outside the image.

    Notes
    -----
    The expected profile is that of a star that moves uniformly on a straight line.
    """
    # Of a stacked image, in the short exposure nearest to the middle: between two of them the star jumps.
    count = max(len(scene.shorts), 1)
    fraction = _SPEED_FRACTION / count
    times = (count // 2 + 0.5) / count + fraction * np.array([-0.5, 0.0, 0.5])
    before, middle, after = recorded_positions(scene, direction_eq[np.newaxis], times)[:, 0]
    if not scene.camera.contains(middle):
        return None
    column, row = np.rint(middle).astype(int).tolist()
    left, top = max(column - _CUT_OUT_PX, 0), max(row - _CUT_OUT_PX, 0)
    around = pixels[top : row + _CUT_OUT_PX + 1, left : column + _CUT_OUT_PX + 1]
    velocity = (after - before) / fraction
    trail_px = float(np.hypot(*velocity))
    trail_px = trail_px if np.isfinite(trail_px) else 0.0
    across = np.array([-velocity[1], velocity[0]]) / trail_px if trail_px > 1e-3 else np.array([1.0, 0.0])
    offset_px = np.linspace(-_CUT_OUT_PX, _CUT_OUT_PX, 4 * _CUT_OUT_PX + 1)
    profile_px = middle + offset_px[:, np.newaxis] * across - (left, top)
    expected_dn = np.median(around) + flux_dn * _straight_trail(
        around.shape, middle - (left, top), across, trail_px, scene.sensor.effective_sigma_px
    )
    return CutOut(
        pixels=around,
        left_px=left,
        top_px=top,
        offset_px=offset_px,
        measured_dn=_bilinear(around, profile_px),
        expected_dn=_bilinear(np.minimum(expected_dn, scene.white_dn), profile_px),
    )


def _straight_trail(shape: tuple[int, ...], middle_px: Float, across: Float, trail_px: float, sigma_px: float) -> Float:
    """Return the signal of a straight trail of unit flux at the centres of pixels: a Gaussian times two erf."""
    y, x = np.indices(shape) - middle_px[::-1, np.newaxis, np.newaxis]
    across_px, along_px = x * across[0] + y * across[1], x * -across[1] + y * across[0]
    # A star that does not move is a trail too short to differ from a point.
    half_px = max(trail_px, 1e-3 * sigma_px) / 2
    scale_px = sqrt(2) * sigma_px
    along = (_erf((along_px + half_px) / scale_px) - _erf((along_px - half_px) / scale_px)) / (4 * half_px)
    return np.asarray(np.exp(-((across_px / scale_px) ** 2)) / (sqrt(2 * pi) * sigma_px) * along)


def _bilinear(pixels: NDArray[Any], xy_px: Float) -> Float:
    """Return an image at positions (n, 2), px, interpolated bilinearly; NaN outside."""
    height, width = pixels.shape
    first = np.floor(xy_px).astype(int)
    inside = (first >= 0).all(axis=1) & (first[:, 0] < width - 1) & (first[:, 1] < height - 1)
    x, y = np.where(inside[:, np.newaxis], first, 0).T
    u, v = (xy_px - first).T
    value = (1 - v) * ((1 - u) * pixels[y, x] + u * pixels[y, x + 1]) + v * (
        (1 - u) * pixels[y + 1, x] + u * pixels[y + 1, x + 1]
    )
    return np.where(inside, value, np.nan)
