"""What the camera does during one exposure, and the true paths of stars that follow from it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import CameraMotion, MotionSamples
from glstar.render.motion.segmentation import ROLLING_POSITION_PX, TOLERANCES, segment_times
from glstar.render.motion.segmentfit import fitted_segments
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.attenuation import Attenuation
from glstar.render.scene.bodies import BodySources
from glstar.render.scene.culling import DrawList, StarCuller, TouchingStars
from glstar.render.scene.transmission import Sources
from glstar.sky.air.extinction import Extinction
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.place.site import Site

# A sample of the log within 20 microseconds of the start or the end of an exposure does not divide it: rounding of the
# exposure's time must not change the image.
_NODE_MARGIN_S = 2e-5
# Path tolerance of truth, px.  The mean position over an exposure is exact to second order whatever the tolerance.
TRUTH_TOLERANCE_PX = 0.01
# Motion that takes no more segments than this through every sample is not fitted: a steady turn of 200 deg/s takes 7 in
# 0.2 s.
_FEW_SEGMENTS = 12


@dataclass(frozen=True, eq=False)
class ExposureMotion:
    """What the camera does during one exposure; paths and stars are computed when they are first needed."""

    motion: CameraMotion
    exposure: Exposure
    camera: Camera
    sensor: Sensor
    stars: StarField  # With magnitudes in the band of the sensor
    extinction: Extinction | None
    attenuation: Attenuation

    @property
    def shutter_s(self) -> Float:
        """When the shutter opens, the middle of the exposure, and when the shutter closes, UTC seconds since 1970."""
        return np.array([self.exposure.start_utc_s, self.exposure.mid_utc_s, self.exposure.stop_utc_s])

    @cached_property
    def shutter(self) -> MotionSamples:
        """The camera at these three times."""
        (shutter,) = self.motion.at(self.shutter_s)
        return shutter

    def culler(self, stars: StarField, site: Site) -> StarCuller:
        """Return the culler of stars in the air above a site."""
        zenith_mag = None if self.extinction is None else self.extinction.zenith_mag(site.height_m)
        return StarCuller(stars, self.camera, self.sensor, zenith_mag)

    @cached_property
    def drawn_segments(self) -> AnalyticSegments:
        """The segments that the exposure is drawn in."""
        tolerance_px = self.exposure.path_tolerance_px
        if tolerance_px == 0:
            return self._exact_segments
        if tolerance_px == TRUTH_TOLERANCE_PX or self._few_segments is not None:
            return self.true_segments
        fitted = self._fitted_segments(tolerance_px)
        return self._exact_segments if fitted is None else fitted

    @cached_property
    def true_segments(self) -> AnalyticSegments:
        """The few or the fitted segments, or segments through every sample of the log where a fit fails."""
        if self._few_segments is not None:
            return self._few_segments
        if self._fitted is not None:
            return self._fitted
        return self._exact_segments

    @cached_property
    def touching(self) -> TouchingStars:
        """The stars that may touch the image along their true paths."""
        return self._touching_along(self.true_segments)

    def touching_along(self, segments: AnalyticSegments) -> TouchingStars:
        """Return the stars that may touch the image along the segments that it is drawn in."""
        tolerance_px = self.exposure.path_tolerance_px
        is_few = tolerance_px != 0 and segments is self._few_segments
        if is_few or (tolerance_px == TRUTH_TOLERANCE_PX and segments is self._fitted):
            return self.touching
        return self._touching_along(segments)

    def _touching_along(self, segments: AnalyticSegments) -> TouchingStars:
        culler = self.culler(self.stars, self.shutter.site)
        return culler.touching(segments.pointing, self.half_fractions(segments), self.exposure.duration_s)

    def half_fractions(self, segments: AnalyticSegments) -> Float:
        """Return the durations of the halves of segments, (2 m,) fractions of the exposure time."""
        return segments.half_fractions(self.exposure.span_s / self.exposure.duration_s)

    @cached_property
    def _few_segments(self) -> AnalyticSegments | None:
        """Segments through every sample of the log, if few suffice: a fit gains nothing then."""
        return self._segments(_FEW_SEGMENTS)

    @cached_property
    def _fitted(self) -> AnalyticSegments | None:
        """Least-squares segments, whose mean positions equal the interpolated attitude's."""
        return self._fitted_segments(TRUTH_TOLERANCE_PX)

    def _fitted_segments(self, tolerance_px: float) -> AnalyticSegments | None:
        return fitted_segments(
            self.motion,
            self._nodes_s,
            self.camera,
            self.sensor.core.effective_sigma_px,
            tolerance_px,
            psf_sigma_px=self.sensor.core.psf_sigma_px,
            position_px=self._position_px,
            readout_s=self.exposure.readout_s,
        )

    @cached_property
    def _exact_segments(self) -> AnalyticSegments:
        """Segments that pass through every sample of the log."""
        exact = self._segments(None)
        assert exact is not None
        return exact

    def _segments(self, most: int | None) -> AnalyticSegments | None:
        """Return segments that pass through every sample of the log; None if it takes more than a number of them."""
        times_s = segment_times(
            self.motion,
            self._nodes_s,
            self.camera,
            self.sensor.core.effective_sigma_px,
            most=most,
            position_px=self._position_px,
        )
        if times_s is None:
            return None
        (pointing,) = self.motion.pointings(times_s)
        return AnalyticSegments(
            pointing,
            np.diff(times_s[::2]) / (times_s[-1] - times_s[0]),
            half_fraction=np.diff(times_s) / self.exposure.duration_s,
        )

    @property
    def _nodes_s(self) -> Float:
        """The exposure's start and end and the samples of attitude between them, UTC seconds since 1970."""
        exposure, samples_s = self.exposure, self.motion.flight.attitude.utc_s
        inside_s = [exposure.start_utc_s + _NODE_MARGIN_S, exposure.stop_utc_s - _NODE_MARGIN_S]
        first, last = np.searchsorted(samples_s, inside_s)
        return np.concatenate([[exposure.start_utc_s], samples_s[first:last], [exposure.stop_utc_s]])

    @property
    def _position_px(self) -> float:
        """Largest distance between a star's position on a path and where it is drawn at the same time, px."""
        return ROLLING_POSITION_PX if self.exposure.readout_s else TOLERANCES.position_px


@dataclass(frozen=True, eq=False)
class ExposureListing:
    """The stars that may touch the image of one exposure, along their true paths: a `StarListing`."""

    path: ExposureMotion
    bodies: BodySources | None

    @cached_property
    def stars(self) -> DrawList:
        """The stars whose paths may touch the image, and how far from it each is noticed."""
        return self.path.touching.listed

    @cached_property
    def trails(self) -> AnalyticSegments:
        """The true paths, finely divided where a star or a body sets behind a horizon profile."""
        ridge, segments = self.path.attenuation.ridge, self.path.true_segments
        if ridge is None:
            return segments
        return ridge.divided(segments, Sources.of(self.path.stars, self.path.touching.index, self.bodies))
