"""The Sun, the Moon and the planets as point sources, drawn by the same passes as the stars.

A disc wider than a star's image is a cluster of sources, so that trails, horizon, refraction and lens apply to it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.motion.pointing import Pointing
from glstar.render.scene.culling import DrawList
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.solarsystem import Body

# The catalogue of the sources.
BODIES = "bodies"
# Distance between the sources of a disc, in sigma of a star's image.  At 0.75 the sum of Gaussians has no ripple; what
# remains is the disc's edge, 1 % of its brightest pixel.
_SPACING_SIGMA = 0.75
# Radius of a disc, in sigma, below which it is one point.
_POINT_SIGMA = 0.25
# Samples across a disc, and across each of its cells: a cell's brightness is their mean.
_SAMPLES_ACROSS = 240
_CELL_SAMPLES = (2, 8)
# The largest number of cells across a disc, for cameras of long focal length: 31 000 sources, more widely spaced.
_MOST_CELLS = 200
# Limb darkening of the Sun at V: 1 - u (1 - cos).
_SUN_DARKENING = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class BodySources:
    """The bodies of one scene as point sources."""

    bodies: tuple[Body, ...]
    stars: StarField  # The sources; `star_id` is the index of their body
    draw_list: DrawList  # The sources that may touch the image


def body_field(bodies: tuple[Body, ...], stars: StarField, sigma_rad: float, near: NDArray[np.bool_]) -> StarField:
    """Return the sources of n bodies, in their order, in the frame of the stars of the scene.

    `sigma_rad`: standard deviation of a star's image on the optical axis, rad; `near` (n,) bool: which bodies may touch
    the image; the others are single points, to save time.
    """
    parts = [
        disc_sources(body, sigma_rad) if is_near else (body.direction_eq[np.newaxis], np.array([body.vmag]))
        for body, is_near in zip(bodies, near, strict=True)
    ]
    number = np.repeat(np.arange(len(bodies), dtype=np.int32), [len(vmag) for _, vmag in parts])
    return StarField(
        catalogue=BODIES,
        star_id=number,
        name=tuple(bodies[index].name for index in number),
        vmag=np.concatenate([vmag for _, vmag in parts]),
        direction_eq=np.concatenate([directions for directions, _ in parts]),
        epoch_utc_s=stars.epoch_utc_s,
        C_eq_icrs=stars.C_eq_icrs.copy(),
    )


def centre_source(body: Body, stars: StarField) -> BodySources:
    """Return the centre of a body as the only source of the scene of some stars."""
    field = body_field((body,), stars, 0.0, np.zeros(1, dtype=np.bool_))
    return BodySources((body,), field, DrawList(np.zeros(1, dtype=np.int32), np.zeros(1)))


def disc_sources(body: Body, sigma_rad: float) -> tuple[Float, Float]:
    """Return the directions, (n, 3), and magnitudes, (n,), of point sources that look like the disc of a body.

    Each is at the centroid of the light of a cell of the disc; their light adds up to the body's.  Brightness by Lommel
    and Seeliger, mu0 / (mu0 + mu), zero beyond the terminator; of the Sun, linear limb darkening.  `sigma_rad`:
    standard deviation of a star's image, rad.
    """
    radius_rad = body.angular_radius_rad
    if radius_rad < _POINT_SIGMA * sigma_rad:
        return body.direction_eq[np.newaxis].copy(), np.array([body.vmag])
    cells = min(int(np.ceil(2 * radius_rad / (_SPACING_SIGMA * sigma_rad))), _MOST_CELLS)
    per_side = cells * int(np.clip(_SAMPLES_ACROSS // cells, *_CELL_SAMPLES))
    along = (np.arange(per_side) + 0.5) / per_side * 2 - 1
    x, y = (grid.ravel() for grid in np.meshgrid(along, along))
    inside = x * x + y * y < 1
    x, y = x[inside], y[inside]
    light = _radiance(body, x, y)
    column, row = (((v + 1) / 2 * cells).astype(np.intp) for v in (x, y))
    cell = row * cells + column
    flux = np.bincount(cell, light, cells * cells)
    lit = flux > 0
    x, y = (np.bincount(cell, light * v, cells * cells)[lit] / flux[lit] for v in (x, y))
    across, up = _disc_axes(body)
    directions = body.direction_eq + np.tan(radius_rad) * (x[:, np.newaxis] * across + y[:, np.newaxis] * up)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions, body.vmag - 2.5 * np.log10(flux[lit] / flux.sum())


def disc_on_image(camera: Camera, pointing: Pointing, body: Body) -> tuple[float | None, float | None]:
    """Return the diameter of a body's disc on the image, px, and the direction of its bright limb, deg, at one time.

    The diameter is that of the circle of the same area.  The direction is from the centre to the middle of the bright
    limb, from right (0) towards down (90), -180 to 180; None for the Sun.  Both are None if the centre is not on the
    plane of the image.
    """
    across, up = _disc_axes(body)
    sine = np.sin(body.angular_radius_rad)
    points = body.direction_eq + sine * np.array([-across, across, -up, up])
    left, right, below, above = camera.project(pointing.to_camera(points, below_horizon=True))[0]
    dx, dy = right - left, above - below
    area_px2 = abs(dx[0] * dy[1] - dx[1] * dy[0])
    if not np.isfinite(area_px2):
        return None, None
    limb_deg = None if body.bright_limb_rad is None else float(np.rad2deg(np.arctan2(dx[1], dx[0])))
    return round(float(np.sqrt(area_px2)), 6), None if limb_deg is None else round(limb_deg, 6)


def _radiance(body: Body, x: Float, y: Float) -> Float:
    """Return the relative radiance of points of a disc of radius 1, x towards the bright limb."""
    towards_observer = np.sqrt(1 - x * x - y * y)
    if body.name == "Sun":
        return 1 - _SUN_DARKENING * (1 - towards_observer)
    phase_rad = body.phase_angle_rad
    towards_sun = np.maximum(x * np.sin(phase_rad) + towards_observer * np.cos(phase_rad), 0.0)
    return np.asarray(towards_sun / (towards_sun + towards_observer))


def _disc_axes(body: Body) -> tuple[Float, Float]:
    """Return two unit vectors across the line of sight, the first towards the bright limb."""
    towards = body.sun_direction_eq - (body.sun_direction_eq @ body.direction_eq) * body.direction_eq
    length = float(np.linalg.norm(towards))
    if length < 1e-9:  # the Sun, or exactly full: any axes
        towards = np.cross(body.direction_eq, np.eye(3)[np.argmin(np.abs(body.direction_eq))])
        length = float(np.linalg.norm(towards))
    across = towards / length
    return across, np.cross(body.direction_eq, across)
