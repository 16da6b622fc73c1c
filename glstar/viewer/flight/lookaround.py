"""A free camera at the aircraft: it points where the user turns it, with any field of view from 2 to 180 deg.

Its projection is stereographic, as that of star charts: a pinhole's near the axis, and without limit beyond 90 deg.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import cos, degrees, pi, radians, tan

import numpy as np

from glstar.arrays import Float
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera, Mount
from glstar.flight import AttitudeTrack, Flight
from glstar.flight.gimbal import NO_GIMBAL
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.viewer.overlays.canvas import ned_to_camera_matrix

# Horizontal fields of view, rad, and the first one.
_NARROWEST_RAD, _WIDEST_RAD = radians(2.0), radians(180.0)
_FIRST_RAD = radians(100.0)
# The omnidirectional model with xi = 1: r = sin(theta) / (1 + cos(theta)) = tan(theta / 2).
_STEREOGRAPHIC = Lens("omni", (1.0,))
# Sizes of the image, px.
_SMALLEST_PX, _LARGEST_PX = 64, 2048
# Points along each side of the outline of the aircraft's own image.
_OUTLINE_POINTS = 17


@dataclass(slots=True, eq=False)
class LookAround:
    """A camera that the user turns; it has no motion but that of the sky, and the sensor of the aircraft's camera."""

    is_on: bool = False
    azimuth_rad: float = 0.0  # From north through east
    altitude_rad: float = 0.0
    field_rad: float = _FIRST_RAD  # Horizontal field of view
    size_px: tuple[int, int] = (800, 600)  # Width and height of its image
    _made: tuple[tuple[object, ...], Simulator] | None = field(default=None, repr=False)
    _flight: tuple[tuple[object, ...], Flight] | None = field(default=None, repr=False)

    @property
    def label(self) -> str:
        """Where it points, in one line."""
        return (
            f"looking around: az {degrees(self.azimuth_rad) % 360:.1f}°, alt {degrees(self.altitude_rad):.1f}°,"
            f" {degrees(self.field_rad):.3g}° wide"
        )

    @property
    def camera(self) -> Camera:
        """The camera at present."""
        width_px, height_px = self.size_px
        focal_px = width_px / 2 / tan(self.field_rad / 4)
        return Camera(
            width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2, lens=_STEREOGRAPHIC
        )

    def resize(self, width_px: float, height_px: float) -> None:
        """Give the image the size of a panel."""
        width, height = (min(max(round(px), _SMALLEST_PX), _LARGEST_PX) for px in (width_px, height_px))
        self.size_px = width, height

    def turn(self, right_px: float, down_px: float) -> None:
        """Turn the sky with the mouse, as if it were pulled at the middle of the image; px of the image."""
        rad_per_px = 4 * tan(self.field_rad / 4) / self.size_px[0]
        across = max(cos(self.altitude_rad), 0.1)
        self.azimuth_rad = (self.azimuth_rad - right_px * rad_per_px / across) % (2 * pi)
        self.altitude_rad = min(max(self.altitude_rad + down_px * rad_per_px, -pi / 2), pi / 2)

    def zoom(self, factor: float) -> None:
        """Make the field of view narrower by a factor, within 2 and 180 deg."""
        self.field_rad = min(max(self.field_rad / factor, _NARROWEST_RAD), _WIDEST_RAD)

    def look_at(self, xy_px: Float, scene: Scene) -> None:
        """Look in the direction of a position of the image of a scene, px; nothing changes if it has none."""
        direction = scene.camera.unit_vectors(xy_px)
        if np.isfinite(direction).all():
            self._look_along(direction @ ned_to_camera_matrix(scene.shutter[1:2]))

    def begin(self, scene: Scene | None) -> None:
        """Look around, at first along the optical axis of a scene."""
        self.is_on = True
        if scene is not None:
            self.field_rad = _FIRST_RAD
            self._look_along(ned_to_camera_matrix(scene.shutter[1:2])[2])

    def _look_along(self, direction_ned: Float) -> None:
        azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(direction_ned)
        self.azimuth_rad, self.altitude_rad = float(azimuth_rad), float(altitude_rad)

    def of(self, simulator: Simulator) -> Simulator:
        """Return the simulator of this camera on a flight; the same one for the same view.

        `simulator`: of the aircraft's camera.
        """
        flight = simulator.flight
        inputs = (simulator, self.azimuth_rad, self.altitude_rad, self.field_rad, self.size_px)
        if self._made is None or self._made[0] != inputs:
            turned = (flight, self.azimuth_rad, self.altitude_rad)
            if self._flight is None or self._flight[0] != turned:
                q = quaternion_from_euler(0.0, self.altitude_rad, self.azimuth_rad)
                ends_s = np.array([flight.attitude.first_s, flight.attitude.last_s])
                self._flight = turned, replace(flight, attitude=AttitudeTrack(ends_s, np.stack([q, q])))
            own = replace(
                simulator,
                flight=self._flight[1],
                camera=self.camera,
                mount=Mount(0.0, 0.0, 0.0),
                gimbal=NO_GIMBAL,
            )
            self._made = inputs, own
        return self._made[1]

    def outline_px(self, aircraft: Simulator, scene: Scene) -> Float:
        """Return the border of the aircraft's own image on the image of a scene, (n, 2) px; NaN where it has none.

        `aircraft`: the simulator of its camera.
        """
        attitude, mid_s = aircraft.flight.attitude, scene.exposure.mid_utc_s
        if not attitude.covers(mid_s):
            return np.empty((0, 2))
        right, bottom = aircraft.camera.width_px - 0.5, aircraft.camera.height_px - 0.5
        corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
        along = np.linspace(0.0, 1.0, _OUTLINE_POINTS)[:, np.newaxis]
        border = np.concatenate([a + along * (b - a) for a, b in pairwise(corners)])
        C_ned_own = ned_to_camera_matrix(aircraft.pointing(np.array([mid_s])))
        ned = aircraft.camera.unit_vectors(border) @ C_ned_own
        return scene.camera.project(ned @ ned_to_camera_matrix(scene.shutter[1:2]).T)
