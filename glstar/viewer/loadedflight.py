"""A flight that the viewer shows, with everything computed from it, and the thread that loads flights."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.config.reading import extinction_of, observed_sky
from glstar.errors import LogFormatError
from glstar.export.navfile import estimates
from glstar.flight import AttitudeTrack, Flight
from glstar.render.simulator import Simulator
from glstar.sky.timescale import CLOCK_GRAIN_S
from glstar.viewer.attitudechoices import AttitudeFinder
from glstar.viewer.flightlines import FlightLines
from glstar.viewer.liveflight import Buffered
from glstar.viewer.missing import SITE_KEYS, MissingFromLog, flight_keys
from glstar.viewer.overlays import Overlays
from glstar.viewer.playhead import PlayHead
from glstar.viewer.skysamples import SkySampler

__all__ = ["BEFORE_EXPOSURE_S", "FlightLoader", "LoadedFlight"]

# Seconds of a live flight taken from the link before the exposure: gaps are detected by its usual sample interval.
BEFORE_EXPOSURE_S: Final = 5.0


@dataclass(slots=True, eq=False)
class LoadedFlight:
    """A flight and all that the viewer computes from it.

    Attributes
    ----------
    path : Path or None
        The log; None for a flight received from a link.
    config : Config
        The settings with which it was loaded.
    given : mapping of str to object
        Dotted keys of the config that the user gave for this log only: the UTC and the site that it lacks.
    flight : Flight
        Of a live flight, a copy of the link's buffer, replaced twice a second.
    lines : FlightLines
        The curves of the timeline.
    simulator : Simulator
    overlays : Overlays
    estimate : AttitudeTrack or None
        What the aircraft estimated, if ``[navigator]`` names another message of the log.
    head : PlayHead
    read_with : Config
        The settings with which the log was read; `config` changes later.
    """

    path: Path | None
    config: Config
    given: Mapping[str, Any]
    flight: Flight
    lines: FlightLines
    simulator: Simulator
    overlays: Overlays
    estimate: AttitudeTrack | None = None
    head: PlayHead = field(init=False)
    read_with: Config = field(init=False)

    def __post_init__(self) -> None:
        self.read_with = self.config
        attitude = self.flight.attitude
        self.head = PlayHead(attitude.first_s, attitude.last_s, self.config.exposure, grows=self.is_live)

    @property
    def is_live(self) -> bool:
        """Whether the flight comes from a link and still grows."""
        return self.path is None

    @classmethod
    def make(cls, path: Path | None, config: Config, given: Mapping[str, Any], flight: Flight) -> "LoadedFlight":
        """Return a flight with its simulator, its overlays and its curves.

        Parameters
        ----------
        path : Path or None
            None for a flight received from a link.
        config : Config
        given : mapping of str to object
            Dotted keys of the config that hold for this log only.
        flight : Flight

        Returns
        -------
        LoadedFlight
        """
        simulator = config.simulator(flight)
        lines = FlightLines.of(flight.aircraft_attitude, flight.attitude.first_s)
        return cls(path, config, given, flight, lines, simulator, Overlays(simulator.sky.catalogue))

    @classmethod
    def read(cls, path: Path, config: Config, given: Mapping[str, Any]) -> "LoadedFlight":
        """Read a log.

        Parameters
        ----------
        path : Path
        config : Config
        given : mapping of str to object
            Dotted keys of the config that hold for this log only.

        Returns
        -------
        LoadedFlight

        Raises
        ------
        GlstarError
            If the log cannot be replayed.
        """
        loaded = cls.make(path, config, given, config.open_flight(path))
        [loaded.estimate] = estimates(config, [path])
        return loaded

    def use(self, config: Config) -> None:
        """Change the settings; star directions are computed again only if the sky changes.

        Parameters
        ----------
        config : Config

        Raises
        ------
        GlstarError
            If the simulator refuses the settings; nothing changes then.
        """
        before = self.config
        if config is before:
            return
        self.simulator = _with_settings(self.simulator, before, config)
        self.head.exposure_section = config.exposure
        if config.sky.catalogue != before.sky.catalogue:
            self.overlays = Overlays(self.simulator.sky.catalogue)
        self.config = config

    def as_read(self, config: Config) -> Config:
        """Return settings with the ``[flight]`` and ``navigator.attitude`` with which the log was read.

        Parameters
        ----------
        config : Config

        Returns
        -------
        Config
        """
        present, wanted = config.flight, self.read_with.flight
        differing = [key for key in type(wanted).model_fields if getattr(present, key) != getattr(wanted, key)]
        before = {f"flight.{key}": getattr(wanted, key) for key in differing}
        if config.navigator.attitude != self.read_with.navigator.attitude:
            before["navigator.attitude"] = self.read_with.navigator.attitude
        unset = [key for key, value in before.items() if value is None]
        return config.without(*unset).override(**before)

    def extend_to(self, utc_s: float, buffered: Buffered | None) -> None:
        """Extend a live flight to its latest attitude.

        Parameters
        ----------
        utc_s : float
            Of the latest attitude, UTC seconds since 1970.
        buffered : Buffered or None
            A newer copy of the link's buffer, if there is one.
        """
        if buffered is not None:
            self.flight, self.lines = buffered
        self.head.grow(min(self.flight.attitude.first_s, utc_s), utc_s)

    def extend(self, exposure: Exposure, last: Callable[[float], Flight | None]) -> bool:
        """Extend the simulator's flight with the samples of a live flight that an exposure needs.

        Parameters
        ----------
        exposure : Exposure
        last : callable
            Returns the last seconds of the live flight; None if there are too few samples.

        Returns
        -------
        bool
            Whether it was extended.
        """
        head, attitude = self.head, self.simulator.flight.attitude
        opens_s = exposure.start_utc_s + CLOCK_GRAIN_S
        if attitude.first_s <= opens_s and exposure.stop_utc_s <= attitude.last_s:
            return False
        flight = last(head.last_s - exposure.start_utc_s + BEFORE_EXPOSURE_S)
        if flight is None:
            return False
        self.simulator = self.simulator.with_flight(flight)
        # Samples that the link has dropped from its buffer meanwhile cannot be shown.
        in_buffer = flight.attitude.first_s <= opens_s
        head.grow(head.first_s if in_buffer else flight.attitude.first_s, flight.attitude.last_s)
        return True

    def continue_from(self, before: "LoadedFlight") -> None:
        """Take over mode, speed and loop from the flight shown before, and the position and markers in the same log.

        Parameters
        ----------
        before : LoadedFlight
        """
        head, old = self.head, before.head
        head.mode, head.loop, head.speed = old.mode, old.loop, old.speed
        if self.path == before.path:
            head.seek(old.utc_s)
            head.markers, head.playing = old.markers, old.playing


def _with_settings(simulator: Simulator, before: Config, config: Config) -> Simulator:
    """Return a simulator with other settings."""
    sky = ("catalogue", "vmag_limit", "astrometry")
    other_sky = any(getattr(config.sky, name) != getattr(before.sky, name) for name in sky)
    if other_sky or config.star_brightness() != before.star_brightness():
        return config.simulator(simulator.flight)
    return replace(
        simulator,
        gimbal=config.gimbal,
        flight=config.gimbal.carried(simulator.flight),
        sky=observed_sky(config.sky, simulator.sky.catalogue),
        camera=config.camera(),
        mount=config.navigator.real_mount(config.mount()),
        sensor=config.sensor(),
        pressure_hpa=config.air.pressure_hpa,
        temperature_c=config.air.temperature_c,
        bodies=config.sky.bodies,
        extinction=extinction_of(config.sky, config.air, config.sensor().colour),
    )


class FlightLoader:
    """Loads one flight at a time on a thread of its own, and records the missing inputs of a log.

    Attributes
    ----------
    missing : MissingFromLog or None
        The UTC and the site that the log opened last lacks, until the user gives them or cancels.
    last_opened : Path or None
        The log opened last, even if it could not be read.
    start_s : float or None
        Where the play head of the next flight is at first, s from its first attitude; None for there.
    typed_site : dict of str to str
        The site typed last, by key of ``[flight]``: the initial contents of the dialog.
    sampler : SkySampler
        Computes the curves of the timeline that need simulated exposures.
    finder : AttitudeFinder
        Finds the attitudes among which the user can choose.
    """

    def __init__(self) -> None:
        self.missing: MissingFromLog | None = None
        self.last_opened: Path | None = None
        self.start_s: float | None = None
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-open-flight")
        self._pending: tuple[Path | None, Mapping[str, Any], Future[LoadedFlight]] | None = None
        self.typed_site: dict[str, str] = {}
        self.sampler, self.finder = SkySampler(), AttitudeFinder()
        # The UTC typed last for each log.
        self._typed_utc: dict[Path, str] = {}

    @property
    def is_busy(self) -> bool:
        """Whether a flight is being loaded."""
        return self._pending is not None

    @property
    def works(self) -> bool:
        """Whether a flight is being loaded, or curves or attitudes of the log are being computed."""
        return self.is_busy or self.sampler.is_busy or self.finder.is_busy

    @property
    def is_done(self) -> bool:
        """Whether a flight has been loaded, and `take` returns at once."""
        return self._pending is not None and self._pending[2].done()

    @property
    def path(self) -> Path | None:
        """The log that is being read; None if there is none, or if the flight comes from a link."""
        return None if self._pending is None else self._pending[0]

    def read(self, path: Path, config: Config, given: Mapping[str, Any]) -> None:
        """Begin to read a log; a flight that is still being loaded is dropped.

        Parameters
        ----------
        path : Path
        config : Config
        given : mapping of str to object
            Dotted keys of the config that hold for this log only.
        """
        self.missing, self.last_opened = None, path
        self.drop()
        self._pending = path, given, self._thread.submit(LoadedFlight.read, path, config, given)

    def follow(self, loaded: LoadedFlight, config: Config, given: Mapping[str, Any]) -> None:
        """Begin to read the log shown again, unless it was read with the same settings.

        Parameters
        ----------
        loaded : LoadedFlight
            From a log.
        config : Config
        given : mapping of str to object
            Dotted keys of the config that hold for this log only.
        """
        read = loaded.read_with
        assert loaded.path is not None
        if config.flight == read.flight and config.navigator.attitude == read.navigator.attitude:
            self.drop()
        else:
            self.read(loaded.path, config, given)

    def make(self, config: Config, flight: Flight) -> None:
        """Begin to load a flight received from a link.

        Parameters
        ----------
        config : Config
        flight : Flight
        """
        self._pending = None, {}, self._thread.submit(LoadedFlight.make, None, config, {}, flight)

    def read_again(self, config: Config, missing: MissingFromLog, typed: Mapping[str, str]) -> None:
        """Begin to read a log again, with its missing inputs.

        Parameters
        ----------
        config : Config
            The settings without the inputs given for a log.
        missing : MissingFromLog
        typed : mapping of str to str
            By key of ``[flight]``: ``utc_start``, ``latitude_deg``, ``longitude_deg``, ``height_m``.

        Raises
        ------
        ConfigError
            If something is missing or not valid; nothing changes then.
        """
        given = {**missing.given, **flight_keys(missing.fields, typed)}
        config = config.override(**given)
        if "position" in missing.reasons:
            self.typed_site = {key: typed.get(key, "") for key in SITE_KEYS}
        if "UTC" in missing.reasons:
            self._typed_utc[missing.path.resolve()] = typed["utc_start"]
        self.read(missing.path, config, given)

    def take(self) -> LoadedFlight:
        """Return the flight as soon as it has been loaded.

        Returns
        -------
        LoadedFlight

        Raises
        ------
        GlstarError
            If it cannot be replayed; `missing` is set if the log lacks UTC or a position.
        """
        assert self._pending is not None
        (path, given, future), self._pending = self._pending, None
        try:
            loaded = future.result()
        except LogFormatError as error:
            if error.lacks and path is not None:
                typed = {"utc_start": self._typed_utc.get(path.resolve(), ""), **self.typed_site}
                self.missing = MissingFromLog(path, error.lacks, given, typed)
            raise
        if self.start_s is not None:
            loaded.head.seek(loaded.head.first_s + self.start_s)
            self.start_s = None
        return loaded

    def drop(self) -> None:
        """Forget the flight that is being loaded."""
        if self._pending is not None:
            self._pending[2].cancel()
        self._pending = None

    def close(self) -> None:
        """End the thread."""
        self.sampler.close()
        self.finder.close()
        self._thread.shutdown(wait=True, cancel_futures=True)
