"""What the viewer shows: a flight, settings, a moment, and the image that comes of them; no window, no imgui."""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from math import floor
from pathlib import Path
from typing import Any, Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.errors import GlstarError, LogFormatError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.images import ImageFormat
from glstar.export.run import Export, frame_seed, prepare
from glstar.flight import Flight, Gap
from glstar.images import FittedImage, RealImage
from glstar.link import NewestAttitude
from glstar.render.opengl import GLRenderer
from glstar.render.scene import Scene
from glstar.render.simulator import Simulator
from glstar.sky.timescale import CLOCK_GRAIN_S
from glstar.system.durable import write_atomically
from glstar.telemetry import as_table
from glstar.viewer.comparisonview import Comparison, ComparisonState, compose, outside, save_view
from glstar.viewer.display import Shown
from glstar.viewer.exporting import BackgroundExport
from glstar.viewer.flightlines import FlightLines
from glstar.viewer.frametimes import FrameTimes
from glstar.viewer.imageview import ImageView
from glstar.viewer.liveflight import LiveFlight
from glstar.viewer.missing import PLACE_KEYS, MissingFromLog, flight_keys
from glstar.viewer.overlays import Overlay, Overlays
from glstar.viewer.playhead import PlayHead, no_exposure
from glstar.viewer.stretch import Stretch

__all__ = ["Notice", "Session", "unused"]

_NOTICE_S: Final = 6.0
_ERROR_S: Final = 20.0
_MOST_NOTICES: Final = 4

# How many times as bright the image is shown at first, and the peak of a star of V 3 for which that is, a fraction of
# white: the bundled camera's, at rest for half a second.
_BOOST: Final = 5.0
_STAR: Final = 150 / 255

# Starts of exposures that no camera records are cut to it, so that a command line can name them.
_DECIMALS: Final = 1e6

# Of a live flight so much is looked at beyond the exposure, s: its usual interval tells what is a gap.
_BEFORE_S: Final = 5.0
# Its star directions are found anew after so long: they age by 0.03" an hour.
_STARS_S: Final = 3600.0


@dataclass(frozen=True, slots=True)
class Notice:
    """A sentence for the user.

    Attributes
    ----------
    words : str
    is_error : bool
    until_s : float
        When it goes, by the session's clock.
    """

    words: str
    is_error: bool
    until_s: float


@dataclass(frozen=True, slots=True, eq=False)
class _Loaded:
    path: Path | None  # None for a flight that is live
    config: Config
    given: Mapping[str, Any]  # keys of the config that hold for this log only
    flight: Flight
    lines: FlightLines
    simulator: Simulator
    overlays: Overlays


class _Loading(NamedTuple):
    """A flight that is being read."""

    path: Path | None  # None for a flight that is live
    given: Mapping[str, Any]
    future: Future[_Loaded]


class _Wanted(NamedTuple):
    """What makes an image: two that are equal make the same."""

    exposure: Exposure
    number: int | None
    simulator: Simulator


class Session:
    """The state of the viewer, and all that can be done to it.

    Parameters
    ----------
    renderer : GLRenderer
        On the window's context.
    config : Config
    output : Path, optional
        Where frames, settings and pictures are saved: ``glstar-saved`` in the working directory.
    clock : callable
        Seconds, from anywhere.

    Attributes
    ----------
    config : Config
        The settings as they are now.
    path, flight, lines, head, simulator, overlays
        The flight shown and what belongs to it; None until the first is loaded.  A live flight has no path, and all
        that is remembered of it is taken anew twice a second.
    live : LiveFlight or None
        What comes from a link, where there is one.
    scene, image, number
        The newest scene, its developed texture, and which of the camera's exposures it is; None for one that no camera
        records.
    trouble : str
        Why there is no newer image, in words; empty where nothing is wrong.
    missing : MissingFromLog or None
        The UTC and place that the log opened last lacks, until they are given or the user cancels.
    last_opened : Path or None
        The log opened last, even if it could not be read.
    view : ImageView
    stretch : Stretch
    night : bool
    shown_overlays : set of Overlay
    name_vmag_limit : float
        The faintest magnitude of a star that is named.
    comparison : ComparisonState
    export : BackgroundExport or None
        The one under way.
    times : FrameTimes
    """

    def __init__(
        self,
        renderer: GLRenderer,
        config: Config,
        *,
        output: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.renderer = renderer
        self.config = config
        self.output = Path.cwd() / "glstar-saved" if output is None else output
        self.path: Path | None = None
        self.flight: Flight | None = None
        self.lines: FlightLines | None = None
        self.live: LiveFlight | None = None
        self.head: PlayHead | None = None
        self.simulator: Simulator | None = None
        self.overlays: Overlays | None = None
        self.scene: Scene | None = None
        self.image: moderngl.Texture | None = None
        self.number: int | None = None
        self.trouble = ""
        self.missing: MissingFromLog | None = None
        self.last_opened: Path | None = None
        self.view = ImageView()
        self.stretch = _first_stretch(config)
        self.night = False
        self.shown_overlays: set[Overlay] = {Overlay.STAR_NAMES}
        self.name_vmag_limit = 3.0
        self.comparison = ComparisonState(clock)
        self.export: BackgroundExport | None = None
        self.times = FrameTimes()
        self.seed = 0
        self._clock = clock
        self._notices: list[Notice] = []
        self._loader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-open-flight")
        self._loading: _Loading | None = None
        # UTC and place that were given for the log shown: keys of the config that no other log is read with.
        self._given: Mapping[str, Any] = {}
        # The last answers, to fill in the dialog: the place for any log, UTC only for the same log.
        self._typed_place: dict[str, str] = {}
        self._typed_utc: dict[Path, str] = {}
        # Whether the flight shown is the link's, which of its epochs, and of when its stars are.
        self._follows = False
        self._epoch = 0
        self._stars_utc_s = 0.0
        self._newest: NewestAttitude | None = None
        self._composer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-compose")
        self._ahead: tuple[_Wanted, Future[Scene]] | None = None
        self._drawn: _Wanted | None = None
        # Across a gap of the log there is no attitude, and so no image: a wrong sky is worse than none.
        self._gap: Gap | None = None
        # What the scene was composed for; the scene's own exposure says how its trails are drawn.
        self._composed_for: _Wanted | None = None
        self._pixels: tuple[Scene, NDArray[Any]] | None = None

    # --- what is shown ---

    def update(self, elapsed_s: float) -> None:
        """Let time pass, take what was loaded, and draw the image of now if it is another one.

        Parameters
        ----------
        elapsed_s : float
            Since the last call, s.
        """
        self._poll()
        if self.live is not None:
            self._listen(self.live)
        head = self.head
        if head is None or self.simulator is None or self.flight is None:
            return
        if self._follows and self.live is not None and self.live.epoch != self._epoch:
            return  # the flight that has begun anew is being made ready
        head.advance(elapsed_s)
        exposure, number = self._wanted(head, self.flight)
        if self._follows and self._reach_for(exposure, head):
            exposure, number = self._wanted(head, self.flight)
        wanted = _Wanted(exposure, number, self.simulator)
        self._gap = self.simulator.flight.attitude.gap_within(exposure.start_utc_s, exposure.stop_utc_s)
        if self._gap is not None:
            self._ahead = self._drawn = None
            self.trouble = ""
        elif head.playing and not head.live:
            self._draw_ahead(wanted)
        elif wanted != self._drawn:
            self._ahead = None
            self._draw(wanted, lambda: self._scene_of(wanted))
            if head.live and self.live is not None and self._newest is not None:
                self.live.drew(self._newest)

    def _draw_ahead(self, wanted: "_Wanted") -> None:
        """Draw the scene that was composed while the last image was drawn, and have the next one composed.

        Playing, the image lags a frame behind the play head, and neither waits for the other.
        """
        if self._ahead is not None:
            if not self._ahead[1].done() and self.image is not None:
                return
            ready, composed = self._ahead
            self._draw(ready, composed.result)
        self._ahead = None
        if wanted != self._drawn:
            self._ahead = wanted, self._composer.submit(self._scene_of, wanted)

    def _draw(self, wanted: "_Wanted", compose: Callable[[], Scene]) -> None:
        self._drawn = wanted
        try:
            scene = compose()
            with self.times.span("drawing"):
                self.image = self.renderer.develop(scene, seed=frame_seed(self.seed, wanted.number or 0))
                self.times.new_image()
        except GlstarError as error:
            self.trouble = str(error)
            return
        self.scene, self.number, self.trouble = scene, wanted.number, ""
        self._composed_for = wanted

    def _wanted(self, head: PlayHead, flight: Flight) -> tuple[Exposure, int | None]:
        """Return the exposure to show, and which of the camera's it is."""
        # The exposures of a live flight have no numbers that mean anything later.
        exposure, number = head.exposure(), None if head.grows else head.number
        real = self.comparison.image_at(head.utc_s)
        if real is not None:
            theirs = self.comparison.exposure(real, exposure)
            attitude = flight.attitude
            if not outside(theirs, attitude.first_s, attitude.last_s):
                exposure, number = theirs, None
        if number is None:
            start_s = floor((exposure.start_utc_s - head.origin_s) * _DECIMALS) / _DECIMALS
            exposure = replace(exposure, start_utc_s=head.origin_s + max(start_s, 0.0))
        return exposure, number

    # --- a flight that is still going on ---

    def follow(self, live: LiveFlight) -> None:
        """Show what comes from a link, as soon as the sky can be drawn.

        Parameters
        ----------
        live : LiveFlight
            It becomes the session's.
        """
        self.live = live
        self.go_live()

    def go_live(self) -> None:
        """Go to the sky of now: from an earlier moment, or from a log that was opened meanwhile."""
        if self.live is None:
            self.say("there is no link: start with glstar live LINK")
        elif self._follows and self.head is not None:
            self.head.last()
        else:
            self._follows, self._epoch = True, 0
            self.config, self._given, self.missing = self._own_config, {}, None
            self.path = self.flight = self.lines = self.head = self.simulator = None
            self._loading = self._ahead = self._drawn = self._gap = None
            self.image = self.scene = None
            self.trouble = ""

    def _listen(self, live: LiveFlight) -> None:
        """Take note of what has come on the link; a flight that it shows grows."""
        newest = live.look()
        for event in live.new_events():
            self.say(event.words)
        if not self._follows or newest is None or self._loading is not None:
            return
        begins = live.epoch != self._epoch
        if begins or abs(newest.utc_s - self._stars_utc_s) > _STARS_S:
            flight = live.last(self.config.exposure.duration_s + _BEFORE_S)
            if flight is not None:
                self._stars_utc_s = newest.utc_s
                self._loading = _Loading(None, {}, self._loader.submit(_made, None, self.config, {}, flight))
            return
        if self.head is None or self.flight is None or newest.utc_s <= self.head.first_s:
            return
        if (taken := live.buffered(self.head.origin_s)) is not None:
            self.flight, self.lines = taken
        self._newest = newest
        self.head.grow(min(self.flight.attitude.first_s, newest.utc_s), newest.utc_s)

    def _reach_for(self, exposure: Exposure, head: PlayHead) -> bool:
        """Take as much of the live flight as an exposure needs; return whether that was to be taken."""
        assert self.live is not None
        assert self.simulator is not None
        attitude, opens_s = self.simulator.flight.attitude, exposure.start_utc_s + CLOCK_GRAIN_S
        if attitude.first_s <= opens_s and exposure.stop_utc_s <= attitude.last_s:
            return False
        flight = self.live.last(head.last_s - exposure.start_utc_s + _BEFORE_S)
        if flight is None:
            return False
        self.simulator = self.simulator.following(flight)
        # What has just been forgotten cannot be shown.
        remembers = flight.attitude.first_s <= opens_s
        head.grow(head.first_s if remembers else flight.attitude.first_s, flight.attitude.last_s)
        return True

    @property
    def stale_s(self) -> float | None:
        """How old what is shown as the sky of now is, s, where that is more than a second."""
        return self.live.stale_s if self.live is not None and self.head is not None and self.head.live else None

    def _scene_of(self, wanted: "_Wanted") -> Scene:
        """Return a scene; where only noise or converter are others, the old one with them."""
        with self.times.span("simulation"):
            return self._composed(wanted)

    def _composed(self, wanted: "_Wanted") -> Scene:
        old, before, simulator = self.scene, self._composed_for, wanted.simulator
        if old is not None and before is not None and before.exposure == wanted.exposure:
            alike = ("flight", "sky", "stars", "camera", "mount", "pressure_hpa", "temperature_c")
            same = all(_alike(getattr(before.simulator, name), getattr(simulator, name)) for name in alike)
            if same and old.sensor.same_light(simulator.sensor):
                return replace(old, sensor=simulator.sensor)
        return simulator.scene(wanted.exposure)

    @property
    def shown(self) -> Shown | None:
        """What the image panel shows; None until there is an image, and where the exposure meets a gap of the log."""
        if self.image is None or self.scene is None or self._gap is not None:
            return None
        real, comparison = self.real, self.comparison
        fitted = None if real is None else real[1]
        if fitted is None and comparison.active and comparison.mode is Comparison.SIDE_BY_SIDE:
            # While an image is decoded its half of the picture stays empty: the view keeps its zoom.
            fitted = _blank(self.scene.camera.width_px, self.scene.camera.height_px)
        return Shown(
            self.image,
            self.scene.sensor.saturation_dn,
            fitted,
            comparison.mode,
            comparison.wipe,
            comparison.phase,
            comparison.real_black,
            comparison.real_gain,
        )

    @property
    def real(self) -> tuple[RealImage, FittedImage] | None:
        """The real image of now with its pixels; None until they are decoded: another image is never shown for it."""
        comparison = self.comparison
        if not comparison.active or self.head is None or self.scene is None or comparison.images is None:
            return None
        image = comparison.image_at(self.head.utc_s)
        if image is None:
            return None
        camera = self.scene.camera
        pixels = comparison.images.fitted(image, camera.width_px, camera.height_px)
        return None if pixels is None else (image, pixels)

    @property
    def pixels(self) -> NDArray[Any] | None:
        """The developed image, read back once: for marks and readouts, never for the screen."""
        if self.shown is None or self.scene is None or self.trouble:
            return None
        if self._pixels is None or self._pixels[0] is not self.scene:
            self._pixels = self.scene, self.renderer.read().pixels
        return self._pixels[1]

    @property
    def notice(self) -> str:
        """What is to be said about the image of now, in words; empty where nothing is."""
        if self.trouble:
            return self.trouble
        if self.head is None or self.flight is None:
            return self.live.lacking if self._follows and self.live is not None else ""
        if (stale_s := self.stale_s) is not None and self.live is not None:
            return f"no attitude for {stale_s:.0f} s: this is the sky of then\n{self.live.status.trouble or ''}".strip()
        real = self.comparison.image_at(self.head.utc_s)
        if real is not None:
            attitude = self.flight.attitude
            theirs = self.comparison.exposure(real, self.head.exposure())
            if words := outside(theirs, attitude.first_s, attitude.last_s):
                return words
        if self._gap is not None:
            return no_exposure(self._gap, of="link" if self._follows else "log")
        # An exposure of a real image is its own, not the play head's.
        return "" if real is not None else self.head.notice(self.flight.attitude) or ""

    @property
    def notices(self) -> list[Notice]:
        """What was said lately, oldest first."""
        now_s = self._clock()
        self._notices = [notice for notice in self._notices if notice.until_s > now_s]
        return self._notices

    def say(self, words: str, *, is_error: bool = False) -> None:
        """Show a sentence for some seconds; errors stay longer.

        Parameters
        ----------
        words : str
        is_error : bool
        """
        until_s = self._clock() + (_ERROR_S if is_error else _NOTICE_S)
        kept = [notice for notice in self._notices if notice.words != words]
        self._notices = [*kept, Notice(words, is_error, until_s)][-_MOST_NOTICES:]

    @property
    def errors(self) -> list[str]:
        """What went wrong lately, in words."""
        return [notice.words for notice in self.notices if notice.is_error]

    def dismiss(self, notice: Notice) -> None:
        """Take a sentence away before its time.

        Parameters
        ----------
        notice : Notice
        """
        self._notices = [other for other in self._notices if other is not notice]

    @property
    def busy(self) -> bool:
        """Whether the picture changes by itself."""
        playing = self.head is not None and self.head.playing and self.stale_s is None
        blinking = self.comparison.active and self.comparison.mode is Comparison.BLINK
        return playing or blinking or self.waiting

    @property
    def waiting(self) -> bool:
        """Whether something is under way that will show."""
        return self._loading is not None or self.export is not None or self.comparison.waiting

    # --- flights and settings ---

    @property
    def loading(self) -> Path | None:
        """The log that is being read, if one is."""
        return None if self._loading is None else self._loading.path

    def open_flight(self, path: Path) -> None:
        """Begin to read a log on a thread of its own; the flight of now plays on, and stays if it cannot be read.

        Parameters
        ----------
        path : Path
            If it lacks UTC or place, `missing` says so once it has been read.
        """
        self._read(path, self._own_config, {})

    def give(self, missing: MissingFromLog, typed: Mapping[str, str]) -> None:
        """Begin to read a log again, with what it lacks; this holds for that log only.

        Parameters
        ----------
        missing : MissingFromLog
        typed : mapping of str to str
            By key of ``[flight]``: ``utc_start``, ``latitude_deg``, ``longitude_deg``, ``height_m``.

        Raises
        ------
        ConfigError
            If something is missing or not valid; nothing changes then.
        """
        given = {**missing.given, **flight_keys(missing, typed)}
        config = self._own_config.override(**given)
        if "position" in missing.reasons:
            self._typed_place = {key: typed.get(key, "") for key in PLACE_KEYS}
        if "UTC" in missing.reasons:
            self._typed_utc[missing.path.resolve()] = typed["utc_start"]
        self._read(missing.path, config, given)

    def cancel_missing(self) -> None:
        """Leave what was shown, and do not open the log that lacks something."""
        if self.missing is not None and self.flight is None and self.live is None:
            self.trouble = f"{self.missing.message}\nOpen it again (Ctrl+O) to give what it lacks."
        self.missing = None

    def _read(self, path: Path, config: Config, given: Mapping[str, Any]) -> None:
        self.missing, self.last_opened = None, path
        self._loading = _Loading(path, given, self._loader.submit(_load, path, config, given))

    @property
    def _own_config(self) -> Config:
        """The settings without what was given for the log shown."""
        return self.config.without(*self._given) if self._given else self.config

    def open(self, path: Path) -> None:
        """Open what was dropped onto the window: a log, settings (``.toml``), or a folder of real images.

        Parameters
        ----------
        path : Path
        """
        if path.is_dir():
            self.comparison.open(path)
        elif path.suffix.lower() == ".toml":
            self.open_settings(path)
        else:
            self.open_flight(path)

    def open_settings(self, path: Path) -> None:
        """Take settings from a file; the ones of now stay if it cannot be meant.

        UTC and place that were given for the log shown stay, too, unless the file has them.

        Parameters
        ----------
        path : Path
        """
        before = self._given
        try:
            config = Config.load(path)
            self._given = _still_given(before, config)
            self._take(config.override(**self._given) if self._given else config)
        except GlstarError as error:
            self._given = before
            self.say(str(error), is_error=True)
        else:
            self.say(f"settings of {path.name}")

    def change(self, **keys: Any) -> None:
        """Set keys of the config anew, dotted; what cannot be meant changes nothing and is said.

        Parameters
        ----------
        **keys
            ``session.change(**{"exposure.duration_s": 1.0})``.
        """
        try:
            self._take(self.config.override(**keys))
        except GlstarError as error:
            self.say(str(error), is_error=True)

    def _take(self, config: Config) -> None:
        before = self.config
        if self.flight is not None and self.simulator is not None and self.head is not None:
            simulator = _adapted(self.simulator, before, config)
            self.stretch = self.stretch.for_white(before.sensor().saturation_dn, config.sensor().saturation_dn)
            self.config, self.simulator = config, simulator
            self.head.exposure_section = config.exposure
            if config.sky.catalogue != before.sky.catalogue:
                self.overlays = Overlays(simulator.sky.catalogue)
            if config.flight != before.flight:
                if self.path is not None:
                    self._read(self.path, config, self._given)
                else:
                    self.say("[flight] of the settings is for logs; of a link, glstar live says how it is read")
        self.config = config

    def _poll(self) -> None:
        self.comparison.poll()
        if self.comparison.trouble:
            self.say(self.comparison.trouble, is_error=True)
            self.comparison.trouble = ""
        if self.export is not None and not self.export.running:
            self.say(self.export.words, is_error=bool(self.export.error))
            self.export = None
        if self._loading is not None and self._loading.future.done():
            path = self._loading.path
            try:
                self._take_loaded()
            except (GlstarError, OSError) as error:
                if self.missing is None:
                    self.say(str(error), is_error=True)
                if self.flight is None:
                    self.trouble = str(error)
            except MemoryError:
                self.say(f"{path}: is too large for this machine's memory", is_error=True)

    def _take_loaded(self) -> None:
        """Show the flight that was being read, as soon as it has been read; raise why it cannot be shown."""
        assert self._loading is not None
        (path, given, future), self._loading = self._loading, None
        try:
            self._install(future.result())
        except LogFormatError as error:
            if error.lacks and path is not None:
                typed = {"utc_start": self._typed_utc.get(path.resolve(), ""), **self._typed_place}
                self.missing = MissingFromLog(path, error.lacks, given, typed)
            raise

    def _install(self, loaded: _Loaded) -> None:
        flight, old = loaded.flight, self.head
        if loaded.given != self._given:
            own = self._own_config
            self.config, self._given = own.override(**loaded.given) if loaded.given else own, loaded.given
        self._follows = loaded.path is None
        same = False
        if self._follows and self.live is not None:
            same = self._epoch == self.live.epoch
            self._epoch = self.live.epoch
        head = PlayHead(flight.attitude.first_s, flight.attitude.last_s, self.config.exposure, grows=self._follows)
        if same and old is not None:
            # It is its stars alone that are new.
            head = old
        elif old is not None and not self._follows:
            head.mode, head.loop, head.speed = old.mode, old.loop, old.speed
            if self.path == loaded.path:
                head.seek(old.utc_s)
                head.markers, head.playing = old.markers, old.playing
        self.simulator = _adapted(loaded.simulator, loaded.config, self.config)
        self.path, self.flight, self.head, self.overlays = loaded.path, flight, head, loaded.overlays
        self.lines = loaded.lines
        self.comparison.flight_offset_s = flight.time_offset_s
        self.trouble = ""
        for note in flight.notes:
            self.say(note)

    def wait_for_flight(self) -> None:
        """Wait until the log that is being read has been read; what goes wrong is raised: for scripts.

        Raises
        ------
        GlstarError
            If the log cannot be replayed.
        """
        if self._loading is not None:
            self._take_loaded()

    # --- what is saved ---

    def save_frame(self) -> None:
        """Write the image of now as an export of one frame, with truth and manifest, and the settings beside it."""
        if self.scene is None or self.flight is None or self.head is None or self._gap is not None:
            self.say(f"no image to save: {self.notice or 'nothing is drawn yet'}", is_error=True)
            return
        exposure, number = self.scene.exposure, self.number
        flight = self.flight
        if self._follows and self._composed_for is not None:
            flight = self._composed_for.simulator.flight
        second = exposure.start_utc_s - flight.attitude.first_s
        keys = {"exposure.duration_s": exposure.duration_s, "exposure.rate_hz": exposure.rate_hz}
        start_s = 0.0 if number is not None else round(second, 6)
        named_s = exposure.start_utc_s - self.head.origin_s
        directory = unused(self.output / f"{self.stem}-{named_s:.3f}s")
        self._begin(
            self.config.override(**keys),
            flight,
            directory,
            only=number or 0,
            start_s=start_s,
            frames=(number or 0) + 1,
        )

    def save_range(
        self, directory: Path, *, start_s: float, stop_s: float, image_format: ImageFormat | None, light: bool
    ) -> None:
        """Begin to write the camera's exposures of a part of the flight.

        Parameters
        ----------
        directory : Path
        start_s, stop_s : float
            From the flight's first attitude, s; of a live flight what is remembered.
        image_format : {"png", "png16", "tiff"} or None
            None for the one that fits the sensor.
        light : bool
            Write the light before noise too.
        """
        if self.flight is None or self.head is None:
            return
        forgotten_s = self.flight.attitude.first_s - self.head.origin_s
        start_s, stop_s = max(start_s - forgotten_s, 0.0), stop_s - forgotten_s
        asked = {"start_s": start_s, "stop_s": stop_s, "image_format": image_format, "light": light}
        self._begin(self.config, self.flight, directory, only=None, **asked)

    @property
    def stem(self) -> str:
        """What files of the flight are called."""
        return "live" if self._follows or self.flight is None else Path(self.flight.name).stem or "flight"

    def _begin(self, config: Config, flight: Flight, directory: Path, *, only: int | None, **asked: Any) -> None:
        if self.export is not None:
            self.say(f"an export to {self.export.directory} is under way; wait, or stop it", is_error=True)
            return
        path, seed = self.path, self.seed

        def make() -> Export:
            # The settings stand beside the frames, and a flight that is no log yet: the manifest's command names them.
            settings, log = directory.with_name(f"{directory.name}.toml"), path
            kept = config if path is not None else config.for_a_table(time_offset_s=flight.time_offset_s)
            beside = {settings: kept.to_toml()}
            if log is None:
                log = directory.with_name(f"{directory.name}.csv")
                beside[log] = as_table(flight)
            made = [file for file in beside if not file.exists()]
            try:
                with explain_disk_errors(settings):
                    settings.parent.mkdir(parents=True, exist_ok=True)
                    for file, content in beside.items():
                        write_atomically(file, content.encode())
                told = None if path is None else flight
                return prepare(Config.load(settings), log, directory, flight=told, seed=seed, only=only, **asked)
            except BaseException:
                # Without frames they belong to nothing.
                for file in made:
                    with suppress(OSError):
                        file.unlink(missing_ok=True)
                raise

        self.export = BackgroundExport(make, directory)

    def save_settings(self, path: Path) -> None:
        """Write the settings of now as TOML, for ``glstar export --config``.

        Parameters
        ----------
        path : Path
        """
        try:
            with explain_disk_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(path, self.config.to_toml().encode())
        except GlstarError as error:
            self.say(str(error), is_error=True)
        else:
            self.say(f"settings: {path}")

    def save_comparison(self) -> None:
        """Write what is compared as a picture of full size, with its caption."""
        real, pixels, comparison = self.real, self.pixels, self.comparison
        if real is None or pixels is None or self.scene is None:
            why = "the real image is still being decoded; save again in a moment"
            if not comparison.waiting:
                why = "nothing is compared: open a folder of real images first"
            self.say(why, is_error=True)
            return
        picture = compose(
            pixels,
            real[1],
            comparison.mode,
            wipe=comparison.wipe,
            phase=comparison.phase,
            stretch=self.stretch,
            saturation_dn=self.scene.sensor.saturation_dn,
            real_black=comparison.real_black,
            real_gain=comparison.real_gain,
        )
        path = unused(self.output / f"{real[0].path.stem}-{comparison.mode.replace(' ', '-')}.png")
        try:
            with explain_disk_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            save_view(path, picture, comparison.describe(real[0], self.scene.exposure))
        except GlstarError as error:
            self.say(str(error), is_error=True)
        else:
            self.say(f"comparison: {path}")

    def close(self) -> None:
        """End what is under way, keeping what is whole; the renderer stays the caller's."""
        if self.export is not None:
            self.export.cancel()
            self.export.wait()
            self.export = None
        for threads in (self._composer, self._loader):
            threads.shutdown(wait=True, cancel_futures=True)
        self.comparison.close()
        if self.live is not None:
            self.live.close()


@lru_cache(maxsize=1)
def _blank(width_px: int, height_px: int) -> FittedImage:
    """Return a real image that covers nothing."""
    return FittedImage(np.zeros((height_px, width_px), np.uint8), 0, 0, 0, 0)


def _load(path: Path, config: Config, given: Mapping[str, Any]) -> _Loaded:
    return _made(path, config, given, config.open_flight(path))


def _made(path: Path | None, config: Config, given: Mapping[str, Any], flight: Flight) -> _Loaded:
    simulator = config.simulator(flight)
    lines = FlightLines.of(flight.attitude, flight.attitude.first_s)
    return _Loaded(path, config, given, flight, lines, simulator, Overlays(simulator.sky.catalogue))


def _still_given(given: Mapping[str, Any], config: Config) -> Mapping[str, Any]:
    """Return which of the keys that were given for a log hold beside other settings, which may have their own."""
    theirs: set[str] = set()
    if config.flight.utc_start is not None:
        theirs.add("flight.utc_start")
    if config.flight.site is not None:
        theirs.update(f"flight.{key}" for key in PLACE_KEYS)
    return {key: value for key, value in given.items() if key not in theirs}


def _adapted(simulator: Simulator, before: Config, config: Config) -> Simulator:
    """Return a simulator with other settings; its stars are found anew only where the sky is another."""
    if config is before:
        return simulator
    sky = ("catalogue", "vmag_limit", "astrometry")
    other_sky = any(getattr(config.sky, name) != getattr(before.sky, name) for name in sky)
    if other_sky or config.star_brightness() != before.star_brightness():
        return config.simulator(simulator.flight)
    return replace(
        simulator,
        sky=replace(simulator.sky, dut1_s=config.sky.dut1_s, refraction=config.sky.refraction),
        camera=config.camera(),
        mount=config.mount(),
        sensor=config.sensor(),
        pressure_hpa=config.air.pressure_hpa,
        temperature_c=config.air.temperature_c,
    )


def _alike(one: object, other: object) -> bool:
    if one is other or one == other:
        return True
    # A sky is no value: it holds arrays.
    names = ("catalogue", "astrometry", "dut1_s", "refraction")
    return all(
        hasattr(one, name) and hasattr(other, name) and getattr(one, name) == getattr(other, name) for name in names
    )


def _first_stretch(config: Config) -> Stretch:
    """Return the stretch with which the viewer begins: the sky black, stars as bright as those of the bundled camera.

    A sensor whose digital numbers fill a small part of its bits would be black otherwise.
    """
    sensor = config.sensor()
    star = float(sensor.peak_dn([3.0], 0.5)[0]) / sensor.saturation_dn
    boost = _BOOST * max(1.0, _STAR / star) if star > 0 else _BOOST
    return Stretch(boost=boost, black=sensor.sky_mean_dn / sensor.saturation_dn)


def unused(path: Path) -> Path:
    """Return this path, or the first like it with a number, that is not there yet.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Path
    """
    number = 2
    chosen = path
    # Beside a directory of frames there are its settings, and a live flight's table.
    beside = ("",) if path.suffix == ".png" else ("", ".toml", ".csv")
    while any(chosen.with_name(chosen.name + suffix).exists() for suffix in beside):
        chosen = path.with_name(
            f"{path.stem}-{number}{path.suffix}" if path.suffix == ".png" else f"{path.name}-{number}"
        )
        number += 1
    return chosen
