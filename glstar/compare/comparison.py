"""A comparison: real images of a flight, or two folders of images, paired star by star."""

from collections import Counter, OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor import Sensor
from glstar.compare.alignment import Alignment, fit_alignment, likely_start
from glstar.compare.backgroundsubtraction import SubtractedImage, subtract_background
from glstar.compare.pairs import Cutouts, Measures, Pair, Pairing, measure, pair_trails
from glstar.compare.predictedtrails import Trails, predicted_trails
from glstar.compare.summary import by_star, summarize
from glstar.errors import ImagesError
from glstar.export.task import frame_seed
from glstar.images import RealImage, TimeReference, exposure_of, read_grey
from glstar.render.scene import Renderer
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_matrix, turn_from_quaternion

__all__ = ["Collector", "ComparedImage", "Comparison", "FlightComparison", "RejectedImage", "Search", "too_few"]

Float = NDArray[np.float64]
OnStep = Callable[[int, int], None]

# So much of images made ready is kept while their trails are fitted.
_CACHE_BYTES: Final = 600 * 2**20
# A fit looks at no more images than this, evenly chosen.
_MOST_FITTED: Final = 48
# Of the pairs that agree best and worst so many are shown.
_SHOWN: Final = 8
# One star that fits where many should be is chance.
_ENOUGH_PREDICTED, _LEAST_FOUND, _LEAST_SHARE = 6, 3, 0.1
_BURNT_SHARE: Final = 0.3


@dataclass(frozen=True, slots=True)
class RejectedImage:
    """An image that could not be compared.

    Attributes
    ----------
    file : str
    reason : str
        Why, in words.
    kind : str
        The same in a word or two, to be counted.
    """

    file: str
    reason: str
    kind: str


@dataclass(frozen=True, slots=True)
class Search:
    """How stars are looked for.

    Attributes
    ----------
    angle_rad : float
        How far the camera may look beside where it is thought to look, rad.
    time_s : float
        How far the camera's clock may be off where its offset is fitted, s.
    least_signal : float
        How many times the noise a whole simulated trail must be.
    most_stars : int
        How many stars of an image are looked for, the clearest.
    """

    angle_rad: float = float(np.deg2rad(1.5))
    time_s: float = 1.0
    least_signal: float = 10.0
    most_stars: int = 60


@dataclass(frozen=True, slots=True)
class ComparedImage:
    """What was seen on one real image.

    Attributes
    ----------
    file : str
    start_utc_s : float or None
        When the simulated exposure begins, by the flight's clock, UTC seconds since 1970.
    predicted, found, astray, blended, cut_off : int
        How many trails were looked for, found, and found where the others say it cannot be; how many were not looked
        for, as another star's light lies on them or as they leave the image.
    turn_rad : tuple of float or None
        By how much the camera seems turned from where it was thought to look, about its right, down and forward axes.
    """

    file: str
    start_utc_s: float | None
    predicted: int
    found: int
    astray: int
    blended: int
    cut_off: int
    turn_rad: tuple[float, ...] | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """What a comparison found.

    Attributes
    ----------
    images : tuple of ComparedImage
    left_out : tuple of RejectedImage
    pairs : tuple of Pair
    best, worst : tuple of (Pair, Cutouts)
        Some of the pairs: those whose centroids are nearest, and farthest beyond what noise does.
    alignment : Alignment or None
        What was fitted first.
    time_sources : str
        Who says when the images were taken, or how they were paired.
    """

    images: tuple[ComparedImage, ...]
    left_out: tuple[RejectedImage, ...]
    pairs: tuple[Pair, ...]
    best: tuple[tuple[Pair, Cutouts], ...]
    worst: tuple[tuple[Pair, Cutouts], ...]
    alignment: Alignment | None
    time_sources: str

    @property
    def summary(self) -> dict[str, Any]:
        """The paper's numbers over all pairs; see `summarize`."""
        return summarize(self.pairs)

    @property
    def stars(self) -> list[dict[str, Any]]:
        """What is said of each star; see `by_star`."""
        return by_star(self.pairs)


class Collector:
    """Pairs as they come, and the pictures of the best and the worst of them."""

    def __init__(self) -> None:
        self.images: list[ComparedImage] = []
        self.left_out: list[RejectedImage] = []
        self.pairs: list[Pair] = []
        self._best: list[tuple[Pair, Cutouts]] = []
        self._worst: list[tuple[Pair, Cutouts]] = []

    def take(self, seen: ComparedImage, measures: Measures) -> None:
        """Add what was seen on an image.

        Parameters
        ----------
        seen : ComparedImage
        measures : Measures
        """
        self.images.append(seen)
        self.pairs.extend(measures.pairs)
        own = list(zip(measures.pairs, measures.pictures, strict=True))
        self._best = sorted(self._best + own, key=lambda one: one[0].centroid_px)[:_SHOWN]
        self._worst = sorted(self._worst + own, key=lambda one: -one[0].beyond_noise_px)[:_SHOWN]

    def leave(self, file: str, kind: str, reason: str) -> None:
        """Add an image that cannot be compared.

        Parameters
        ----------
        file, kind, reason : str
            As `RejectedImage` has them.
        """
        self.left_out.append(RejectedImage(file, reason, kind))

    def concluded(self, alignment: Alignment | None, time_sources: str, blamed: Path) -> Comparison:
        """Return the comparison.

        Parameters
        ----------
        alignment : Alignment or None
        time_sources : str
        blamed : Path
            Where the images are.

        Returns
        -------
        Comparison

        Raises
        ------
        ImagesError
            If there is no pair; it says why.
        """
        if not self.pairs:
            raise ImagesError(blamed, _nothing_paired(self.left_out))
        return Comparison(
            tuple(self.images),
            tuple(self.left_out),
            tuple(self.pairs),
            tuple(self._best),
            tuple(self._worst),
            alignment,
            time_sources,
        )


def _nothing_paired(left_out: Sequence[RejectedImage]) -> str:
    kinds = Counter(one.kind for one in left_out)
    counted = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    first = next((one for one in left_out if one.kind == kinds.most_common(1)[0][0]), None) if left_out else None
    return f"no star of any image could be paired: {counted}; {first.file}: {first.reason}" if first else "no image"


class FlightComparison:
    """Compares real images with what a flight says they should show.

    Parameters
    ----------
    simulator : Simulator
    renderer : Renderer
    images : sequence of RealImage
    wanted : Exposure
        How long exposures are where an image does not say, and in how many sub-exposures; its start does not count.
    reference : TimeReference
        What an image's time means, where that is not known.
    own_length : bool
        Whether an image's own word on its exposure counts.
    search : Search
    problems : sequence of str
        What could not be used already: ``name: reason``.
    seed : int
        The seed of the simulated noise.
    """

    def __init__(
        self,
        simulator: Simulator,
        renderer: Renderer,
        images: Sequence[RealImage],
        wanted: Exposure,
        *,
        reference: TimeReference = TimeReference.START,
        own_length: bool = True,
        search: Search | None = None,
        problems: Sequence[str] = (),
        seed: int = 0,
    ) -> None:
        self._simulator, self._renderer = simulator, renderer
        self._search = search or Search()
        self._seed = seed
        self._sensor: Sensor | None = None
        self._skies: OrderedDict[Path, SubtractedImage] = OrderedDict()
        # Of each image the last look: with which mount, how much later, what motion was seen, how many trails.
        self._looks: dict[int, tuple[Mount, float, Float, int]] = {}
        self._refused = [RejectedImage(*_named(problem), kind="without a time or no image") for problem in problems]
        self._shots: list[tuple[RealImage, Exposure]] = []
        for image in images:
            # Trails are followed at even moments: those of sub-exposures.
            even = replace(wanted, trail="sprites")
            ahead_s = simulator.flight.time_offset_s
            shutter = exposure_of(image.time, even, reference=reference, ahead_s=ahead_s, own_length=own_length)
            reason = self._unknown(shutter)
            if reason is None:
                self._shots.append((image, shutter))
            else:
                self._refused.append(RejectedImage(image.path.name, reason[1], reason[0]))
        self._blamed = images[0].path.parent if images else Path()
        self._time_sources = _witnesses(images)

    def run(self, alignment: Alignment | None = None, *, on_step: OnStep | None = None) -> Comparison:
        """Compare all images.

        Parameters
        ----------
        alignment : Alignment, optional
            What `align` found: the images are compared with it.
        on_step : callable
            Called with how many images are done, and of how many.

        Returns
        -------
        Comparison

        Raises
        ------
        ImagesError
            If no star of any image could be paired.
        """
        tell = on_step or (lambda *_: None)
        mount = self._simulator.mount if alignment is None else alignment.mount
        delay_s = 0.0 if alignment is None else alignment.delay_s
        collected = Collector()
        collected.left_out.extend(self._refused)
        for number, (image, shutter) in enumerate(self._shots):
            try:
                sky = self._sky(image)
            except ImagesError as error:
                collected.leave(image.path.name, _kind_of(error), str(error).removeprefix(f"{image.path}: "))
                tell(number + 1, len(self._shots))
                continue
            pairing = self._look(number, mount, delay_s)
            if pairing is None:
                collected.leave(image.path.name, "beyond the flight", "its exposure, as fitted, leaves the flight")
            elif (reason := too_few(pairing, sky)) is not None:
                collected.leave(image.path.name, *reason)
            else:
                trails = pairing.trails
                seen = ComparedImage(
                    image.path.name,
                    shutter.start_utc_s + delay_s,
                    len(trails),
                    len(pairing.found_indices),
                    pairing.astray,
                    trails.blended,
                    trails.cut_off,
                    tuple(float(x) for x in pairing.motion),
                )
                collected.take(seen, measure(image.path.name, sky, pairing))
            tell(number + 1, len(self._shots))
        return collected.concluded(alignment, self._time_sources, self._blamed)

    def align(self, *, fit_time: bool, fit_mount: bool, on_step: OnStep | None = None) -> Alignment | None:
        """Return the clock's offset, the mount, or both, that make the trails of some images agree.

        Parameters
        ----------
        fit_time, fit_mount : bool
            What to find.
        on_step : callable
            Called with how many looks have been taken, and how many may be at most.

        Returns
        -------
        Alignment or None
            None where no image shows its trails.
        """
        good = []
        for number in np.unique(np.linspace(0, len(self._shots) - 1, _MOST_FITTED).astype(int)) if self._shots else ():
            try:
                self._sky(self._shots[number][0])
            except ImagesError:
                continue
            good.append(int(number))
        if not good:
            return None
        simulator = self._simulator_for()
        camera = simulator.camera
        search_px = self._search_px()
        start = likely_start(
            [(self._shots[number][1], self._sky(self._shots[number][0])) for number in good],
            simulator,
            search_px=search_px,
            search_s=self._search.time_s if fit_time else 0.0,
        )
        if not fit_mount:
            start = np.zeros(3), start[1]

        def look(which: int, mount: Mount, delay_s: float) -> Pairing | None:
            pairing = self._look(good[which], mount, delay_s)
            if pairing is None or too_few(pairing, self._sky(self._shots[good[which]][0])) is not None:
                return None
            return pairing

        return fit_alignment(
            look,
            len(good),
            simulator.mount,
            fit_time=fit_time,
            fit_mount=fit_mount,
            focal_px=(camera.fx_px + camera.fy_px) / 2,
            start=start,
            on_step=on_step,
        )

    def _look(self, number: int, mount: Mount, delay_s: float) -> Pairing | None:
        """FindTrails for the trails of one image with a mount, so much later; None where the flight does not say."""
        image, shutter = self._shots[number]
        shutter = replace(shutter, start_utc_s=shutter.start_utc_s + delay_s)
        if self._unknown(shutter) is not None:
            return None
        sky = self._sky(image)
        scene = replace(self._simulator_for(), mount=mount).scene(shutter)
        frame = self._renderer.render(scene, seed=frame_seed(self._seed, number), light=True)
        trails = predicted_trails(
            scene,
            frame,
            noise_dn=sky.usual_noise_dn,
            least_signal=self._search.least_signal,
            most=self._search.most_stars,
        )
        pairing = self._again(number, sky, trails, mount, delay_s)
        if pairing is None:
            pairing = pair_trails(sky, trails, search_px=self._search_px())
        self._looks[number] = mount, delay_s, pairing.motion, len(pairing.found_indices)
        return pairing

    def _again(self, number: int, sky: SubtractedImage, trails: Trails, mount: Mount, delay_s: float) -> Pairing | None:
        """FindTrails where the last look at an image puts its trails now; None where that does not find as many."""
        if number not in self._looks:
            return None
        mount_then, previous_delay_s, motion, found = self._looks[number]
        turn_rad = turn_from_quaternion(quaternion_from_matrix(mount.C_camera_body @ mount_then.C_camera_body.T))
        expected_px = trails.jacobian[:, :2, :4] @ np.append(motion - turn_rad, previous_delay_s - delay_s)
        pairing = pair_trails(sky, trails, search_px=self._search_px(), expected_px=expected_px)
        return pairing if len(pairing.found_indices) >= max(1, 0.8 * found) else None

    def _search_px(self) -> float:
        camera = self._simulator.camera
        reach_px = max(camera.fx_px, camera.fy_px) * np.tan(self._search.angle_rad)
        return float(np.clip(reach_px, 4.0, 0.4 * min(camera.width_px, camera.height_px)))

    def _unknown(self, shutter: Exposure) -> tuple[str, str] | None:
        """Return why the flight cannot say what an exposure shows, in a word and in words."""
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

    def _sky(self, image: RealImage) -> SubtractedImage:
        """Return a real image made ready; the first one's depth is that of all."""
        there = self._skies.get(image.path)
        if there is not None:
            self._skies.move_to_end(image.path)
            return there
        pixels = read_grey(image.path)
        camera = self._simulator.camera
        if pixels.shape != (camera.height_px, camera.width_px):
            height, width = pixels.shape
            raise ImagesError(
                image.path,
                f"is {width} x {height} px and the camera {camera.width_px} x {camera.height_px} px; name the camera"
                " that took it",
            )
        sensor = _sensor_of(pixels, self._simulator.sensor, image.path)
        if self._sensor is not None and sensor.bit_depth != self._sensor.bit_depth:
            raise ImagesError(image.path, f"has {pixels.dtype.itemsize * 8} bits, others have not; compare them apart")
        self._sensor = sensor
        sky = subtract_background(pixels, saturation_dn=sensor.saturation_dn)
        self._skies[image.path] = sky
        while len(self._skies) > 1 and sum(9 * each.above_dn.size for each in self._skies.values()) > _CACHE_BYTES:
            self._skies.popitem(last=False)
        return sky


def _sensor_of(pixels: NDArray[Any], sensor: Sensor, path: Path) -> Sensor:
    """Return the sensor with as many bits as a real image has."""
    if pixels.dtype == np.uint8 and sensor.bit_depth > 8:
        raise ImagesError(path, f"has 8 bits and the sensor of the config {sensor.bit_depth}; calibrate this camera")
    if pixels.dtype == np.uint16 and sensor.bit_depth <= 8:
        return sensor.with_bit_depth(16)
    return sensor


def too_few(pairing: Pairing, sky: SubtractedImage) -> tuple[str, str] | None:
    """Return why an image is not compared.

    Parameters
    ----------
    pairing : Pairing
    sky : SubtractedImage

    Returns
    -------
    (str, str) or None
        In a word and in words; None where enough of its stars were found.
    """
    predicted, found = len(pairing.trails), len(pairing.found_indices)
    if not predicted:
        if sky.saturated_fraction > _BURNT_SHARE:
            return "burnt out", f"{sky.saturated_fraction:.0%} of its pixels are at the sensor's limit"
        return "without a predicted star", (
            f"no star clear of its noise ({sky.usual_noise_dn:.1f} DN) and alone lies whole on it"
        )
    enough = max(_LEAST_FOUND, _LEAST_SHARE * predicted) if predicted >= _ENOUGH_PREDICTED else predicted / 2
    if found >= enough:
        return None
    if sky.saturated_fraction > _BURNT_SHARE:
        return "burnt out", f"{sky.saturated_fraction:.0%} of its pixels are at the sensor's limit"
    return "without a star found", (
        f"of {predicted} predicted trails {found or 'none'} could be found: cloud, another time, or a camera that looks"
        " elsewhere (--search-angle)"
    )


def _kind_of(error: ImagesError) -> str:
    words = str(error)
    return "of another size" if " px and the camera " in words else "of another depth" if " bits" in words else "broken"


def _named(problem: str) -> tuple[str, str]:
    file, _, reason = problem.partition(": ")
    return (file, reason) if reason else ("", problem)


def _witnesses(images: Sequence[RealImage]) -> str:
    counts = Counter(image.time.source for image in images)
    return ", ".join(f"{count} by {witness}" for witness, count in counts.most_common())


def _span(seconds: float) -> str:
    return f"{seconds:.3f} s" if seconds < 3600 else f"{seconds / 3600:.1f} h"
