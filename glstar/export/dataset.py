"""The frames of a data set: flights, and what varies from one sample of them to the next."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.config import START, Config, ExposureSection, exposures_within
from glstar.errors import ConfigError, ExportError, FlightTooShortError
from glstar.export.fingerprint import file_hash
from glstar.export.frames import ComposedFrame
from glstar.export.images import ImageFormat, fit_format
from glstar.export.plan import MOST_FRAMES, SkippedFrame, across_gaps, count_frames
from glstar.flight import Flight, PositionTrack
from glstar.render.simulator import Simulator
from glstar.sky.catalogue import StarCatalogue

__all__ = ["DataSetFrames"]

_Prepared = tuple[Simulator, ExposureSection]

# A simulator serves all frames of a sample; those of the last few samples are kept.
_KEPT: Final = 4
_DURATION: Final = "exposure.duration_s"
_INTERVAL: Final = "exposure.interval_s"
# Exposures are compared with the gaps of a log in blocks of this many frames.
_BLOCK: Final = 1_000_000
_OF_THE_PLACE: Final = {"flight.latitude_deg", "flight.longitude_deg", "flight.height_m"}


class _Times(NamedTuple):
    """When the frames of each sample of a flight begin, how long they are, how often they come; (samples,) float64."""

    start_s: NDArray[np.float64]
    duration_s: NDArray[np.float64]
    interval_s: NDArray[np.float64]


def _too_many(words: str) -> ConfigError:
    return ConfigError(f"{words}; at most {MOST_FRAMES:,} can be planned: fewer draws, shorter lists, or --frames")


@dataclass(frozen=True, eq=False)
class DataSetFrames:
    """The frames of several flights, each of them under every sample of the config's sweep.

    Numbers run through the samples of the first flight, then through those of the next.

    Attributes
    ----------
    config : Config
    flights : tuple of Flight
        As the config reads them, without its sweep.
    catalogues : mapping of str to StarCatalogue
        By the name that the config or its sweep has for it, to the faintest magnitude asked for.
    image_format : {"png", "png16", "tiff"}
    start_s, stop_s : float
        The part of each flight, s from its first attitude; to its end where `stop_s` is None.
    frames : int or None
        Of each sample no more than so many.
    file_hashes : tuple of (Path, str)
        Hashes of `files` when the export was planned: frames of a file that has changed since would be mixed with the
        others.
    """

    config: Config
    flights: tuple[Flight, ...]
    catalogues: Mapping[str, StarCatalogue]
    image_format: ImageFormat
    start_s: float = 0.0
    stop_s: float | None = None
    frames: int | None = None
    file_hashes: tuple[tuple[Path, str], ...] = ()

    @property
    def samples(self) -> int:
        """How many samples there are of all flights together."""
        return len(self.flights) * len(self.config.sweep)

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """The frames' places in the sequence, (n,) int64, rising."""
        left_out = np.array([frame.number for frame in self.skipped], dtype=np.int64)
        return np.setdiff1d(np.arange(self._firsts[-1]), left_out, assume_unique=True)

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """What of the sequence cannot be drawn truly."""
        return self._planned[1]

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of their images."""
        return fit_format(self.image_format, self.config.sensor())[1].saturation_dn

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are read again for each sample."""
        return self.config.files

    def check_samples_fit(self) -> None:
        """Raise unless every sample has an exposure in its flight.

        Raises
        ------
        FlightTooShortError
            By the place of the first flight that has none.
        ConfigError
            If there are more frames than can be planned.
        """
        _ = self._planned

    def compose(self, number: int) -> ComposedFrame:
        """Return what a frame shows; see `Frames`."""
        which = int(np.searchsorted(self._firsts, number, side="right")) - 1
        settings = self._settings(which)
        simulator, exposure = self._simulator(which)
        nth, start_s = number - int(self._firsts[which]), settings.get(START, self.start_s)
        shutter = exposure.nth(nth, simulator.flight.attitude.first_s, start_s=start_s)
        about = {"flight": simulator.flight.name, "sample": which, "settings": settings}
        return ComposedFrame(number, simulator.scene(shutter), about)

    def _settings(self, which: int) -> dict[str, Any]:
        flight, sample = divmod(which, len(self.config.sweep))
        return self.config.sweep.sample(sample, salt=flight)

    @property
    def _firsts(self) -> NDArray[np.int64]:
        """The number with which each sample begins, and where the last one ends."""
        return self._planned[0]

    @cached_property
    def _planned(self) -> tuple[NDArray[np.int64], tuple[SkippedFrame, ...]]:
        """Where each sample begins, and what is skipped; without an object a sample, for there are millions."""
        if self.samples > MOST_FRAMES:
            flights, sweep = len(self.flights), len(self.config.sweep)
            raise _too_many(f"{flights} flights under {sweep:,} samples each are {self.samples:,} samples")
        firsts = np.zeros(1, dtype=np.int64)
        for salt, flight in enumerate(self.flights):
            try:
                counts = self._counts(flight, self._times(salt))
            except ConfigError as error:
                raise FlightTooShortError(salt, str(error)) from error
            ends = firsts[-1] + np.cumsum(counts)
            if ends[-1] > MOST_FRAMES:
                words = f"{len(counts):,} samples of {flight.name}, of {counts.min():,} to {counts.max():,} frames each"
                raise _too_many(f"{words}, make {ends[-1]:,} frames")
            firsts = np.append(firsts, ends)
        skipped: list[SkippedFrame] = []
        of_a_flight = len(self.config.sweep)
        for salt, flight in enumerate(self.flights):
            if flight.attitude.gaps:
                bounds = firsts[salt * of_a_flight : (salt + 1) * of_a_flight + 1]
                skipped.extend(self._skipped_of(flight, self._times(salt), bounds[:-1], int(bounds[-1])))
        return firsts, tuple(skipped)

    def _times(self, salt: int) -> _Times:
        """Return when the frames of each sample of a flight begin, how long they are, and how often they come."""
        exposure = self.config.exposure
        usual = {START: self.start_s, _DURATION: exposure.duration_s, _INTERVAL: exposure.interval_s}
        varied = {axis.key for axis in self.config.sweep.axes}
        columns = (
            np.array(self.config.sweep.column(key, salt=salt), dtype=np.float64)
            if key in varied
            else np.full(len(self.config.sweep), value)
            for key, value in usual.items()
        )
        return _Times(*columns)

    def _counts(self, flight: Flight, times: _Times) -> NDArray[np.int64]:
        """Return how many frames each sample of a flight has; raise for the first that has none."""
        length_s = flight.attitude.last_s - flight.attitude.first_s
        stop_s = length_s if self.stop_s is None else min(self.stop_s, length_s)
        if not isfinite(self.start_s) or not isfinite(stop_s):
            count_frames(flight, self.config.exposure, start_s=self.start_s, stop_s=self.stop_s, frames=self.frames)
        counts = exposures_within(stop_s - times.start_s, times.duration_s, times.interval_s)
        counts = counts if self.frames is None else np.minimum(counts, self.frames)
        wrong = np.flatnonzero((counts < 1) | (counts > MOST_FRAMES) | ~(times.start_s >= 0))
        for sample in (*wrong[:1].tolist(), 0):
            exposure = self.config.exposure.model_copy(
                update={"duration_s": float(times.duration_s[sample]), "interval_s": float(times.interval_s[sample])}
            )
            start_s = float(times.start_s[sample])
            count_frames(flight, exposure, start_s=start_s, stop_s=self.stop_s, frames=self.frames)
        return counts

    def _skipped_of(self, flight: Flight, times: _Times, firsts: NDArray[np.int64], end: int) -> Iterator[SkippedFrame]:
        """Yield what of a flight's frames, from the first of its samples to its end, spans a gap."""
        for block in range(int(firsts[0]), end, _BLOCK):
            numbers = np.arange(block, min(block + _BLOCK, end))
            sample = np.searchsorted(firsts, numbers, side="right") - 1
            begin_s = times.start_s[sample] + (numbers - firsts[sample]) * times.interval_s[sample]
            start_utc_s = flight.attitude.first_s + begin_s
            stop_utc_s = start_utc_s + times.duration_s[sample]
            for k in np.flatnonzero(across_gaps(flight, start_utc_s, stop_utc_s)).tolist():
                gap = flight.attitude.gap_within(float(start_utc_s[k]), float(stop_utc_s[k]))
                assert gap is not None
                yield SkippedFrame(int(numbers[k]), float(begin_s[k]), gap.reason, round(gap.duration_s, 6))

    # --- simulators ---------------------------------------------------------------------------------------------------

    def _simulator(self, which: int) -> _Prepared:
        if which not in self._kept:
            self._kept[which] = self._prepared(which)
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return self._kept[which]

    def _prepared(self, which: int) -> _Prepared:
        settings = self._settings(which)
        config = self.config.at(settings)
        for path, expected in self.file_hashes:
            if file_hash(path) != expected:
                words = "has changed since the export began; put it back and run the same command again, or start over"
                raise ExportError(path, f"{words} in another directory")
        _, sensor = fit_format(self.image_format, config.sensor())
        stars = self.catalogues[config.sky.catalogue].brightest(config.sky.vmag_limit)
        flight = self._flight(self.flights[which // len(self.config.sweep)], config, settings)
        return config.simulator(flight, sensor=sensor, stars=stars), config.exposure

    def _flight(self, flight: Flight, config: Config, settings: dict[str, Any]) -> Flight:
        """Return a flight at the time and the place of a sample, by its camera's clock."""
        if "flight.utc_start" in settings and config.flight.start_utc_s is not None:
            flight = flight.shifted(config.flight.start_utc_s - flight.attitude.first_s)
        flight = replace(flight, time_offset_s=config.flight.time_offset_s)
        if _OF_THE_PLACE & settings.keys() and config.flight.site is not None:
            flight = replace(flight, position=PositionTrack.fixed(config.flight.site), position_source="given")
        return flight

    @cached_property
    def _kept(self) -> OrderedDict[int, _Prepared]:
        return OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Leave behind what another process makes itself when it needs it."""
        return {key: value for key, value in self.__dict__.items() if key != "_kept"}
