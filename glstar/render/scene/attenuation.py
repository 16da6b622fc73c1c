"""What changes the light of stars during one exposure: cloud, scintillation, the horizon, the Earth's shadow."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import CameraMotion
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.bodies import BodySources
from glstar.render.scene.clouds import CloudCover, cloud_sheet
from glstar.render.scene.culling import DrawList
from glstar.render.scene.occlusion import Ridge, divided
from glstar.render.scene.satellites import Sunlight
from glstar.render.scene.transmission import Attenuator, Sources, Transmission, transmission_through
from glstar.sky.air.extinction import Scintillation
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.photometry import brightness_ratio

# Segments are divided until no star's light changes by more than `Attenuator.max_change` within one, relative to its
# largest; of stars fainter than this fraction of the brightest light that arrives, relative to 1.
_FAINT = 0.05
# Light below this fraction does not count, such as that of a satellite in the shadow of the Earth.
_DARK = 1e-3
# Maximum number of parts of a segment.
_MAX_PARTS = 32
# Scintillation is computed whenever a star has moved by this, px, but not more often than this, s: half the time in
# which it is correlated.
_SCINTILLATION_STEP_PX = 2.0
_SCINTILLATION_STEP_S = 0.002
# Maximum number of these steps, and the minimum, below which it is computed once for the exposure.
_MOST_SCINTILLATION_STEPS, _LEAST_SCINTILLATION_STEPS = 512, 16
# Times of an exposure between which the rotation of the camera is measured for that.
_TURN_TIMES = 17
_NO_STARS = np.zeros(0, np.int32)


@dataclass(frozen=True, eq=False)
class StarScintillation:
    """Scintillation of stars during one exposure: an `Attenuator`; bodies are too large for it."""

    scintillation: Scintillation
    motion: CameraMotion
    exposure: Exposure
    px_per_rad: float  # Scale of the image
    max_change: float = 0.04

    @cached_property
    def min_times(self) -> int:
        """Number of times at which scintillation is computed; 2 where trails are too short to vary."""
        times_s = np.linspace(self.exposure.start_utc_s, self.exposure.stop_utc_s, _TURN_TIMES)
        (pointing,) = self.motion.pointings(times_s)
        turned_px = pointing.rotation_rad.sum() * self.px_per_rad
        span_s = self.exposure.stop_utc_s - self.exposure.start_utc_s
        steps = ceil(min(turned_px / _SCINTILLATION_STEP_PX, span_s / _SCINTILLATION_STEP_S, _MOST_SCINTILLATION_STEPS))
        return steps + 1 if steps >= _LEAST_SCINTILLATION_STEPS else 2

    def fraction(self, sources: Sources, times: int) -> Float:
        """Return the relative brightness at a number of times, (times, m): 1 of the sources of bodies."""
        count = len(sources.star_id)
        (samples,) = self.motion.at(np.array([self.exposure.mid_utc_s]))
        sine = samples.pointing.sine_apparent_altitude(sources.direction_eq[:count])[0]
        rms = self.scintillation.rms(sine, samples.site.height_m)
        start_s = self.exposure.start_utc_s
        span_s = self.exposure.stop_utc_s - start_s
        fraction = np.ones((times, len(sources.direction_eq)))
        if self.min_times == 2:
            fraction[:, :count] = self.scintillation.mean_factors(rms, sources.star_id, start_s, span_s)
        else:
            fraction[:, :count] = self.scintillation.factors(rms, sources.star_id, start_s, span_s, times)
        return fraction


@dataclass(frozen=True, slots=True, eq=False)
class Attenuation:
    """What changes the light of stars during one exposure; all of it is multiplied, in the order of the attributes."""

    sunlight: Sunlight | None = None  # Of the satellite that is the only star
    cloud: CloudCover | None = None
    scintillation: StarScintillation | None = None
    ridge: Ridge | None = None

    @classmethod
    def of(
        cls, motion: CameraMotion, camera: Camera, sensor: Sensor, exposure: Exposure, sunlight: Sunlight | None
    ) -> Self:
        """Return what changes the light of stars before the camera, by the keys of its sensor and its sky."""
        sheet = cloud_sheet(sensor, motion)
        rms = float(sensor.effects.get("sky.scintillation", 0.0))
        seed = int(sensor.effects.get("sky.scintillation_seed", 0))
        px_per_rad = max(camera.fx_px, camera.fy_px)
        return cls(
            sunlight,
            None if sheet is None else CloudCover(sheet, motion, exposure),
            StarScintillation(Scintillation(rms, seed), motion, exposure, px_per_rad) if rms else None,
            None if motion.sky.profile is None else Ridge(motion, exposure, px_per_rad),
        )

    @property
    def steady(self) -> tuple[Attenuator, ...]:
        """Attenuators that are not random, without the ridge."""
        return tuple(part for part in (self.sunlight, self.cloud) if part is not None)

    @property
    def gradual(self) -> tuple[Attenuator, ...]:
        """Attenuators that change within a trail without an edge: all but the ridge."""
        return self.steady if self.scintillation is None else (*self.steady, self.scintillation)

    @property
    def attenuators(self) -> tuple[Attenuator, ...]:
        """All, in the order in which they are multiplied."""
        return self.gradual if self.ridge is None else (*self.gradual, self.ridge)

    @property
    def min_times(self) -> int:
        """Number of times at which all are computed."""
        return max((part.min_times for part in self.attenuators), default=2)

    def steady_transmission(self, direction_eq: Float) -> Transmission | None:
        """Return what arrives of stars behind cloud, and of a satellite's changing light; None without either.

        `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox.
        """
        return _transmission(self.steady, direction_eq)

    def cloud_transmission(self, direction_eq: Float) -> Transmission | None:
        """Return what cloud transmits of stars, (m, 3) as for `steady_transmission`; None without cloud."""
        return None if self.cloud is None else _transmission((self.cloud,), direction_eq)

    def mean_scintillation(self, stars: StarField, index: NDArray[np.int32]) -> Float | None:
        """Return the mean relative brightness of stars by scintillation, (m,); None without."""
        if self.scintillation is None:
            return None
        return Transmission(self.scintillation.fraction(Sources.of(stars, index, None), self.min_times)).mean

    def dimmed(self, stars: StarField, draw_list: DrawList, time_fraction: Float) -> DrawList:
        """Return a draw list with its passage through segments or sub-exposures of some durations, (s,)."""
        if not len(draw_list) or not self.attenuators:
            return draw_list
        sources = Sources.of(stars, draw_list.index, None)
        return _with_passage(draw_list, transmission_through(self.attenuators, sources, self.min_times), time_fraction)

    def dimmed_bodies(self, bodies: BodySources | None, time_fraction: Float) -> BodySources | None:
        """Return bodies whose draw list has its passage."""
        if bodies is None:
            return None
        without = replace(self, scintillation=None)
        return replace(bodies, draw_list=without.dimmed(bodies.stars, bodies.draw_list, time_fraction))

    def behind(
        self, trails: AnalyticSegments, stars: StarField, draw_list: DrawList, bodies: BodySources | None
    ) -> tuple[AnalyticSegments, DrawList, BodySources | None]:
        """Return the trails, the stars and the bodies with their passage.

        Segments are divided where the transmission changes much within one.
        """
        sources, times = Sources.of(stars, draw_list.index, bodies), self.min_times
        if not len(sources.direction_eq) or not self.attenuators:
            return trails, draw_list, bodies
        parts, fraction = np.ones(len(trails), dtype=np.intp), np.ones(1)
        if self.gradual:
            fraction = transmission_through(self.gradual, sources, times).fraction
            magnitudes = [draw_list.observed_mag(stars)]
            magnitudes += [] if bodies is None else [bodies.draw_list.observed_mag(bodies.stars)]
            parts = self._gradual_parts(fraction, trails.time_fraction, brightness_ratio(np.concatenate(magnitudes)))
        if self.ridge is not None:
            above = self.ridge.fraction(sources, times)
            parts = np.maximum(parts, self.ridge.parts(above, trails.time_fraction))
            fraction = fraction * above
        trails = divided(trails, parts)
        of_stars, of_bodies = (Transmission(part) for part in np.split(fraction, [len(draw_list)], axis=1))
        if len(draw_list):
            draw_list = _with_passage(draw_list, of_stars, trails.time_fraction)
        if bodies is not None and len(bodies.draw_list):
            bodies = replace(bodies, draw_list=_with_passage(bodies.draw_list, of_bodies, trails.time_fraction))
        return trails, draw_list, bodies

    def _gradual_parts(self, fraction: Float, time_fraction: Float, brightness: Float) -> NDArray[np.intp]:
        """Return into how many parts each segment is divided, so that what arrives changes little within each, (s,)."""
        largest = fraction.max(axis=0)
        faintest = _FAINT * (brightness * largest).max()
        of_star = np.maximum(largest, faintest / brightness).clip(_DARK, 1.0)
        changes = (np.abs(np.diff(fraction, axis=0)) / of_star).max(axis=1)
        along = np.concatenate([[0.0], np.cumsum(changes)])
        ends = np.concatenate([[0.0], np.cumsum(time_fraction)])
        in_segment = np.diff(np.interp(ends / ends[-1], np.linspace(0, 1, len(along)), along))
        limit = min(part.max_change for part in self.gradual)
        return np.asarray(np.ceil(in_segment / limit).clip(1, _MAX_PARTS), dtype=np.intp)


NO_ATTENUATION = Attenuation()


def _transmission(attenuators: tuple[Attenuator, ...], direction_eq: Float) -> Transmission | None:
    if not attenuators:
        return None
    times = max(part.min_times for part in attenuators)
    return transmission_through(attenuators, Sources(direction_eq, _NO_STARS), times)


def _with_passage(draw_list: DrawList, transmission: Transmission, time_fraction: Float) -> DrawList:
    return replace(draw_list, passage=np.ascontiguousarray(transmission.means(time_fraction).T, dtype=np.float32))
