"""Stars in the band of a camera, and one scene for each colour of a mosaic."""

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from glstar.camera.colourband import Channel, ColourBand
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments
from glstar.sky.magnitudes import magnitude_difference
from glstar.sky.starcolours import USUAL_BV, star_colours
from glstar.sky.starfield import StarField

__all__ = ["channel_scenes", "colours_used", "in_band"]


def colours_used(stars: StarField) -> NDArray[np.float64]:
    """Return the colours that stars are drawn with.

    Parameters
    ----------
    stars : StarField

    Returns
    -------
    (n,) float64
        B - V; 0.65 where it is unknown.
    """
    return np.nan_to_num(star_colours(stars), nan=USUAL_BV)


# The field of a flight is uploaded once, so each of its scenes has the same object; it lives as long as the field of V
# magnitudes that it was made of.
_IN_BANDS: WeakKeyDictionary[StarField, dict[tuple[ColourBand, Channel | None], StarField]] = WeakKeyDictionary()


def in_band(stars: StarField, colour: ColourBand, channel: Channel | None = None) -> StarField:
    """Return stars with their magnitudes in the band of a camera.

    Parameters
    ----------
    stars : StarField
        With V magnitudes, or measured ones, which already are those of the camera's band.
    colour : ColourBand
    channel : {"r", "g", "b"} or None
        A channel of the mosaic: with the brightness in its pixels, for a zero point of the mean of all pixels.

    Returns
    -------
    StarField
        The same object for the same arguments.
    """
    if colour.is_v or (channel is None and stars.measured_mag is not None):
        return stars
    made = _IN_BANDS.setdefault(stars, {})
    if (colour, channel) not in made:
        made[colour, channel] = replace(stars, measured_mag=_magnitudes(stars, colour, channel))
    return made[colour, channel]


def _magnitudes(stars: StarField, colour: ColourBand, channel: Channel | None) -> NDArray[np.float64]:
    bv = colours_used(stars)
    if channel is None:
        return stars.vmag + colour.magnitude_minus_v(bv)
    tint = colour.magnitude_minus_v(bv, channel) - colour.magnitude_minus_v(bv)
    return stars.camera_mag + tint + magnitude_difference(colour.photons(channel))


def channel_scenes(scene: Scene) -> dict[Channel, Scene]:
    """Return the scene as the pixels of each colour of a mosaic see it.

    Parameters
    ----------
    scene : Scene
        Whose sensor has a mosaic.

    Returns
    -------
    dict of str to Scene
        By channel.
    """
    channels: tuple[Channel, ...] = ("r", "g", "b")
    return {channel: _of_channel(scene, channel) for channel in channels}


def _of_channel(scene: Scene, channel: Channel) -> Scene:
    colour, draw_list = scene.sensor.colour, scene.draw_list
    stars = in_band(scene.stars, colour, channel)
    peak_dn = scene.sensor.peak_dn(draw_list.observed_mag(stars), scene.exposure.duration_s)
    analytic = isinstance(scene.trails, AnalyticSegments)
    radius_px = scene.sensor.truncation_radius_px(peak_dn, draw_list.min_trail_px, renormalized=analytic)
    radius_px = np.maximum(scene.camera.max_magnification * radius_px, draw_list.truncation_radius_px)
    bodies = scene.bodies
    if bodies is not None:
        bodies = replace(bodies, stars=in_band(bodies.stars, colour, channel))
    return replace(scene, stars=stars, draw_list=replace(draw_list, truncation_radius_px=radius_px), bodies=bodies)
