"""A flight that the viewer shows, with everything computed from it, and the thread that loads flights.

Also the attitudes of a log among which the user can choose, and the UTC and the site that a log or a link lacks.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.config.flight import FlightSection
from glstar.config.reading import extinction_of, observed_sky
from glstar.errors import ConfigError, GlstarError, LogFormatError
from glstar.export.navigator import estimates
from glstar.flight import AttitudeTrack, Flight, Interpolation
from glstar.render.simulator import Simulator
from glstar.sky.place.timescale import CLOCK_GRAIN_S, parse_known_utc
from glstar.telemetry import Survey
from glstar.viewer.flight.live import Buffered
from glstar.viewer.flight.others import OtherLogs
from glstar.viewer.flight.playhead import PlayHead
from glstar.viewer.flight.sky import SkySampler
from glstar.viewer.flight.traces import FlightLines
from glstar.viewer.overlays.table import Overlays

# Keys of [flight] among whose values a user chooses: they do not change the choice.
_CHOSEN = {"attitude": "auto", "interpolation": "slerp", "time_offset_s": 0.0}


@dataclass(frozen=True, slots=True)
class AttitudeChoices:
    """The attitudes of a log, and the interpolations that it allows."""

    # Description by value of ``flight.attitude``, without ``"auto"``.
    attitudes: Mapping[str, str] = field(default_factory=dict)
    has_gyros: bool = False  # Whether the log has the gyro rates that the interpolation ``"gyro"`` needs
    error: str = ""  # The reason why they are not known; empty if they are

    @classmethod
    def of(cls, survey: Survey) -> "AttitudeChoices":
        """Return the choices in a log."""
        described = {
            each.name: f"{each.samples} samples, {each.rate_hz:.4g} Hz, {each.duration_s:.1f} s, {each.gaps} gaps"
            for each in survey.attitudes
        }
        return cls(described, survey.gyros is not None)

    def sources(self, chosen: str) -> list[str]:
        """Return the values of ``flight.attitude`` to offer.

        `chosen`: the present value, which is always among them.  Returns ``"auto"`` first.
        """
        return list(dict.fromkeys(("auto", *self.attitudes, chosen)))

    def interpolations(self, chosen: Interpolation) -> list[Interpolation]:
        """Return the interpolations to offer.

        `chosen` {"slerp", "spline", "gyro"}: the present one, which is always among them.
        """
        names: tuple[Interpolation, ...] = ("slerp", "spline", "gyro")
        return [name for name in names if name != "gyro" or self.has_gyros or name == chosen]


class AttitudeFinder:
    """Surveys the log shown, from the first call of `of` on."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-attitudes")
        self._wanted: tuple[Path, FlightSection] | None = None
        self._future: Future[AttitudeChoices] | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a log is being surveyed."""
        return self._future is not None and not self._future.done()

    def of(self, path: Path, config: Config) -> AttitudeChoices | None:
        """Return the choices in a log; None until they are known: its survey begins with the first call.

        `config`: with which the log was read.
        """
        wanted = path, config.flight.model_copy(update=_CHOSEN)
        if self._future is None or wanted != self._wanted:
            if self._future is not None:
                self._future.cancel()
            self._wanted = wanted
            self._future = self._thread.submit(_find, path, config)
        return self._future.result() if self._future.done() else None

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown(wait=True, cancel_futures=True)


def _find(path: Path, config: Config) -> AttitudeChoices:
    try:
        return AttitudeChoices.of(config.survey_flight(path)[0])
    except (GlstarError, OSError, MemoryError) as error:
        return AttitudeChoices(error=str(error))


class InputField(NamedTuple):
    """A value to type."""

    key: str  # Key of ``[flight]``
    label: str  # With the unit
    hint: str  # An example
    is_required: bool = True


UTC_FIELD = InputField("utc_start", "UTC of the first attitude", "2024-03-10T11:00:00Z")
SITE_FIELDS = (
    InputField("latitude_deg", "latitude, deg", "-34.93 (south is negative)"),
    InputField("longitude_deg", "longitude, deg", "138.60 (west is negative)"),
    InputField("height_m", "height, m", "0 if left empty", is_required=False),
)
SITE_KEYS = tuple(each.key for each in SITE_FIELDS)


@dataclass(frozen=True, slots=True, eq=False)
class MissingInputs:
    """The UTC and the site that a log or a link lacks, with the messages about them."""

    message: str
    note: str  # What the inputs are used for
    fields: tuple[InputField, ...]  # The fields to fill in
    typed: Mapping[str, str]  # The initial contents of the fields, by key of ``[flight]``
    path: Path | None = None  # The log; None for a link
    given: Mapping[str, Any] = field(default_factory=dict)  # Dotted keys of the config that were given for it before

    @classmethod
    def from_log(
        cls,
        path: Path,
        reasons: Mapping[Literal["UTC", "position"], str],
        given: Mapping[str, Any],
        typed: dict[str, str],
    ) -> "MissingInputs":
        """Return the inputs that a log lacks; `reasons`: as in `LogFormatError.lacks`."""
        lacking = [f"no {what}" + (f" ({reason})" if reason else "") for what, reason in reasons.items()]
        return cls(
            f"{path.name} has {' and '.join(lacking)}.",
            "Your input applies to this log only, and is saved with its settings and frames.",
            ((UTC_FIELD,) if "UTC" in reasons else ()) + (SITE_FIELDS if "position" in reasons else ()),
            typed,
            path,
            given,
        )

    @classmethod
    def from_link(cls, endpoint: str, typed: Mapping[str, str]) -> "MissingInputs":
        """Return the site that a link does not send."""
        note = "Your input applies to this link until the viewer is closed."
        return cls(f"{endpoint} sends no position.", note, SITE_FIELDS, typed)


def flight_keys(fields: tuple[InputField, ...], typed: Mapping[str, str]) -> dict[str, Any]:
    """Return typed inputs by dotted key of the config: UTC in ISO 8601, degrees, metres; the config checks the ranges.

    `typed`: by key of ``[flight]``.  Raises ConfigError if a value is missing, or is no time or number.
    """
    keys: dict[str, Any] = {}
    for each in fields:
        text = typed.get(each.key, "").strip()
        if not text:
            if each.is_required:
                raise ConfigError(f"{each.label} is missing: type it as {each.hint}")
        elif each.key == UTC_FIELD.key:
            parse_known_utc(text)
            keys[f"flight.{each.key}"] = text
        else:
            keys[f"flight.{each.key}"] = _number(each, text)
    return keys


def _number(field: InputField, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{field.label}: {text!r} is not a number; type it as 138.60, with a point") from None


# Seconds of a live flight taken from the link before the exposure: gaps are detected by its usual sample interval.
BEFORE_EXPOSURE_S = 5.0


@dataclass(slots=True, eq=False)
class LoadedFlight:
    """A flight and all that the viewer computes from it."""

    path: Path | None  # The log; None for a flight received from a link
    config: Config  # The settings with which it was loaded
    # Dotted keys of the config that the user gave for this log only: the UTC and the site that it lacks.
    given: Mapping[str, Any]
    flight: Flight  # A live one is a copy of the link's buffer, replaced twice a second
    lines: FlightLines  # The curves of the timeline
    simulator: Simulator
    overlays: Overlays
    # What the aircraft estimated, if ``[navigator]`` names another message of the log.
    estimate: AttitudeTrack | None = None
    head: PlayHead = field(init=False)
    read_with: Config = field(init=False)  # The settings with which the log was read; `config` changes later

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

        `path`: None for a flight received from a link; `given`: dotted keys of the config that hold for this log only.
        """
        simulator = config.simulator(flight)
        lines = FlightLines.of(flight.aircraft_attitude, flight.attitude.first_s)
        overlays = Overlays(simulator.sky.catalogue)
        return cls(path, config, given, flight, lines=lines, simulator=simulator, overlays=overlays)

    @classmethod
    def read(cls, path: Path, config: Config, given: Mapping[str, Any]) -> "LoadedFlight":
        """Read a log.

        `given`: dotted keys of the config that hold for this log only.  Raises GlstarError if the log cannot be
        replayed.
        """
        loaded = cls.make(path, config, given, config.open_flight(path))
        [loaded.estimate] = estimates(config, [path])
        return loaded

    def use(self, config: Config) -> None:
        """Change the settings; star directions are computed again only if the sky changes.

        Raises GlstarError if the simulator refuses the settings; nothing changes then.
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
        """Return settings with the ``[flight]`` and ``navigator.attitude`` with which the log was read."""
        present, wanted = config.flight, self.read_with.flight
        differing = [key for key in type(wanted).model_fields if getattr(present, key) != getattr(wanted, key)]
        before = {f"flight.{key}": getattr(wanted, key) for key in differing}
        if config.navigator.attitude != self.read_with.navigator.attitude:
            before["navigator.attitude"] = self.read_with.navigator.attitude
        unset = [key for key, value in before.items() if value is None]
        return config.without(*unset).override(**before)

    def extend_to(self, utc_s: float, buffered: Buffered | None) -> None:
        """Extend a live flight to its latest attitude.

        `utc_s`: of the latest attitude, UTC seconds since 1970; `buffered`: a newer copy of the link's buffer, if there
        is one.
        """
        if buffered is not None:
            self.flight, self.lines = buffered
        self.head.grow(min(self.flight.attitude.first_s, utc_s), utc_s)

    def extend(self, exposure: Exposure, last: Callable[[float], Flight | None]) -> bool:
        """Extend the simulator's flight with the samples of a live flight that an exposure needs.

        `last`: returns the last seconds of the live flight; None if there are too few samples.  Returns whether it was
        extended.
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
        """Take over mode, speed and loop from the flight shown before, and the position and markers in the same log."""
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
        earthshine=config.sky.earthshine,
        extinction=extinction_of(config.sky, config.air, config.sensor().colour),
    )


class FlightLoader:
    """Loads one flight at a time on a thread of its own, and records the missing inputs of a log."""

    def __init__(self) -> None:
        self.missing: MissingInputs | None = None  # Of the log opened last, until the user gives them or cancels
        self.last_opened: Path | None = None  # The log opened last, even if it could not be read
        # Initial position of the next flight's play head, s from its first attitude; None for the first attitude.
        self.start_s: float | None = None
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-open-flight")
        self._pending: tuple[Path | None, Mapping[str, Any], Future[LoadedFlight]] | None = None
        # The inputs typed last, which are the initial contents of the dialog: a site by key of ``[flight]``, and the
        # UTC of each log.
        self.typed_site: dict[str, str] = {}
        self._typed_utc: dict[Path, str] = {}
        self.sampler = SkySampler()
        self.finder = AttitudeFinder()
        self.others = OtherLogs()

    @property
    def is_busy(self) -> bool:
        """Whether a flight is being loaded."""
        return self._pending is not None

    @property
    def works(self) -> bool:
        """Whether a log is being read, or curves or attitudes of the one shown are being computed."""
        return self.is_busy or self.others.reading is not None or self.sampler.is_busy or self.finder.is_busy

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

        `given`: dotted keys of the config that hold for this log only.
        """
        self.missing = None
        self.last_opened = path
        self.drop()
        self._pending = path, given, self._thread.submit(LoadedFlight.read, path, config, given)

    def follow(self, loaded: LoadedFlight, config: Config, given: Mapping[str, Any]) -> None:
        """Begin to read the log shown again, unless it was read with the same settings.

        `loaded`: from a log; `given`: dotted keys of the config that hold for this log only.
        """
        read = loaded.read_with
        assert loaded.path is not None
        if config.flight == read.flight and config.navigator.attitude == read.navigator.attitude:
            self.drop()
        else:
            self.read(loaded.path, config, given)

    def make(self, config: Config, flight: Flight) -> None:
        """Begin to load a flight received from a link."""
        self._pending = None, {}, self._thread.submit(LoadedFlight.make, None, config, {}, flight)

    def read_again(self, config: Config, missing: MissingInputs, typed: Mapping[str, str]) -> None:
        """Begin to read a log again, with its missing inputs.

        `config`: the settings without the inputs given for a log; `typed`: by key of ``[flight]``: ``utc_start``,
        ``latitude_deg``, ``longitude_deg``, ``height_m``.  Raises ConfigError if something is missing or not valid;
        nothing changes then.
        """
        assert missing.path is not None
        given = {**missing.given, **flight_keys(missing.fields, typed)}
        config = config.override(**given)
        if SITE_FIELDS[0] in missing.fields:
            self.typed_site = {key: typed.get(key, "") for key in SITE_KEYS}
        if UTC_FIELD in missing.fields:
            self._typed_utc[missing.path.resolve()] = typed["utc_start"]
        self.read(missing.path, config, given)

    def take(self) -> LoadedFlight:
        """Return the flight as soon as it has been loaded.

        Raises GlstarError if it cannot be replayed; `missing` is set if the log lacks UTC or a position.
        """
        assert self._pending is not None
        (path, given, future), self._pending = self._pending, None
        try:
            loaded = future.result()
        except LogFormatError as error:
            if error.lacks and path is not None:
                typed = {"utc_start": self._typed_utc.get(path.resolve(), ""), **self.typed_site}
                self.missing = MissingInputs.from_log(path, error.lacks, given, typed)
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
        self.others.close()
        self._thread.shutdown(wait=True, cancel_futures=True)
