"""The frames of a data set: flights, and what varies from one sample of them to the next."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.catalogue import StarCatalogue
from glstar.config import START, Config, ExposureSection
from glstar.export.frames import Composed
from glstar.export.images import ImageFormat, fitting
from glstar.export.plan import SkippedFrame, count_frames, skipped_frames
from glstar.simulator import Simulator
from glstar.track import Flight, PositionTrack

__all__ = ["DataSetFrames"]

_Prepared = tuple[Simulator, ExposureSection]

# A simulator serves all frames of a sample; those of the last few samples are kept.
_KEPT: Final = 4
_OF_THE_PLAN: Final = {START, "exposure.duration_s", "exposure.interval_s", "exposure.rate_hz"}
_OF_THE_PLACE: Final = {"flight.latitude_deg", "flight.longitude_deg", "flight.height_m"}


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
    """

    config: Config
    flights: tuple[Flight, ...]
    catalogues: Mapping[str, StarCatalogue]
    image_format: ImageFormat
    start_s: float = 0.0
    stop_s: float | None = None
    frames: int | None = None

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
        return fitting(self.image_format, self.config.sensor())[1].saturation_dn

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are read again for each sample."""
        return self.config.files

    def compose(self, number: int) -> Composed:
        """Return what a frame shows; see `Frames`."""
        which = int(np.searchsorted(self._firsts, number, side="right")) - 1
        settings = self._settings(which)
        simulator, exposure = self._simulator(which)
        nth, start_s = number - int(self._firsts[which]), settings.get(START, self.start_s)
        shutter = exposure.nth(nth, simulator.flight.attitude.first_s, start_s=start_s)
        about = {"flight": simulator.flight.name, "sample": which, "settings": settings}
        return Composed(number, simulator.scene(shutter), about)

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
        firsts = np.zeros(self.samples + 1, dtype=np.int64)
        skipped: list[SkippedFrame] = []
        for which, (flight, settings) in enumerate(self._plan_settings()):
            start_s = settings.pop(START, self.start_s)
            exposure = self.config.exposure
            if settings:
                exposure = exposure.model_copy(update={key.partition(".")[2]: value for key, value in settings.items()})
            count = count_frames(flight, exposure, start_s=start_s, stop_s=self.stop_s, frames=self.frames)
            first = int(firsts[which])
            left_out = skipped_frames(flight, exposure, start_s=start_s, count=count)
            skipped.extend(replace(frame, number=frame.number + first) for frame in left_out)
            firsts[which + 1] = first + count
        return firsts, tuple(skipped)

    def _plan_settings(self) -> Iterator[tuple[Flight, dict[str, Any]]]:
        """Yield of each sample the flight and what of its settings decides how many frames it has, and when."""
        keys = [axis.key for axis in self.config.sweep.axes if axis.key in _OF_THE_PLAN]
        for salt, flight in enumerate(self.flights):
            columns = [self.config.sweep.column(key, salt=salt) for key in keys]
            for which in range(len(self.config.sweep)):
                yield flight, {key: column[which] for key, column in zip(keys, columns, strict=True)}

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
        _, sensor = fitting(self.image_format, config.sensor())
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
