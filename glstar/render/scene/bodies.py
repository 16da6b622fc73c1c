"""The Sun, the Moon and the planets as point sources, drawn by the same passes as the stars.

A disc wider than a star's image is a cluster of sources, so that trails, horizon, refraction and lens apply to it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.errors import ConfigError
from glstar.render.motion.pointing import Pointing
from glstar.render.scene.culling import DrawList
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.solarsystem import Body

# The catalogue of the sources.
BODIES = "bodies"
# Size of the cells of a disc, in sigma of a star's image.  Each has four sources; the sum of all is within 0.3 % of the
# brightest pixel, and beyond 2 sigma it shows the cells.
_CELL_SIGMA = 1.75
# Radius of a disc, in sigma, below which it is one point.
_POINT_SIGMA = 0.02
# The most cells from pole to pole of a disc, for cameras of long focal length: a million sources.
_MOST_CELLS = 800
# Largest radius of a disc, sigma: beyond it the image shows the cells, by 3 % at 600 sigma and 23 % at 900.
_LARGEST_SIGMA = 490.0
# Nodes and weights of the integrals over a cell, from -1 to 1.
_NODES, _WEIGHTS = leggauss(8)
# The largest phase angle, rad: no body is lit from exactly behind.
_MOST_PHASE_RAD = np.pi - 1e-4
# Number of angles from the optical axis at which the scale of the image is taken where a body crosses it, and how far
# within the edge of the field, rad: along the limit of a lens there is none.
_SCALE_ANGLES, _WITHIN_RAD = 9, 1e-6
# Limb darkening of the Sun at V: 1 - u (1 - cos).
_SUN_DARKENING = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class BodySources:
    """The bodies of one scene as point sources."""

    bodies: tuple[Body, ...]
    stars: StarField  # The sources; `star_id` is the index of their body
    draw_list: DrawList  # The sources that may touch the image


def body_field(
    bodies: tuple[Body, ...], stars: StarField, sigma_rad: float | Float, near: NDArray[np.bool_]
) -> StarField:
    """Return the sources of n bodies, in their order, in the frame of the stars of the scene.

    `sigma_rad` (n,): standard deviation of a star's image at each body, rad; `near` (n,) bool: which bodies may touch
    the image; the others are single points, to save time.
    """
    parts = [
        disc_sources(body, float(sigma)) if is_near else (body.direction_eq[np.newaxis], np.array([body.light_vmag]))
        for body, sigma, is_near in zip(bodies, np.broadcast_to(sigma_rad, len(bodies)), near, strict=True)
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


def star_sigma_rad(camera: Camera, sigma_px: float, off_axis_rad: Float) -> Float:
    """Return the smallest standard deviation of a star's image that bodies meet on their paths, (n,) rad.

    `off_axis_rad` (m, n): their angles from the optical axis at m times.
    """
    edge_rad = camera.field_radius_rad - _WITHIN_RAD
    nearest, farthest = (np.minimum(end, edge_rad) for end in (off_axis_rad.min(axis=0), off_axis_rad.max(axis=0)))
    angle = nearest + (farthest - nearest) * np.linspace(0, 1, _SCALE_ANGLES)[:, np.newaxis]
    px_per_rad = np.full(angle.shape, max(camera.fx_px, camera.fy_px))
    sine, cosine = np.sin(angle), np.cos(angle)
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        at = np.stack([x * sine, y * sine, cosine], axis=-1)
        scales = np.linalg.norm(camera.px_per_rad(at), axis=-2)  # outwards and around
        px_per_rad = np.fmax(px_per_rad, scales.max(axis=-1))
    widest: Float = px_per_rad.max(axis=0)
    return sigma_px / widest


def disc_sources(body: Body, sigma_rad: float) -> tuple[Float, Float]:
    """Return the directions, (n, 3), and magnitudes, (n,), of point sources that look like the disc of a body.

    Their light adds up to the body's.  Brightness by Lommel and Seeliger, mu0 / (mu0 + mu), zero beyond the terminator,
    and of a disc that its observer lights, uniform; of the Sun, linear limb darkening.  `sigma_rad`: standard deviation
    of a star's image, rad.  Raises ConfigError if the disc has more sources than can be drawn.
    """
    if body.angular_radius_rad < _POINT_SIGMA * sigma_rad:
        return body.direction_eq[np.newaxis].copy(), np.array([body.light_vmag])
    if body.angular_radius_rad > _LARGEST_SIGMA * sigma_rad:
        width = 2 * body.angular_radius_rad / sigma_rad
        remedy = "give a shorter focal length, a wider psf_sigma_px, or bodies = false"
        raise ConfigError(
            f"the disc of the {body.name} is {width:.0f} sigma wide, of at most {2 * _LARGEST_SIGMA:.0f}; {remedy}",
            key="sky.bodies",
        )
    cell = max(_CELL_SIGMA * sigma_rad / body.angular_radius_rad, np.pi / _MOST_CELLS)
    parts = [(body.vmag, _points_of_disc(body, body.phase_angle_rad, cell))]
    if body.earthshine_vmag is not None:
        parts.append((body.earthshine_vmag, _points_of_disc(body, 0.0, cell)))
    x, y, _ = np.concatenate([points for _, points in parts], axis=1)
    across, up = _disc_axes(body)
    directions = body.direction_eq + np.tan(body.angular_radius_rad) * (x[:, None] * across + y[:, None] * up)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    vmag = [mag - 2.5 * np.log10(flux / flux.sum()) for mag, (_, _, flux) in parts]
    return directions, np.concatenate(vmag)


def _points_of_disc(body: Body, phase_rad: float, cell: float) -> Float:
    """Return the places x, towards the bright limb, and y of points on a disc of radius 1, and their light, (3, n).

    Cells of at most `cell` divide the lit part, from pole to pole and from terminator to limb.  Each has two points in
    both directions with its light, centroid, and second and third moments: Gauss's rule for the light as the weight.
    """
    terminator = -np.cos(min(phase_rad, _MOST_PHASE_RAD))
    latitude_rad, step_rad = _between(np.linspace(-np.pi / 2, np.pi / 2, 1 + int(np.ceil(np.pi / cell))))
    ys, widths = _two_points(np.sin(latitude_rad), np.cos(latitude_rad) ** 2 * step_rad)
    points = []
    north = ys.size // 2  # the rows of the south mirror those of the north
    for y, width in zip(ys.ravel()[north:], widths.ravel()[north:], strict=True):
        half = np.sqrt(1 - y * y)
        columns = max(1, int(np.ceil(half * (1 - terminator) / cell)))
        longitude_rad, step_rad = _between(np.arcsin(np.linspace(terminator, 1.0, 1 + columns)))
        light = _radiance(body, phase_rad, longitude_rad, half) * np.cos(longitude_rad) * step_rad
        x, flux = _two_points(np.sin(longitude_rad), light)
        points.append([half * x.ravel(), np.full(x.size, y), width * flux.ravel()])
    x, y, flux = np.concatenate(points, axis=1)
    return np.array([np.hstack([x, x]), np.hstack([y, -y]), np.hstack([flux, flux])])


def _between(ends_rad: Float) -> tuple[Float, Float]:
    """Return the angles of integration between consecutive ones, (n, nodes) rad, and their steps."""
    half = np.diff(ends_rad)[:, np.newaxis] / 2
    return ends_rad[:-1, np.newaxis] + half * (1 + _NODES), half * _WEIGHTS


def _two_points(places: Float, light: Float) -> tuple[Float, Float]:
    """Return two points each of n cells, (n, 2), with the moments up to the third of light at places, (n, nodes)."""
    total = light.sum(axis=1, keepdims=True)
    mean = (light * places).sum(axis=1, keepdims=True) / total
    offset = places - mean
    variance, third = ((light * offset**power).sum(axis=1, keepdims=True) / total for power in (2, 3))
    skew = third / (2 * variance)
    reach = np.sqrt(variance + skew * skew)
    return mean + np.hstack([skew - reach, skew + reach]), total * np.hstack([reach + skew, reach - skew]) / (2 * reach)


def disc_on_image(camera: Camera, pointing: Pointing, body: Body) -> tuple[float | None, float | None]:
    """Return the diameter of a body's disc on the image, px, and the direction of its bright limb, deg, at one time.

    The diameter belongs to the circle of the same area.  The direction is from the centre to the middle of the bright
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


def _radiance(body: Body, phase_rad: float, longitude_rad: Float, cos_latitude: float) -> Float:
    """Return the relative radiance of points of a disc by longitude from its centre towards the bright limb."""
    towards_observer = np.cos(longitude_rad)
    if body.name == "Sun":
        return 1 - _SUN_DARKENING * (1 - cos_latitude * towards_observer)
    towards_sun = np.cos(longitude_rad - phase_rad)  # over the cosine of the latitude, as `towards_observer`
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
