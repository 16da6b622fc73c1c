"""The truth of a frame as ROS and Foxglove show it: axes, lens, and what is drawn over the image.

Stars are circles, with lines along their trails: from the opening of the shutter over the middle of the exposure to its
closing, or of a stack one for each short exposure.  In Foxglove, annotations count pixels from the corner of the top
left one, while the camera matrix counts from its centre, as glstar does: see `CORNER_PX`.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from glstar.arrays import Float
from glstar.camera.distortion import COEFFICIENTS, Lens
from glstar.camera.model import Camera
from glstar.rotation import conjugate, multiply, quaternion_from_matrix

WORLD, BODY, CAMERA = "map", "base_link", "camera_optical"
# From the centre of the top left pixel to its corner, px.
CORNER_PX = 0.5
# Rotations from north, east, down to east, north, up, and from forward, right, down to forward, left, up.
_HALF = float(np.sqrt(0.5))
_Q_ENU_NED = np.array([0.0, _HALF, _HALF, 0.0])
_Q_FLU_FRD = np.array([0.0, 1.0, 0.0, 0.0])
# Distortion models by the lenses of glstar, and their number of coefficients.  ROS has names for the first three.
_LENSES = {name: (name, len(coefficients)) for name, coefficients in COEFFICIENTS.items()} | {
    "none": ("plumb_bob", 5),
    "rational": ("rational_polynomial", 8),
    "fisheye": ("equidistant", 4),
}
# Circles have this diameter, and that of bodies is larger by it, px.
_CIRCLE_PX = 12.0
# Labels of this many of the brightest stars.
_MOST_LABELS = 20

# Red, green, blue and opacity, from 0 to 1; the width of lines, and the size of letters, px.
STAR, TRAIL, NO_COLOUR = (0.2, 1.0, 0.4, 0.9), (1.0, 0.8, 0.1, 0.6), (0.0, 0.0, 0.0, 0.0)
THICKNESS_PX, FONT_PX = 1.0, 12.0

Point = tuple[float, float]


class Calibration(NamedTuple):
    """A camera as ROS describes it."""

    width_px: int
    height_px: int
    model: str
    coefficients: Float
    K: Float  # (3, 3)

    @classmethod
    def of(cls, line: dict[str, Any]) -> "Calibration":
        """Return the camera of a line of truth."""
        camera = line["camera"]
        model, count = _LENSES[camera["lens"]]
        coefficients = np.zeros(max(count, len(camera["distortion"])))
        coefficients[: len(camera["distortion"])] = camera["distortion"]
        K = np.array(camera["K"], dtype=np.float64)
        return cls(camera["width_px"], camera["height_px"], model, coefficients, K)

    @property
    def P(self) -> Float:
        """The projection matrix, (3, 4)."""
        return np.column_stack([self.K, np.zeros(3)])


def q_world_body(line: dict[str, Any]) -> Float:
    """Return the attitude as (w, x, y, z): from forward, left, up to east, north, up."""
    q_body_world = multiply(multiply(_Q_FLU_FRD, np.array(line["q_body_ned"])), conjugate(_Q_ENU_NED))
    return conjugate(q_body_world)


def q_body_camera(line: dict[str, Any]) -> Float:
    """Return the mount as (w, x, y, z): from right, down, along the optical axis to forward, left, up."""
    q_camera_body = quaternion_from_matrix(np.array(line["C_camera_body"]))
    return multiply(_Q_FLU_FRD, conjugate(q_camera_body))


def camera_of(keys: Mapping[str, Any]) -> Camera:
    """Return the camera of the key ``camera`` of a line of truth."""
    K = np.array(keys["K"], dtype=np.float64)
    lens = keys.get("lens", "none")
    return Camera(
        width_px=keys["width_px"],
        height_px=keys["height_px"],
        fx_px=K[0, 0],
        fy_px=K[1, 1],
        cx_px=K[0, 2],
        cy_px=K[1, 2],
        skew_px=K[0, 1],
        lens=None
        if lens == "none"
        else Lens(lens, tuple(keys["distortion"]), float(np.deg2rad(keys.get("max_angle_deg", 180.0)))),
    )


class Circle(NamedTuple):
    """A circle about a star, a body or a satellite."""

    at: Point  # Its centre, px from the corner of the image
    diameter_px: float
    label: str  # Empty for fainter stars

    @property
    def beside(self) -> Point:
        """Where the label begins, px from the corner of the image."""
        return self.at[0] + self.diameter_px / 2, self.at[1]


class Overlay(NamedTuple):
    """Marks and lines over an image, in pixels from the corner of its top left one."""

    circles: tuple[Circle, ...]
    lines: tuple[tuple[Point, Point], ...]

    @classmethod
    def of(cls, line: dict[str, Any]) -> "Overlay":
        """Return the stars, bodies and satellites of a line of truth, and their trails."""
        circles: list[Circle] = []
        lines: list[tuple[Point, Point]] = []
        for number, star in enumerate(line["stars"]):
            label = f"{star['star_id']}" if number < _MOST_LABELS else ""
            _add(star, _CIRCLE_PX, label, circles, lines)
        for body in line.get("bodies", ()):
            _add(body, _CIRCLE_PX + body["diameter_px"], body["name"], circles, lines)
        for satellite in line.get("satellites", ()):
            _add(satellite, _CIRCLE_PX, satellite["name"], circles, lines)
        return cls(tuple(circles), tuple(lines))


def _add(
    one: dict[str, Any], diameter_px: float, label: str, circles: list[Circle], lines: list[tuple[Point, Point]]
) -> None:
    """Add an object of the truth to the circles and the lines."""
    middle = (one["x_px"], one["y_px"]) if one["x_px"] is not None else None
    if middle is not None:
        circles.append(Circle(_from_corner(middle), diameter_px, label))
    stacked: list[tuple[Point | None, ...]] = [(start, end) for start, end in one.get("segments", ())]
    trails = stacked or [(one["start"], middle, one["end"])]
    for trail in trails:
        points = [_from_corner(point) for point in trail if point is not None]
        lines += pairwise(points)


def _from_corner(point: Point) -> Point:
    return point[0] + CORNER_PX, point[1] + CORNER_PX
