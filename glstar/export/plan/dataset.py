"""The frames of a data set: each of several flights under each sample of the config's sweep."""

import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import check_readouts, exposure_span_s
from glstar.config import START, Config, ExposureSection, exposures_within
from glstar.config.flight import SYNTHETIC, changes_length
from glstar.errors import ConfigError, ExportError, FlightTooShortError
from glstar.export.imagefiles.formats import ImageFormat, fit_format
from glstar.export.plan.frames import (
    MOST_FRAMES,
    ComposedFrame,
    Shot,
    SkippedFrame,
    across_gaps,
    count_frames,
    plan_frames,
)
from glstar.flight import Flight, PositionTrack
from glstar.render.simulator import Simulator
from glstar.sky.catalogue.reading import StarCatalogue

# Length of the hashes, hexadecimal digits: enough to distinguish two files in a message.
HASH_DIGITS = 12


def file_hash(path: Path) -> str:
    """Return the first digits of the SHA-256 of a file; returns: hexadecimal; a message if the file cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:HASH_DIGITS]
    except OSError as error:
        return f"unreadable ({error.strerror})"


_Prepared = tuple[Simulator, ExposureSection]

# Simulators that are cached, one per sample: consecutive frames belong to few samples.
_CACHED_SIMULATORS = 4
_DURATION = "exposure.duration_s"
_INTERVAL = "exposure.interval_s"
_READOUT = "exposure.readout_s"
_FRAMES = "exposure.frames"
_GAP = "exposure.gap_s"
_DELAY = "exposure.at_delay_s"
# Exposures are compared with the gaps of a log in blocks of this many frames.
_BLOCK = 1_000_000
_SITE_KEYS = {"flight.latitude_deg", "flight.longitude_deg", "flight.height_m"}


class _Times(NamedTuple):
    """Start of the first exposure, keys of ``[exposure]`` and length of the flight of each sample, s; float64."""

    start_s: NDArray[np.float64]
    duration_s: NDArray[np.float64]
    interval_s: NDArray[np.float64]
    readout_s: NDArray[np.float64]
    frames: NDArray[np.float64]
    gap_s: NDArray[np.float64]
    at_delay_s: NDArray[np.float64]
    length_s: NDArray[np.float64]

    @property
    def span_s(self) -> NDArray[np.float64]:
        """Time from the first opening to the last closing: of all rows and all short exposures, s."""
        return np.asarray(exposure_span_s(self.duration_s, self.readout_s, self.frames, self.gap_s))

    def check(self) -> None:
        """Raise if the rolling shutter of a sample begins to read a short exposure before it has read the last one."""
        tightest = np.argmin(np.where(self.frames > 1, self.duration_s + self.gap_s - self.readout_s, np.inf))
        one = (float(values[tightest]) for values in (self.duration_s, self.readout_s, self.frames, self.gap_s))
        check_readouts(*one)

    def of(self, exposure: ExposureSection, sample: int) -> ExposureSection:
        """Return a section with the times of one sample."""
        names = ("duration_s", "interval_s", "readout_s", "gap_s", "at_delay_s")
        update: dict[str, Any] = {name: float(getattr(self, name)[sample]) for name in names}
        return exposure.model_copy(update=update | {"frames": int(self.frames[sample])})


def largest_sum(config: Config) -> int:
    """Return the largest number of short exposures that any sample of a config's sweep adds; 1 if none does.

    The sensor has the same bits in all samples, so that their images have one scale.
    """
    samples = (config, *map(config.at, config.sweep.extremes()))
    return max(sample.exposure.signal_factor for sample in samples)


def _too_many(message: str) -> ConfigError:
    return ConfigError(f"{message}; at most {MOST_FRAMES:,} can be planned: fewer draws, shorter lists, or --frames")


@dataclass(frozen=True, eq=False)
class DataSetFrames:
    """The frames of several flights, each under every sample of the config's sweep.

    Frame numbers count through all samples of the first flight, then of the next.
    """

    config: Config
    flights: tuple[Flight, ...]  # As read with the config, without its sweep
    # By name in the config or its sweep; contains stars to the faintest magnitude of all samples.
    catalogues: Mapping[str, StarCatalogue]
    image_format: ImageFormat  # {"png", "png16", "tiff", "fits", "jpeg"}
    # The part of each flight, s from its first attitude; to the end of the flight if `stop_s` is None.
    start_s: float = 0.0
    stop_s: float | None = None
    frames: int | None = None  # Maximum number of frames of each sample
    # Tuple of (Path, str): hashes of `files` when the export was planned; if a file changes, its frames are refused.
    file_hashes: tuple[tuple[Path, str], ...] = ()

    @property
    def samples(self) -> int:
        """Number of samples of all flights together."""
        return len(self.flights) * len(self.config.sweep)

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Frame numbers, (n,) int64, increasing."""
        left_out = np.array([frame.number for frame in self.skipped], dtype=np.int64)
        return np.setdiff1d(np.arange(self._bounds[-1]), left_out, assume_unique=True)

    @property
    def firsts(self) -> NDArray[np.int64]:
        """First frame number of each sample of each flight, (m,) int64, increasing."""
        return self._bounds[:-1]

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """Frames that are left out because their exposure spans a gap in the log."""
        return self._planned[1]

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of the images."""
        _, sensor = fit_format(self.image_format, self.config.sensor(), summed=self._summed)
        return sensor.saturation_dn * self._summed

    @cached_property
    def _summed(self) -> int:
        return largest_sum(self.config)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that are read again for each sample."""
        return self.config.files

    def check_samples_fit(self) -> None:
        """Raise unless at least one exposure of every sample fits into its flight.

        Raises FlightTooShortError: with the index of the first flight into which none fits; ConfigError if there are
        more frames than can be planned.
        """
        _ = self._planned

    def shot(self, number: int) -> Shot:
        """Return when and how the camera exposes a frame; see `Frames`."""
        which = int(np.searchsorted(self._bounds, number, side="right")) - 1
        settings = self.settings_of(which)
        simulator, exposure = self._simulator(which)
        nth, start_s = number - int(self._bounds[which]), settings.get(START, self.start_s)
        first_s, index = simulator.flight.attitude.first_s, which // len(self.config.sweep)
        shift_s = first_s - self.flights[index].attitude.first_s
        if exposure.at is not None:
            shutter = exposure.starting_at(self._triggered[2][which][nth] + shift_s)
        else:
            shutter = exposure.nth(nth, first_s, start_s=start_s)
        about = {"flight": simulator.flight.name, "sample": which, "settings": settings}
        return Shot(simulator, shutter, index, which, settings, shift_s, about, exposure.exposure_control)

    def compose(self, number: int) -> ComposedFrame:
        """Return the scene of a frame; see `Frames`."""
        return self.shot(number).composed(number)

    def settings_of(self, which: int) -> dict[str, Any]:
        """Return what the sweep sets in a sample, by dotted key; `which` counts through all flights."""
        flight, sample = divmod(which, len(self.config.sweep))
        return self.config.sweep.sample(sample, salt=flight)

    @property
    def _bounds(self) -> NDArray[np.int64]:
        """First frame number of each sample, followed by the end of the last sample."""
        return self._planned[0]

    @cached_property
    def _planned(self) -> tuple[NDArray[np.int64], tuple[SkippedFrame, ...]]:
        """First frame number of each sample, and skipped frames; as arrays, for there may be millions of samples."""
        if self.samples > MOST_FRAMES:
            flights, sweep = len(self.flights), len(self.config.sweep)
            raise _too_many(f"{flights} flights under {sweep:,} samples each are {self.samples:,} samples")
        if self.config.exposure.at is not None:
            return self._triggered[:2]
        firsts = np.zeros(1, dtype=np.int64)
        for salt, flight in enumerate(self.flights):
            try:
                counts = self._counts(flight, self._times(salt, flight))
            except ConfigError as error:
                raise FlightTooShortError(salt, str(error)) from error
            ends = firsts[-1] + np.cumsum(counts)
            if ends[-1] > MOST_FRAMES:
                samples = (
                    f"{len(counts):,} samples of {flight.name}, of {counts.min():,} to {counts.max():,} frames each"
                )
                raise _too_many(f"{samples}, make {ends[-1]:,} frames")
            firsts = np.append(firsts, ends)
        skipped: list[SkippedFrame] = []
        of_a_flight = len(self.config.sweep)
        for salt, flight in enumerate(self.flights):
            if flight.attitude.gaps:
                bounds = firsts[salt * of_a_flight : (salt + 1) * of_a_flight + 1]
                skipped.extend(self._skipped_of(flight, self._times(salt, flight), bounds[:-1], int(bounds[-1])))
        return firsts, tuple(skipped)

    @cached_property
    def _triggered(self) -> tuple[NDArray[np.int64], tuple[SkippedFrame, ...], list[list[float]]]:
        """`_planned` of exposures at the triggers of a camera, and when each sample's shutter opens, UTC s."""
        firsts, skipped, opened_s = [0], list[SkippedFrame](), list[list[float]]()
        for salt, flight in enumerate(self.flights):
            times = self._times(salt, flight)
            for sample in range(len(self.config.sweep)):
                exposure, start_s = times.of(self.config.exposure, sample), float(times.start_s[sample])
                try:
                    plan = plan_frames(flight, exposure, start_s=start_s, stop_s=self.stop_s, frames=self.frames)
                except ConfigError as error:
                    raise FlightTooShortError(salt, str(error)) from error
                first_s = flight.attitude.first_s
                openings_s = {frame.number: frame.exposure.start_utc_s for frame in plan.frames}
                openings_s |= {frame.number: first_s + frame.start_s for frame in plan.skipped}
                numbers = {trigger: firsts[-1] + nth for nth, trigger in enumerate(sorted(openings_s))}
                skipped.extend(replace(frame, number=numbers[frame.number]) for frame in plan.skipped)
                opened_s.append([openings_s[trigger] for trigger in sorted(openings_s)])
                firsts.append(firsts[-1] + len(numbers))
        return np.array(firsts, dtype=np.int64), tuple(skipped), opened_s

    def _times(self, salt: int, flight: Flight) -> _Times:
        """Return the start, exposure time and interval of each sample of a flight, and how long it lasts."""
        exposure = self.config.exposure
        usual = {START: self.start_s, _DURATION: exposure.duration_s, _INTERVAL: exposure.interval_s}
        usual |= {_READOUT: exposure.readout_s, _FRAMES: exposure.frames, _GAP: exposure.gap_s}
        usual |= {_DELAY: exposure.at_delay_s}
        varied = {axis.key for axis in self.config.sweep.axes}
        columns = [
            np.array(self.config.sweep.column(key, salt=salt), dtype=np.float64)
            if key in varied
            else np.full(len(self.config.sweep), value)
            for key, value in usual.items()
        ]
        times = _Times._make((*columns, self._lengths(salt, flight)))
        times.check()
        return times

    def _lengths(self, salt: int, flight: Flight) -> NDArray[np.float64]:
        """Return the time from the first to the last attitude of each sample of a flight, s."""
        sweep = self.config.sweep
        if not changes_length({axis.key: None for axis in sweep.axes}):
            return np.full(len(sweep), flight.attitude.last_s - flight.attitude.first_s)
        samples = (self.config.at(sweep.sample(number, salt=salt)) for number in range(len(sweep)))
        return np.array([one.synthetic.flight().length_s for one in samples])

    def _counts(self, flight: Flight, times: _Times) -> NDArray[np.int64]:
        """Return the number of frames of each sample of a flight; raise if a sample has none."""
        stop_s = times.length_s if self.stop_s is None else np.minimum(self.stop_s, times.length_s)
        if not isfinite(self.start_s) or not np.isfinite(stop_s).all():
            count_frames(flight, self.config.exposure, start_s=self.start_s, stop_s=self.stop_s, frames=self.frames)
        counts = exposures_within(stop_s - times.start_s, times.span_s, times.interval_s)
        counts = counts if self.frames is None else np.minimum(counts, self.frames)
        wrong = np.flatnonzero((counts < 1) | (counts > MOST_FRAMES) | ~(times.start_s >= 0))
        for sample in (*wrong[:1].tolist(), 0):
            exposure = times.of(self.config.exposure, sample)
            start_s, length_s = float(times.start_s[sample]), float(times.length_s[sample])
            count_frames(flight, exposure, start_s=start_s, stop_s=self.stop_s, frames=self.frames, length_s=length_s)
        return counts

    def _skipped_of(self, flight: Flight, times: _Times, firsts: NDArray[np.int64], end: int) -> Iterator[SkippedFrame]:
        """Yield the frames of a flight that span a gap."""
        for block in range(int(firsts[0]), end, _BLOCK):
            numbers = np.arange(block, min(block + _BLOCK, end))
            sample = np.searchsorted(firsts, numbers, side="right") - 1
            begin_s = times.start_s[sample] + (numbers - firsts[sample]) * times.interval_s[sample]
            start_utc_s = flight.attitude.first_s + begin_s
            stop_utc_s = start_utc_s + times.span_s[sample]
            for k in np.flatnonzero(across_gaps(flight, start_utc_s, stop_utc_s)).tolist():
                gap = flight.attitude.gap_within(float(start_utc_s[k]), float(stop_utc_s[k]))
                assert gap is not None
                yield SkippedFrame(int(numbers[k]), float(begin_s[k]), gap.reason, round(gap.duration_s, 6))

    # --- simulators ---------------------------------------------------------------------------------------------------

    def _simulator(self, which: int) -> _Prepared:
        if which not in self._cache:
            self._cache[which] = self._prepared(which)
            while len(self._cache) > _CACHED_SIMULATORS:
                self._cache.popitem(last=False)
        return self._cache[which]

    def _prepared(self, which: int) -> _Prepared:
        settings = self.settings_of(which)
        config = self.config.at(settings)
        for path, expected in self.file_hashes:
            if file_hash(path) != expected:
                message = (
                    "has changed since the export began; put it back and run the same command again, or start over"
                )
                raise ExportError(path, f"{message} in another directory")
        _, sensor = fit_format(self.image_format, config.sensor(), summed=self._summed)
        stars = self.catalogues[config.sky.catalogue].brightest(config.sky.vmag_limit)
        if any(key.startswith(f"{SYNTHETIC}.") for key in settings):
            flight = config.open_flight(str(config.synthetic.description))
        else:
            flight = self.flights[which // len(self.config.sweep)]
        flight = self._flight(flight, config, settings)
        return config.simulator(flight, sensor=sensor, stars=stars), config.exposure

    def _flight(self, flight: Flight, config: Config, settings: dict[str, Any]) -> Flight:
        """Return a flight at the time and site of a sample, with its camera clock."""
        if "flight.utc_start" in settings and config.flight.start_utc_s is not None:
            flight = flight.shifted(config.flight.start_utc_s - flight.attitude.first_s)
        flight = replace(flight, time_offset_s=config.flight.time_offset_s)
        if _SITE_KEYS & settings.keys() and config.flight.site is not None:
            flight = replace(flight, position=PositionTrack.fixed(config.flight.site), position_source="given")
        return flight

    @cached_property
    def _cache(self) -> OrderedDict[int, _Prepared]:
        return OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the cached simulators, which another process builds when it needs them."""
        return {key: value for key, value in self.__dict__.items() if key != "_cache"}
