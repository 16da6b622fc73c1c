"""Stars in the band of a camera, and in the colours of its mosaic."""

from dataclasses import replace
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from glstar.camera.colourband import Channel, ColourBand
from glstar.render.culling import DrawList
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments
from glstar.sky.magnitudes import brightness_ratio, magnitude_difference
from glstar.sky.starcolours import USUAL_BV, star_colours
from glstar.sky.starfield import StarField

__all__ = ["FIRST_CHANNEL", "cell_tints", "channel_scenes", "colours_used", "drawn_peak_dn", "in_band"]

_CHANNELS: Final[tuple[Channel, ...]] = ("r", "g", "b")
_ALL: Final = slice(None)
# The first of `channel_scenes`.
FIRST_CHANNEL: Final = _CHANNELS[0]


def colours_used(stars: StarField, some: slice | NDArray[np.integer] = _ALL) -> NDArray[np.float64]:
    """Return the colours that stars are drawn with.

    Parameters
    ----------
    stars : StarField
    some : slice or (n,) int
        Which of them.

    Returns
    -------
    (n,) float64
        B - V; 0.65 where it is unknown.
    """
    return np.nan_to_num(star_colours(stars, some), nan=USUAL_BV)


# The field of a flight is uploaded once, so each of its scenes has the same object; it lives as long as the field of V
# magnitudes that it was made of.
_IN_BANDS: WeakKeyDictionary[StarField, dict[tuple[ColourBand, Channel | None], StarField]] = WeakKeyDictionary()


def in_band(stars: StarField, colour: ColourBand, channel: Channel | None = None) -> StarField:
    """Return stars with their magnitudes in the band of a camera.

    Parameters
    ----------
    stars : StarField
        With V magnitudes, or measured ones, which already are those of the camera's band.  Of a table of some stars,
        the others have the magnitudes of the band.
    colour : ColourBand
    channel : {"r", "g", "b"} or None
        A channel of the mosaic: with the brightness in its pixels, for a zero point of the mean of all pixels.

    Returns
    -------
    StarField
        The same object for the same arguments.
    """
    if colour.is_v or (channel is None and stars.measured_mag is not None and stars.is_measured is None):
        return stars
    made = _IN_BANDS.setdefault(stars, {})
    if (colour, channel) not in made:
        made[colour, channel] = replace(stars, measured_mag=_magnitudes(stars, colour, channel), is_measured=None)
    return made[colour, channel]


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
    made = _TINTS.setdefault(stars, {})
    if colour not in made:
        magnitudes = np.stack([_magnitudes(stars, colour, channel) for channel in _CHANNELS], axis=-1)
        made[colour] = brightness_ratio(magnitudes - stars.camera_mag[:, np.newaxis])
    return made[colour]


def cell_tints(scene: Scene, guard_band_px: int) -> NDArray[np.float32] | None:
    """Return the flux of all stars in the pixels of a mosaic over that in the mean of its cells.

    Parameters
    ----------
    scene : Scene
    guard_band_px : int
        Width of the target's border around the image.

    Returns
    -------
    (n, 4) float32 or None
        In pixels (even column, even row), (odd, even), (even, odd), (odd, odd) of the target; None without a mosaic.
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


def drawn_peak_dn(scene: Scene) -> NDArray[np.float64]:
    """Return the amplitudes of a scene's stars in the colour in which each is brightest, (k,), DN.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    (k,) float64
        In the mean of all light without a mosaic.
    """
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
    return {one: air.at_wavelength(colour.wavelength_nm(one)).zenith_mag(height_m) / mean_mag for one in _CHANNELS}


def _transmission_ratio(scene: Scene) -> NDArray[np.float64] | None:
    """Return the air's transmission in each channel over that in the mean, of the drawn stars, (k, 3)."""
    over_mean, extinction_mag = _extinction_over_mean(scene), scene.draw_list.extinction_mag
    if over_mean is None or extinction_mag is None:
        return None
    more = np.array([over_mean[channel] - 1 for channel in _CHANNELS])
    return brightness_ratio(extinction_mag[:, np.newaxis] * more)


def channel_scenes(scene: Scene) -> dict[Channel, Scene]:
    """Return the scene as the pixels of each colour of a mosaic see it.

    Parameters
    ----------
    scene : Scene
        Whose sensor has a mosaic.

    Returns
    -------
    dict of str to Scene
        By channel; their sensors have no mosaic.
    """
    over_mean = _extinction_over_mean(scene)
    return {
        channel: _of_channel(scene, channel, 1.0 if over_mean is None else over_mean[channel]) for channel in _CHANNELS
    }


def _of_channel(scene: Scene, channel: Channel, over_mean: float) -> Scene:
    """Return the scene in one channel, whose extinction is that of the mean times a factor."""
    colour, draw_list = scene.sensor.colour, _dimmed(scene.draw_list, over_mean)
    stars = in_band(scene.stars, colour, channel)
    peak_dn = scene.sensor.peak_dn(draw_list.observed_mag(stars), scene.exposure.duration_s)
    analytic = isinstance(scene.trails, AnalyticSegments)
    radius_px = scene.sensor.truncation_radius_px(peak_dn, draw_list.min_trail_px, renormalized=analytic)
    radius_px = np.maximum(scene.camera.max_magnification * radius_px, draw_list.truncation_radius_px)
    bodies = scene.bodies
    if bodies is not None:
        dimmed = _dimmed(bodies.draw_list, over_mean)
        bodies = replace(bodies, stars=in_band(bodies.stars, colour, channel), draw_list=dimmed)
    effects = {key: value for key, value in scene.sensor.effects.items() if key != "sensor.mosaic"}
    return replace(
        scene,
        stars=stars,
        sensor=replace(scene.sensor, effects=effects),
        draw_list=replace(draw_list, truncation_radius_px=radius_px),
        bodies=bodies,
        satellites=tuple(_of_channel(one, channel, over_mean) for one in scene.satellites),
    )


def _dimmed(draw_list: DrawList, over_mean: float) -> DrawList:
    """Return a list with the extinction multiplied by a factor."""
    if draw_list.extinction_mag is None or over_mean == 1:
        return draw_list
    return replace(draw_list, extinction_mag=draw_list.extinction_mag * over_mean)
