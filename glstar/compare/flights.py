"""Comparison of real images with the images that a flight predicts."""

from collections import Counter, OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.compare.alignment import (
    MIDDLE_GRAINS,
    MOST_GRAINS,
    Alignment,
    best_own_delay_s,
    fit_alignment,
    fit_own_delay,
)
from glstar.compare.coarsealignment import likely_delay_s, likely_readout, likely_start
from glstar.compare.comparison import Collector, ComparedImage, Comparison, RejectedImage, chance, rejection
from glstar.compare.detection import SubtractedImage, subtract_background
from glstar.compare.pairs import Pairing, measure, pair_trails
from glstar.compare.prediction import Trails, predicted_trails
from glstar.errors import ConfigError, ImagesError
from glstar.export.frame import frame_seed
from glstar.images import RealImage, TimeReference, exposure_of, read_grey
from glstar.images.times import LEAST_SEARCHED_S, local_zone_s, time_notes, with_common_grains, zone_note
from glstar.render.effects import scaled_keys
from glstar.render.scene.scene import Renderer
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_matrix, turn_from_quaternion

OnStep = Callable[[int, int], None]

# Memory for background-subtracted images between the iterations of a fit, bytes.
_CACHE_BYTES = 600 * 2**20
_BYTES_PER_PX = 9
# Largest number of images in a fit, evenly chosen: its error falls with the square root, its time grows in proportion.
_MAX_FITTED = 48
# The smallest standard deviation of the attitude error, rad, that a delay of a single image may explain: 0.02 deg.
_LEAST_TURN_RAD = 3.5e-4
# A mount with a larger standard error is not determined, deg.
_MAX_MOUNT_STD_DEG = 1.0
# Makes the noise of simulated images another one than that of images which glstar exported with the same seed.
_OTHER_NOISE = 1
_BY_HAND = "set clock or mount by hand first"


@dataclass(frozen=True, slots=True)
class Search:
    """How stars are searched for."""

    angle_rad: float = float(np.deg2rad(1.5))  # largest error of the camera's direction
    time_s: float = 1.0  # largest error of the camera's clock if its offset is fitted
    least_signal: float = 10.0  # smallest signal-to-noise ratio of a whole trail
    most_stars: int = 60  # largest number of stars per image, those of the highest signal-to-noise ratio


@dataclass(frozen=True, slots=True, eq=False)
class _Searched:
    """The last search in an image: its parameters, the motion of the camera by it, and the number of trails found."""

    mount: Mount
    delay_s: float
    readout_s: float
    motion: Float
    found: int


class FlightComparison:
    """Compares real images with simulated images of a flight.

    `exposure`: exposure time of images that do not state one, and the rate of sub-exposures; its start is ignored;
    `reference`: the instant of the exposure that an image's time refers to, if the time source does not state it;
    `own_length`: whether an exposure time in the image's metadata overrides that of `exposure`; `problems`: files that
    could not be used, as ``name: reason``; `seed`: the seed of the simulated noise.
    """

    def __init__(
        self,
        simulator: Simulator,
        renderer: Renderer,
        images: Sequence[RealImage],
        exposure: Exposure,
        *,
        reference: TimeReference = TimeReference.START,
        own_length: bool = True,
        search: Search | None = None,
        problems: Sequence[str] = (),
        seed: int = 0,
    ) -> None:
        self._simulator = simulator
        self._renderer = renderer
        self._search = search or Search()
        self._seed = seed
        self._sensor: Sensor | None = None
        self._subtracted: OrderedDict[Path, SubtractedImage] = OrderedDict()
        # The last search in each image.
        self._searches: dict[int, _Searched] = {}
        self._rejected = [RejectedImage(*_named(problem), kind="without a time or no image") for problem in problems]
        self._exposures: list[tuple[RealImage, Exposure]] = []
        self._reference = reference
        self._given_readout_s = exposure.readout_s
        self._stack = exposure
        times = with_common_grains([image.time for image in images])
        zone_s = local_zone_s(float(simulator.flight.position.longitude_rad[0]))
        for image in (replace(image, time=time) for image, time in zip(images, times, strict=True)):
            # Star paths are sampled at equal time steps, as for sub-exposures.
            even = replace(exposure, trail="sprites")
            ahead_s = simulator.flight.time_offset_s
            shutter = exposure_of(image.time, even, reference=reference, ahead_s=ahead_s, own_length=own_length)
            middle_s = shutter.start_utc_s + MIDDLE_GRAINS * image.time.grain_s
            shutter = replace(shutter, start_utc_s=middle_s)
            reason = self._uncovered(shutter)
            if reason is None:
                self._exposures.append((image, shutter))
            else:
                attitude = simulator.flight.attitude
                latest_s = attitude.last_s - shutter.span_s
                hint = zone_note(image.time, shutter.start_utc_s, (attitude.first_s, latest_s), zone_s)
                self._rejected.append(RejectedImage(image.path.name, reason[1] + hint, reason[0]))
        self._folder = images[0].path.parent if images else Path()
        self._time_sources = _count_sources(images)
        self._notes = time_notes(times, zone_s)

    def run(self, alignment: Alignment | None = None, *, on_step: OnStep | None = None) -> Comparison:
        """Compare all images.

        `alignment`: the result of `align`, to be applied; `on_step`: called with the number of images done, and of all.
        Raises ImagesError if no star of any image could be paired.
        """
        report = on_step or (lambda *_: None)
        mount = self._simulator.mount if alignment is None else alignment.mount
        delay_s = 0.0 if alignment is None else alignment.delay_s
        readout_s = self._given_readout_s if alignment is None else alignment.readout_s
        collected = Collector()
        collected.left_out.extend(self._rejected)
        for number, (image, _) in enumerate(self._exposures):
            try:
                sky = self._subtracted_image(image)
            except ImagesError as error:
                collected.reject(image.path.name, _kind_of(error), str(error).removeprefix(f"{image.path}: "))
                report(number + 1, len(self._exposures))
                continue
            own_s = self._own_delay_s(number, mount, delay_s, readout_s, alignment)
            pairing = self._find_trails(number, mount, delay_s + own_s, readout_s)
            if pairing is None:
                collected.reject(image.path.name, "beyond the flight", "its exposure, as fitted, leaves the flight")
            elif (reason := rejection(pairing, sky) or chance(pairing)) is not None:
                grain_s = image.time.grain_s
                steps = f"; its time is in steps of {grain_s:g} s, and all within were tried"
                collected.reject(image.path.name, reason[0], reason[1] + steps * (grain_s >= LEAST_SEARCHED_S))
            else:
                trails = pairing.trails
                compared = ComparedImage(
                    image.path.name,
                    self._exposure_at(number, delay_s + own_s, readout_s).start_utc_s,
                    len(trails),
                    len(pairing.found_indices),
                    pairing.astray,
                    trails.blended,
                    trails.cut_off,
                    tuple(float(x) for x in pairing.motion),
                )
                collected.add(compared, measure(image.path.name, sky, pairing))
            report(number + 1, len(self._exposures))
        return collected.result(alignment, self._time_sources, self._folder, self._notes)

    def _own_delay_s(
        self, number: int, mount: Mount, delay_s: float, readout_s: float, alignment: Alignment | None
    ) -> float:
        """Return the delay of an image whose time is in whole seconds beside the common one, s; 0 if it is exact."""
        image, shutter = self._exposures[number]
        grain_s = image.time.grain_s
        if grain_s < LEAST_SEARCHED_S:
            return 0.0
        common = replace(shutter, start_utc_s=shutter.start_utc_s + delay_s).with_readout_s(readout_s)
        simulator, sky = replace(self._simulator_for(), mount=mount), self._subtracted_image(image)
        searched_s = self._searched_delay_s(number, common, simulator, MOST_GRAINS * grain_s)
        turn_std_rad = max(_LEAST_TURN_RAD, 0.0 if alignment is None else alignment.attitude_std_rad)

        def find(own_s: float) -> Pairing | None:
            return self._find_trails(number, mount, delay_s + own_s, readout_s)

        def find_anywhere(own_s: float) -> Pairing | None:
            self._searches.pop(number, None)
            pairing = find(own_s)
            return pairing if pairing is not None and rejection(pairing, sky) is None else None

        own_s, pairing = fit_own_delay(find, searched_s, self._focal_px, grain_s, turn_std_rad)
        if pairing is not None and rejection(pairing, sky) is None:
            return own_s
        # A few stars are too little for a cross-correlation.
        tried_s = best_own_delay_s(find_anywhere, grain_s)
        return own_s if tried_s is None else fit_own_delay(find, tried_s, self._focal_px, grain_s, turn_std_rad)[0]

    def _searched_delay_s(self, number: int, common: Exposure, simulator: Simulator, search_s: float) -> float:
        """Return the likely delay of an image beside a common exposure, s."""
        sky = self._subtracted_image(self._exposures[number][0])
        return likely_delay_s((common, sky), simulator, search_px=self._search_px(), search_s=search_s)

    def align(
        self, *, fit_time: bool, fit_mount: bool, fit_readout: bool = False, on_step: OnStep | None = None
    ) -> Alignment | None:
        """Fit the clock offset, the mount, the readout time, or several of them to the trails of up to 48 images.

        `fit_time`, `fit_mount`, `fit_readout`: the parameters to fit; `on_step`: called with the number of images done,
        and the largest possible number.  Returns None if no image shows its trails.
        """
        if fit_readout and self._stack.frames > 1:
            raise ConfigError(
                f"is {self._stack.frames}, and the readout time is fitted to single exposures; set exposure.frames = 1",
                key="exposure.frames",
            )
        usable = self._usable_images()
        if not usable:
            return None
        simulator = self._simulator_for()
        grains_s = [self._exposures[number][0].time.grain_s for number in usable]
        exact = [number for number, grain_s in zip(usable, grains_s, strict=True) if grain_s < LEAST_SEARCHED_S]
        start = np.zeros(3), 0.0, self._given_readout_s
        if exact:
            start = self._start(exact, fit_time=fit_time, fit_readout=fit_readout)
        own_s = self._own_starts_s(usable, grains_s, start[1], self._search.time_s if fit_time and not exact else 0.0)
        if fit_time and not exact:
            start = start[0], float(np.median(own_s)), start[2]
            own_s = own_s - start[1]

        def find_trails(which: int, mount: Mount, delay_s: float, readout_s: float) -> Pairing | None:
            pairing = self._find_trails(usable[which], mount, delay_s, readout_s)
            if pairing is None:
                return None
            sky = self._subtracted_image(self._exposures[usable[which]][0])
            return pairing if rejection(pairing, sky) is None else None

        return fit_alignment(
            find_trails,
            len(usable),
            simulator.mount,
            fit_time=fit_time,
            fit_mount=fit_mount,
            fit_readout=fit_readout,
            readout_s=self._given_readout_s,
            focal_px=self._focal_px,
            start=(start[0] if fit_mount else np.zeros(3), *start[1:]),
            grains_s=grains_s,
            own_start_s=own_s.tolist(),
            on_step=on_step,
        )

    def _own_starts_s(self, usable: Sequence[int], grains_s: Sequence[float], delay_s: float, search_s: float) -> Float:
        """Return start values of the delays of images beside a common one, (n,) s: 0 where times are exact.

        `search_s`: how much farther the delay of all of them is searched for.
        """
        own_s = np.zeros(len(usable))
        for row, (number, grain_s) in enumerate(zip(usable, grains_s, strict=True)):
            if grain_s >= LEAST_SEARCHED_S:
                _, shutter = self._exposures[number]
                common = replace(shutter, start_utc_s=shutter.start_utc_s + delay_s)
                most_s = MOST_GRAINS * grain_s + search_s
                own_s[row] = self._searched_delay_s(number, common, self._simulator_for(), most_s)
        return own_s

    @property
    def _focal_px(self) -> float:
        return (self._simulator.camera.fx_px + self._simulator.camera.fy_px) / 2

    def _usable_images(self) -> list[int]:
        """Return the numbers of up to 48 images that can be read, evenly chosen."""
        if not self._exposures:
            return []
        usable = []
        for number in np.unique(np.linspace(0, len(self._exposures) - 1, _MAX_FITTED).astype(int)).tolist():
            with suppress(ImagesError):
                self._subtracted_image(self._exposures[number][0])
                usable.append(number)
        return usable

    def require_alignment(self, *, fit_time: bool, fit_mount: bool, on_step: OnStep | None = None) -> Alignment:
        """Return what `align` fits; raises ImagesError if the images do not determine the mount, or nothing at all."""
        fitted = self.align(fit_time=fit_time, fit_mount=fit_mount, on_step=on_step)
        if fitted is None:
            raise ImagesError(self._folder, f"no image shows the trails that the flight predicts; {_BY_HAND}")
        error_deg = float(np.rad2deg(fitted.turn_std_rad.max())) if fitted.fitted_mount else 0.0
        if not error_deg <= _MAX_MOUNT_STD_DEG:
            raise ImagesError(
                self._folder,
                f"{fitted.stars} stars in {fitted.images} images determine the mount only to {error_deg:.1f} deg: other"
                f" stars, by chance; {_BY_HAND}",
            )
        if not (fitted.fitted_time or fitted.fitted_mount):
            reason = "; ".join(fitted.notes) or "the images determine neither the clock nor the mount"
            raise ImagesError(self._folder, reason)
        return fitted

    def _start(self, usable: Sequence[int], *, fit_time: bool, fit_readout: bool) -> tuple[Float, float, float]:
        """Return start values: a rotation of the camera, rad, a delay, s, and a readout time, s."""
        simulator, search_px, given_s = self._simulator_for(), self._search_px(), self._given_readout_s
        images = [(self._exposures[number][1], self._subtracted_image(self._exposures[number][0])) for number in usable]
        search_s = self._search.time_s if fit_time else 0.0
        turn_rad, delay_s = likely_start(images, simulator, search_px=search_px, search_s=search_s)
        if not fit_readout:
            return turn_rad, delay_s, given_s

        def compensated_s(readout_s: float) -> float:
            # Another readout time of an unknown clock leaves the middle of the middle row where it is.
            return delay_s + fit_time * (0.5 - before) * (given_s - abs(readout_s))

        before = float(np.mean([self._fraction_before(number) for number in usable]))
        turn_rad, readout_s = likely_readout(
            images,
            simulator,
            search_px=search_px,
            given_s=given_s,
            exposure_at=lambda k, value_s: self._exposure_at(usable[k], compensated_s(value_s), value_s),
        )
        return turn_rad, compensated_s(readout_s), readout_s

    def _fraction_before(self, number: int) -> float:
        """Return the fraction of an image's exposure that lies before its time."""
        return self._exposures[number][0].time.fraction_before(self._reference)

    def _exposure_at(self, number: int, delay_s: float, readout_s: float) -> Exposure:
        """Return the exposure of one image, delayed, with a readout time; negative for the opposite direction."""
        exposure = self._exposures[number][1].with_readout_s(readout_s)
        early_s = self._fraction_before(number) * (exposure.readout_s - self._given_readout_s)
        return replace(exposure, start_utc_s=exposure.start_utc_s + delay_s - early_s)

    def _find_trails(self, number: int, mount: Mount, delay_s: float, readout_s: float) -> Pairing | None:
        """Find the trails of one image with a mount, a delay and a readout time; None outside of the flight."""
        image, _ = self._exposures[number]
        shutter = self._exposure_at(number, delay_s, readout_s)
        if self._uncovered(shutter) is not None:
            return None
        sky = self._subtracted_image(image)
        scene = replace(self._simulator_for(), mount=mount).scene(shutter)
        frame = self._renderer.render(scene, seed=frame_seed(self._seed, number, _OTHER_NOISE), light=True)
        trails = predicted_trails(
            scene,
            frame,
            noise_dn=sky.usual_noise_dn,
            least_signal=self._search.least_signal,
            most=self._search.most_stars,
        )
        trails = replace(trails, jacobian=_by_signed_readout(trails.jacobian, self._fraction_before(number), readout_s))
        parameters = mount, delay_s, readout_s
        pairing = self._find_nearby(number, sky, trails, *parameters)
        if pairing is None:
            pairing = pair_trails(sky, trails, search_px=self._search_px())
        self._searches[number] = _Searched(*parameters, pairing.motion, len(pairing.found_indices))
        return pairing

    def _find_nearby(
        self, number: int, sky: SubtractedImage, trails: Trails, mount: Mount, delay_s: float, readout_s: float
    ) -> Pairing | None:
        """Find trails near the positions that the last search implies; None if fewer are found than by that search."""
        if number not in self._searches:
            return None
        last = self._searches[number]
        turn_rad = turn_from_quaternion(quaternion_from_matrix(mount.C_camera_body @ last.mount.C_camera_body.T))
        motion = [*(last.motion - turn_rad), last.delay_s - delay_s, last.readout_s - readout_s]
        expected_px = trails.jacobian[:, :2, :5] @ np.array(motion)
        pairing = pair_trails(sky, trails, search_px=self._search_px(), expected_px=expected_px)
        return pairing if len(pairing.found_indices) >= max(1, 0.8 * last.found) else None

    def _search_px(self) -> float:
        camera = self._simulator.camera
        radius_px = max(camera.fx_px, camera.fy_px) * np.tan(self._search.angle_rad)
        return float(np.clip(radius_px, 4.0, 0.4 * min(camera.width_px, camera.height_px)))

    def _uncovered(self, shutter: Exposure) -> tuple[str, str] | None:
        """Return why the flight does not cover an exposure (kind, reason); None if it does."""
        attitude = self._simulator.flight.attitude
        if shutter.start_utc_s < attitude.first_s:
            return "beyond the flight", f"begins {_span(attitude.first_s - shutter.start_utc_s)} before the flight"
        if shutter.stop_utc_s > attitude.last_s:
            return "beyond the flight", f"ends {_span(shutter.stop_utc_s - attitude.last_s)} after the flight"
        gap = attitude.gap_within(shutter.start_utc_s, shutter.stop_utc_s)
        if gap is not None:
            return "in a gap of the log", f"its exposure meets {gap.reason} of the log, {gap.duration_s:.3f} s long"
        return None

    def _simulator_for(self) -> Simulator:
        return self._simulator if self._sensor is None else replace(self._simulator, sensor=self._sensor)

    def _subtracted_image(self, image: RealImage) -> SubtractedImage:
        """Return a real image without its background; all must have the bit depth of the first."""
        if image.path in self._subtracted:
            self._subtracted.move_to_end(image.path)
            return self._subtracted[image.path]
        pixels = read_grey(image.path)
        camera = self._simulator.camera
        if pixels.shape != (camera.height_px, camera.width_px):
            height, width = pixels.shape
            raise ImagesError(
                image.path,
                f"is {width} x {height} px and the camera {camera.width_px} x {camera.height_px} px; choose the camera"
                " that took it",
            )
        sensor = _sensor_of(pixels, self._simulator.sensor, image.path, self._stack)
        if self._sensor is not None and sensor.bit_depth != self._sensor.bit_depth:
            raise ImagesError(
                image.path,
                f"has {pixels.dtype.itemsize * 8} bits, and earlier images have another depth; compare them separately",
            )
        self._sensor = sensor
        saturation_dn = _saturation_dn(pixels, sensor, self._stack)
        sky = subtract_background(pixels, saturation_dn=saturation_dn)
        self._subtracted[image.path] = sky
        cached_px = sum(cached.above_dn.size for cached in self._subtracted.values())
        while len(self._subtracted) > 1 and _BYTES_PER_PX * cached_px > _CACHE_BYTES:
            cached_px -= self._subtracted.popitem(last=False)[1].above_dn.size
        return sky


def _by_signed_readout(jacobian: Float, before: float, readout_s: float) -> Float:
    """Return the Jacobian of trails for a readout time that is longer at the same image time, not the same start.

    `before`: fraction of the exposure before that time.  With a negative readout time, the rows open in the opposite
    direction.
    """
    signed = jacobian.copy()
    signed[..., 4] -= before * jacobian[..., 3]
    if readout_s < 0:
        signed[..., 4] *= -1
    return signed


def _saturation_dn(pixels: NDArray[Any], sensor: Sensor, exposure: Exposure) -> float:
    """Return the smallest value of a pixel that may be saturated, DN; in a stacked image, in one short exposure."""
    if exposure.frames == 1:
        return sensor.saturation_dn
    whole_dn = float(exposure.full_scale_dn(sensor.saturation_dn))
    return whole_dn / exposure.frames + float(np.median(pixels)) * (1 - 1 / exposure.frames)


def _sensor_of(pixels: NDArray[Any], sensor: Sensor, path: Path, exposure: Exposure) -> Sensor:
    """Return the sensor with the bit depth of a real image; a stacked image keeps the given one."""
    if exposure.frames > 1:
        largest_dn = exposure.full_scale_dn(sensor.saturation_dn)
        if int(pixels.max()) > largest_dn:
            raise ImagesError(
                path,
                f"has {int(pixels.max())} DN, and the {exposure.stack} of {exposure.frames} exposures of"
                f" {sensor.bit_depth} bits at most {largest_dn} DN; correct exposure.frames, exposure.stack or"
                " sensor.bit_depth",
            )
        return sensor
    if pixels.dtype == np.uint8 and sensor.bit_depth > 8:
        raise ImagesError(path, f"has 8 bits and the sensor of the config {sensor.bit_depth}; calibrate this camera")
    if pixels.dtype == np.uint16 and sensor.bit_depth <= 8:
        return sensor.with_bit_depth(16, scaled_keys())
    return sensor


def _kind_of(error: ImagesError) -> str:
    message = str(error)
    if " px and the camera " in message:
        return "of another size"
    return "of another depth" if " bits" in message else "broken"


def _named(problem: str) -> tuple[str, str]:
    file, _, reason = problem.partition(": ")
    return (file, reason) if reason else ("", problem)


def _count_sources(images: Sequence[RealImage]) -> str:
    counts = Counter(image.time.source for image in images)
    return ", ".join(f"{count} by {source}" for source, count in counts.most_common())


def _span(seconds: float) -> str:
    return f"{seconds:.3f} s" if seconds < 3600 else f"{seconds / 3600:.1f} h"
