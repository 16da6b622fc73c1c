"""Satellites as sources at rest, under a camera that also makes the motion of the satellite against the stars.

All that is computed for stars (paths, rows' times, horizon, lens, cloud, truth) then holds for satellites.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import ceil, pi

import numpy as np

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.render.motion.pointing import CameraMotion, MotionSamples
from glstar.render.scene.transmission import Sources, Transmission
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.satellites import Satellite, SatelliteView, visible_vmag
from glstar.sky.observed.solarsystem import observed_bodies
from glstar.sky.photometry import brightness_ratio

# Interval at which the light of a satellite is computed, s: it enters the Earth's shadow in some ten seconds.
_LIGHT_STEP_S = 0.25
_LEAST_TIMES, _MOST_TIMES = 3, 513
# Times at which the axis of the camera is compared with satellites.
_AXIS_TIMES = 9


@dataclass(frozen=True, slots=True, eq=False)
class SatelliteMotion(CameraMotion):
    """The camera's orientation with respect to a frame in which a satellite keeps its direction."""

    satellite: Satellite
    # (3,) direction of the source, true equator and equinox: that of the satellite in the middle of the exposure.
    direction_eq: Float
    sun_eq: Float  # (3,) unit vector to the Sun
    brightest_mag: float  # V magnitude at the brightest time of the exposure: that of the source

    def at(self, *utc_s: Float) -> list[MotionSamples]:
        """Return orientation, attitude and site for several arrays of times: see `CameraMotion.at`."""
        return [
            self._turned(samples, times_s)
            for samples, times_s in zip(CameraMotion.at(self, *utc_s), utc_s, strict=True)
        ]

    def seen(self, utc_s: Float) -> SatelliteView:
        """Return how the satellite is seen from the aircraft at some times, UTC seconds since 1970."""
        return self.satellite.seen(self.sky, utc_s, *self.flight.position.coordinates(utc_s))

    def field(self, stars: StarField) -> StarField:
        """Return the satellite as the only star of a field, in the frame of the stars of the scene."""
        return StarField(
            catalogue="satellites",
            star_id=np.array([self.satellite.number], dtype=np.int32),
            name=(self.satellite.name,),
            vmag=np.array([self.brightest_mag]),
            direction_eq=self.direction_eq[np.newaxis].copy(),
            epoch_utc_s=stars.epoch_utc_s,
            C_eq_icrs=stars.C_eq_icrs.copy(),
        )

    def _turned(self, samples: MotionSamples, utc_s: Float) -> MotionSamples:
        """Return samples in the frame of the satellite: vectors turned back by its motion since the middle."""
        turn = _turns(self.direction_eq, self.seen(utc_s).direction_eq)
        pointing = samples.pointing
        turned = replace(
            pointing,
            C_camera_eq=pointing.C_camera_eq @ turn,
            zenith_eq=_back(turn, pointing.zenith_eq),
            velocity_eq=_back(turn, pointing.velocity_eq),
            pole_eq=turn[:, 2],
        )
        return samples._replace(pointing=turned)


@dataclass(frozen=True, slots=True, eq=False)
class Sunlight:
    """The brightness of a satellite relative to its source's during one exposure: an `Attenuator`."""

    motion: SatelliteMotion
    exposure: Exposure
    max_change: float = 0.01

    @property
    def min_times(self) -> int:
        """Number of times between which the brightness changes little."""
        start_s, stop_s = _ends_s(self.exposure)
        return int(np.clip(ceil((stop_s - start_s) / _LIGHT_STEP_S) + 1, _LEAST_TIMES, _MOST_TIMES))

    @property
    def mean(self) -> float:
        """Mean brightness over the exposure."""
        return float(Transmission(self._brightness(self.min_times)).mean[0])

    def fraction(self, sources: Sources, times: int) -> Float:  # noqa: ARG002 - a satellite is the only source
        """Return the brightness at a number of times, (times, 1)."""
        return self._brightness(times)

    def _brightness(self, times: int) -> Float:
        motion = self.motion
        utc_s = np.linspace(*_ends_s(self.exposure), times)
        mag, lit = visible_vmag(motion.satellite, motion.seen(utc_s), motion.sun_eq)
        return np.asarray((lit * brightness_ratio(mag - motion.brightest_mag))[:, np.newaxis])


def passing_satellites(motion: CameraMotion, camera: Camera, exposure: Exposure) -> Iterator[SatelliteMotion]:
    """Yield the satellites of the sky that may be on the image of an exposure, and are in sunlight in it."""
    satellites = motion.sky.satellites
    if satellites is None:
        return
    start_s, stop_s = _ends_s(exposure)
    middle_s = (start_s + stop_s) / 2
    (samples,) = motion.at(np.linspace(start_s, stop_s, _AXIS_TIMES))
    axis_eq = samples.pointing.boresight_eq
    middle_eq = axis_eq[_AXIS_TIMES // 2]
    swing_rad = float(np.arccos(np.clip(axis_eq @ middle_eq, -1, 1)).max())
    angle_rad = camera.field_radius_rad + swing_rad + MAX_REFRACTION_RAD
    (sun,) = observed_bodies(motion.sky, middle_s, samples.site, ("Sun",))
    for satellite in satellites.near(
        motion.sky, middle_s, stop_s - start_s, samples.site, middle_eq, min(angle_rad, pi)
    ):
        times_s = np.array([start_s, middle_s, stop_s])
        seen = satellite.seen(motion.sky, times_s, *motion.flight.position.coordinates(times_s))
        mag, lit = visible_vmag(satellite, seen, sun.direction_eq)
        is_up = (np.sum(seen.direction_eq * samples.pointing.zenith_eq[[0, _AXIS_TIMES // 2, -1]], axis=1) > -0.1).any()
        if lit.max() > 0 and is_up and np.isfinite(seen.range_km).all():
            yield SatelliteMotion(
                flight=motion.flight,
                sky=motion.sky,
                mount=motion.mount,
                pressure_hpa=motion.pressure_hpa,
                temperature_c=motion.temperature_c,
                satellite=satellite,
                direction_eq=seen.direction_eq[1],
                sun_eq=sun.direction_eq,
                brightest_mag=float(mag.min()),
            )


def _ends_s(exposure: Exposure) -> tuple[float, float]:
    return exposure.start_utc_s, exposure.stop_utc_s


def _turns(first: Float, direction: Float) -> Float:
    """Return the shortest rotations that take a unit vector to others, (n, 3, 3)."""
    axis = np.cross(first, direction)
    cosine = direction @ first
    x, y, z = axis.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine)[:, np.newaxis, np.newaxis])


def _back(turn: Float, vector: Float) -> Float:
    """Return vectors (n, 3) turned by the inverses of rotations."""
    return np.asarray(np.einsum("nij,ni->nj", turn, vector))
