"""A scene's stars in the band of a camera, in the colours of its mosaic, and as sums of plain Gaussians."""

from dataclasses import replace
from math import hypot
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.colourband import Channel, ColourBand
from glstar.camera.sensor.pointspread import FAINTEST_COMPONENT_DN, PsfComponent
from glstar.render.motion.trailmodels import AnalyticSegments, SubExposures
from glstar.render.scene.scene import Scene
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.photometry import USUAL_BV, brightness_ratio, magnitude_difference, star_colours

_CHANNELS: tuple[Channel, ...] = ("r", "g", "b")
_ALL = slice(None)


def colours_used(stars: StarField, index: slice | NDArray[np.integer] = _ALL) -> NDArray[np.float64]:
    """Return the colours B - V that some stars are drawn with, (n,); 0.65 where it is unknown."""
    return np.nan_to_num(star_colours(stars, index), nan=USUAL_BV)


# The field of a flight is uploaded once, so all its scenes share one object, which lives as long as the field of V
# magnitudes from which it was computed.
_IN_BANDS: WeakKeyDictionary[StarField, dict[ColourBand, StarField]] = WeakKeyDictionary()


def in_band(stars: StarField, colour: ColourBand) -> StarField:
    """Return stars with their magnitudes in the band of a camera: the same object for the same arguments.

    Measured magnitudes already are those of the camera's band.
    """
    if colour.is_v or (stars.measured_mag is not None and stars.is_measured is None):
        return stars
    fields = _IN_BANDS.setdefault(stars, {})
    if colour not in fields:
        fields[colour] = replace(stars, measured_mag=_magnitudes(stars, colour, None), is_measured=None)
    return fields[colour]


def _magnitudes(stars: StarField, colour: ColourBand, channel: Channel | None) -> NDArray[np.float64]:
    bv = colours_used(stars)
    if channel is None:
        of_band = stars.vmag + colour.magnitude_minus_v(bv)
        return of_band if stars.is_measured is None else np.where(stars.is_measured, stars.camera_mag, of_band)
    tint = colour.magnitude_minus_v(bv, channel) - colour.magnitude_minus_v(bv)
    return stars.camera_mag + tint + magnitude_difference(colour.photons(channel))


_TINTS: WeakKeyDictionary[StarField, dict[ColourBand, NDArray[np.float64]]] = WeakKeyDictionary()


def _tints(stars: StarField, colour: ColourBand) -> NDArray[np.float64]:
    """Return the flux of stars in the pixels of each channel over that in the mean of the mosaic's cells, (n, 3)."""
    tints = _TINTS.setdefault(stars, {})
    if colour not in tints:
        magnitudes = np.stack([_magnitudes(stars, colour, channel) for channel in _CHANNELS], axis=-1)
        tints[colour] = brightness_ratio(magnitudes - stars.camera_mag[:, np.newaxis])
    return tints[colour]


def cell_tints(scene: Scene, guard_band_px: int) -> NDArray[np.float32] | None:
    """Return the flux of all stars in the pixels of a mosaic over that in the mean of its cells, (n, 4) float32.

    The pixels are (even column, even row), (odd, even), (even, odd), (odd, odd) of the target, which has a border of
    `guard_band_px` around the image; None without a mosaic.
    """
    colour = scene.sensor.colour
    if colour.mosaic == "none":
        return None
    cells = [colour.channel_at(column - guard_band_px, row - guard_band_px) for row in (0, 1) for column in (0, 1)]
    tints = _tints(scene.stars, colour)
    through_air = _transmission_ratio(scene)
    if through_air is not None:
        tints = tints.copy()
        tints[scene.draw_list.index] *= through_air
    return np.ascontiguousarray(tints[:, [_CHANNELS.index(channel) for channel in cells]], dtype=np.float32)


def mean_of_cells(scene: Scene, index: NDArray[np.int32]) -> NDArray[np.float64] | float:
    """Return the flux of stars in the mean of a mosaic's cells, in units of their magnitude's flux; 1 without a mosaic.

    `index` (m,): indices into the stars of the scene.  Returns (m,): the bands of the cells add up to that of the mean
    within a percent.
    """
    colour = scene.sensor.colour
    if colour.mosaic == "none":
        return 1.0
    red, green, blue = _tints(scene.stars, colour)[index].T
    return np.asarray((red + 2 * green + blue) / 4)


def drawn_peak_dn(scene: Scene) -> NDArray[np.float64]:
    """Return the amplitudes of a scene's stars in the colour in which each is brightest, (k,), DN."""
    draw_list, sensor = scene.draw_list, scene.sensor
    peak_dn = sensor.peak_dn(draw_list.observed_mag(scene.stars), scene.exposure.duration_s)
    if sensor.colour.mosaic == "none":
        return peak_dn
    tints, through_air = _tints(scene.stars, sensor.colour)[draw_list.index], _transmission_ratio(scene)
    return np.asarray(peak_dn * (tints if through_air is None else tints * through_air).max(axis=1))


def _extinction_over_mean(scene: Scene) -> dict[Channel, float] | None:
    """Return the extinction in each channel over that in the mean of the mosaic's cells; None if all have the same."""
    air, colour, height_m = scene.extinction, scene.sensor.colour, scene.site.height_m
    if air is None or not air.by_channel or colour.mosaic == "none":
        return None
    mean_mag = air.zenith_mag(height_m)
    if mean_mag == 0:
        return None
    return {
        channel: air.at_wavelength(colour.wavelength_nm(channel)).zenith_mag(height_m) / mean_mag
        for channel in _CHANNELS
    }


def _transmission_ratio(scene: Scene) -> NDArray[np.float64] | None:
    """Return the air's transmission in each channel over that in the mean, of the drawn stars, (k, 3)."""
    over_mean, extinction_mag = _extinction_over_mean(scene), scene.draw_list.extinction_mag
    if over_mean is None or extinction_mag is None:
        return None
    excess = np.array([over_mean[channel] - 1 for channel in _CHANNELS])
    return brightness_ratio(extinction_mag[:, np.newaxis] * excess)


# Stars whose widths differ by less than this are drawn together: with the mean of their range, 1 % from each.
_WIDTH_STEP = 0.02


def psf_scale(
    scene: Scene, direction_eq: NDArray[np.float64], bv: NDArray[np.float64] | float = USUAL_BV
) -> NDArray[np.float64]:
    """Return the widths of stars over ``psf_sigma_px`` in the middle of the exposure, (k,), as drawn: in steps of 2 %.

    `direction_eq` (k, 3): geocentric apparent unit vectors, true equator and equinox; `bv` (k,) or float: colours B -
    V.
    """
    psf, camera = scene.sensor.point_spread, scene.camera
    if not psf.varies:
        return np.ones(len(direction_eq))
    centre_px = np.array([camera.cx_px, camera.cy_px])
    xy_px = camera.project(scene.shutter[1:2].to_camera(direction_eq, below_horizon=True))[0]
    half_diagonal_px = hypot(camera.width_px, camera.height_px) / 2
    offset = (xy_px - centre_px) / half_diagonal_px
    # A star that is behind the camera then, or far outside the image, touches it near a corner.
    offset[np.isnan(offset).any(axis=1)] = 1.0
    offset /= np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1.0)
    scale = psf.scale_at(offset, bv)
    steps = np.floor(np.log(scale) / np.log1p(_WIDTH_STEP))
    return np.asarray((1 + _WIDTH_STEP) ** (steps + 0.5))


def gaussian_scenes(scene: Scene) -> list[Scene]:
    """Return scenes that add up to a scene with its bodies and satellites, each with one circular Gaussian per star.

    An offset of a Gaussian is an offset of the principal point.
    """
    parts = [part for part in (scene, scene.body_scene, *scene.satellites) if part is not None]
    return [component for part in parts for component in _split(part)]


def _split(scene: Scene) -> list[Scene]:
    """Return scenes that add up to the stars of a scene."""
    psf = scene.sensor.point_spread
    if psf.is_gaussian:
        return [scene if scene.sensor.colour.mosaic == "none" else _with_radii(scene)]
    scales = psf_scale(scene, scene.stars.direction_eq[scene.visible], colours_used(scene.stars, scene.visible))
    groups = [(scale, scene.with_visible(scales == scale)) for scale in np.unique(scales).tolist()]
    components = [
        _of_component(stars, component)
        for scale, stars in groups
        for component in psf.components(scene.sensor.psf_sigma_px, scale=scale)
    ]
    return [component for component in components if len(component.draw_list)]


def _with_radii(scene: Scene) -> Scene:
    """Return a scene of plain Gaussians, each drawn as far as its brightest colour of the mosaic demands."""
    draw_list, sensor = scene.draw_list, scene.sensor
    analytic = isinstance(scene.trails, AnalyticSegments)
    radius_px = sensor.truncation_radius_px(drawn_peak_dn(scene), draw_list.min_trail_px, renormalized=analytic)
    radius_px = np.maximum(radius_px, draw_list.truncation_radius_px)
    return replace(scene, draw_list=replace(draw_list, truncation_radius_px=radius_px))


def _of_component(scene: Scene, component: PsfComponent) -> Scene:
    sensor, camera, draw_list = scene.sensor.of_component(component), scene.camera, scene.draw_list
    peak_dn = drawn_peak_dn(replace(scene, sensor=sensor))
    trail_px = draw_list.min_trail_px
    kept = sensor.max_trail_peak_dn(peak_dn, trail_px) >= FAINTEST_COMPONENT_DN
    analytic = isinstance(scene.trails, AnalyticSegments)
    radius_px = sensor.component_radius_px(peak_dn[kept], trail_px[kept], renormalized=analytic)
    dx_px, dy_px = component.offset_px
    if dx_px or dy_px:
        camera = replace(camera, cx_px=camera.cx_px + dx_px, cy_px=camera.cy_px + dy_px)
    stars = replace(draw_list[kept], truncation_radius_px=radius_px)
    trails = scene.trails
    if isinstance(trails, SubExposures):
        trails = trails.for_sigma(scene.camera, sensor.effective_sigma_px)
        group = len(scene.trails) // len(trails)
        if stars.passage is not None and group > 1:
            stars = replace(stars, passage=stars.passage_of_groups(group))
    return replace(scene, sensor=sensor, camera=camera, draw_list=stars, trails=trails, bodies=None)
