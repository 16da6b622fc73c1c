"""A free camera at the aircraft: it points where the user turns it, with any field of view from 2 to 180 deg.

Its projection is stereographic, as in star charts: near the axis it is a pinhole's, and it has no limit at 90 deg.  Its
horizon stays level.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import asin, atan2, cos, degrees, dist, hypot, pi, radians, remainder, sin, tan

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
from glstar.viewer.flight.map import image_border
from glstar.viewer.overlays.canvas import ned_to_camera_matrix

# Horizontal fields of view, rad, and the first one.
_NARROWEST_RAD, _WIDEST_RAD = radians(2.0), radians(180.0)
_FIRST_RAD = radians(100.0)
# The omnidirectional model with xi = 1: r = sin(theta) / (1 + cos(theta)) = tan(theta / 2).
_STEREOGRAPHIC = Lens("omni", (1.0,))
# Sizes of the image, px.
_SMALLEST_PX, _LARGEST_PX = 64, 2048
# Most that one px of the mouse turns the camera, rad: a star 20 px from the zenith can still be led around it.
_MOST_RAD_PER_PX = 0.05


@dataclass(slots=True, eq=False)
class LookAround:
    """A camera that the user turns; it moves with the sky only, and has the sensor of the aircraft's camera."""

    is_on: bool = False
    azimuth_rad: float = 0.0  # From north through east
    altitude_rad: float = 0.0
    field_rad: float = _FIRST_RAD  # Horizontal field of view
    size_px: tuple[int, int] = (800, 600)  # Width and height of its image
    # The direction under the mouse when it was pressed: its azimuth, rad, and the sine of its altitude.
    _grabbed: tuple[float, float] = field(default=(0.0, 0.0), repr=False)
    _mouse_px: tuple[float, float] = field(default=(0.0, 0.0), repr=False)
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

    def grab(self, x_px: float, y_px: float) -> None:
        """Take hold of the direction at a position of the image, px."""
        across_rad, sine_altitude = _from_axis(self.camera.unit_vectors([x_px, y_px]).tolist(), self.altitude_rad)
        self._grabbed = self.azimuth_rad + across_rad, sine_altitude
        self._mouse_px = x_px, y_px

    def drag(self, x_px: float, y_px: float) -> None:
        """Turn the camera so that the grabbed direction is at a position of the image, px.

        A level camera has no direction of a higher altitude than the zenith's distance allows at that position: the
        grabbed direction then comes as near as it can.  Close to the zenith the camera follows more slowly.
        """
        unit = self.camera.unit_vectors([x_px, y_px]).tolist()
        azimuth_rad, sine_altitude = self._grabbed
        # sine = ahead sin(h) - down cos(h) = radius sin(h - lowered): two altitudes h of the camera, of which the
        # nearer one continues the drag.
        _, down, ahead = unit
        radius, lowered_rad = hypot(down, ahead), atan2(down, ahead)
        rise_rad = asin(min(max(sine_altitude / max(radius, 1e-9), -1.0), 1.0))
        up_rad = min(
            (remainder(lowered_rad + each - self.altitude_rad, 2 * pi) for each in (rise_rad, pi - rise_rad)), key=abs
        )
        altitude_rad = min(max(self.altitude_rad + up_rad, -pi / 2), pi / 2)
        right_rad = remainder(azimuth_rad - _from_axis(unit, altitude_rad)[0] - self.azimuth_rad, 2 * pi)
        most_rad = _MOST_RAD_PER_PX * dist(self._mouse_px, (x_px, y_px))
        self.altitude_rad += min(max(altitude_rad - self.altitude_rad, -most_rad), most_rad)
        self.azimuth_rad = (self.azimuth_rad + min(max(right_rad, -most_rad), most_rad)) % (2 * pi)
        self._mouse_px = x_px, y_px

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
        C_ned_own = ned_to_camera_matrix(aircraft.pointing(np.array([mid_s])))
        ned = image_border(aircraft.camera) @ C_ned_own
        return scene.camera.project(ned @ ned_to_camera_matrix(scene.shutter[1:2]).T)


def _from_axis(unit: Sequence[float], altitude_rad: float) -> tuple[float, float]:
    """Return the azimuth from the axis, rad, and the sine of the altitude of a unit vector (3,) of the camera.

    `altitude_rad`: of the camera.
    """
    right, down, ahead = unit
    sine, cosine = sin(altitude_rad), cos(altitude_rad)
    return atan2(right, ahead * cosine + down * sine), ahead * sine - down * cosine
