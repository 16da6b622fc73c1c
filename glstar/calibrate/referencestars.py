"""The catalogue stars that an image may show, as apparent directions over a site or without one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.rowturns import RowTurns
from glstar.camera.model import Camera
from glstar.render.pointing import Pointing
from glstar.sky.horizon import diurnal_aberration_rad
from glstar.sky.observed import Sky
from glstar.sky.site import Site
from glstar.sky.starfield import StarField

__all__ = ["ReferenceStars"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceStars:
    """Catalogue stars with the refraction and the aberration that act on their directions.

    Attributes
    ----------
    stars : StarField
        The brightest first.
    zenith_eq, velocity_eq : (3,) float64
        The direction of the zenith, and the observer's velocity over the speed of light; zeros if the site is unknown.
        The zenith may be known from the refraction of the photograph alone; see `glstar.calibrate.zenithfit`.
    refraction_scale : float
        The result of `glstar.sky.horizon.refraction_scale`; 0 if the site is unknown.
    C_ned_eq : (3, 3) float64 or None
        Rotation from the true equator and equinox of date to north, east, down; None if site or time is unknown.
    rows : RowTurns or None
        How the aircraft turned while a rolling shutter read the image; None if one attitude holds for all rows.
    zenith_error_rad : float or None
        Standard error of a zenith from refraction, rad; None if time and site state it, or if it is unknown.
    """

    stars: StarField
    zenith_eq: Float
    velocity_eq: Float
    refraction_scale: float
    C_ned_eq: Float | None
    rows: RowTurns | None = None
    zenith_error_rad: float | None = None

    @staticmethod
    def over(sky: Sky, utc_s: float, site: Site) -> "ReferenceStars":
        """Return the stars over a site at a time.

        Parameters
        ----------
        sky : Sky
        utc_s : float
            UTC seconds since 1970.
        site : Site

        Returns
        -------
        ReferenceStars
        """
        C = sky.C_ned_eq([utc_s], [site.latitude_rad], [site.longitude_rad])[0]
        speed = diurnal_aberration_rad(site.latitude_rad, site.height_m)
        return ReferenceStars(sky.star_field(utc_s), -C[2], speed * C[1], sky.refraction_scale(site), C)

    @staticmethod
    def anywhere(sky: Sky, utc_s: float) -> "ReferenceStars":
        """Return the stars of the whole sphere, without a horizon and without refraction.

        Parameters
        ----------
        sky : Sky
        utc_s : float
            UTC seconds since 1970, for proper motion; an error of a few years is negligible.

        Returns
        -------
        ReferenceStars
        """
        return ReferenceStars(sky.star_field(utc_s), np.zeros(3), np.zeros(3), 0.0, None)

    def to_camera(self, C_camera_eq: Float) -> Float:
        """Return the apparent directions in the camera frame.

        Parameters
        ----------
        C_camera_eq : (3, 3) float64
            Rotation from the true equator and equinox of date to the camera frame.

        Returns
        -------
        (n, 3) float64
            NaN below the horizon.
        """
        pointing = Pointing(
            C_camera_eq[np.newaxis], self.zenith_eq[np.newaxis], self.velocity_eq[np.newaxis], self.refraction_scale
        )
        return np.asarray(pointing.to_camera(self.stars.direction_eq)[0])

    def recorded(self, C_camera_eq: Float, star: Index, xy_px: Float, camera: Camera) -> Float:
        """Return the directions of stars on an image in the camera frame, with a rolling shutter each in its own row.

        Parameters
        ----------
        C_camera_eq : (3, 3) float64
            As for `to_camera`; with a rolling shutter in the middle of the exposure of the middle row.
        star : (k,) intp
            Indices of the stars.
        xy_px : (k, 2) float64
            Where they are on the image as it was recorded, px.
        camera : Camera
            Of the size of the image.

        Returns
        -------
        (k, 3) float64
            NaN below the horizon.
        """
        if self.rows is None:
            return np.asarray(self.to_camera(C_camera_eq)[star])
        return np.asarray(self.rows.turned(self.to_camera(np.eye(3))[star], xy_px, camera) @ C_camera_eq.T)
