"""The state of the viewer: a flight, settings, a play head and the image of its exposure; no window, no imgui."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from math import floor
from pathlib import Path
from typing import Any

from glstar.camera.exposure import ControlledExposure, Exposure
from glstar.config import Config
from glstar.errors import GlstarError
from glstar.export.plan.frames import Shot, level_of
from glstar.flight import Flight, Gap
from glstar.images import FittedImage, RealImage
from glstar.link import LatestAttitude
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.telemetry import is_bag_directory
from glstar.viewer.flight import loaded as loadedflight
from glstar.viewer.flight.live import LiveFlight
from glstar.viewer.flight.lookaround import LookAround
from glstar.viewer.flight.navigator import NavigatorView
from glstar.viewer.flight.playhead import Mode, PlayHead, no_exposure
from glstar.viewer.flight.sky import Conditions, CurrentConditions
from glstar.viewer.frametimes import FrameTimes
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode, ComparisonState, outside
from glstar.viewer.picture.content import PanelContent
from glstar.viewer.picture.simulated import ImageRequest, SimulatedImage
from glstar.viewer.picture.view import ImageView, Stretch
from glstar.viewer.session.memory import Notifications
from glstar.viewer.session.recording import BackgroundExport, Video

# Exposures that no camera records start at a multiple of 1 microsecond, which a command line can name exactly.
_STARTS_PER_S = 1e6

# Star directions of a live flight are computed again after this time, s: they change by 0.03" an hour.
_STARS_S = 3600.0

# Interval of flight after which a stretch that follows the image is fitted again while the flight plays, s.
_FOLLOW_S = 0.5

# Suffixes of files that describe a camera and its lens.
_CAMERA_FILES = (".yaml", ".yml", ".json")


class Session:
    """The state of the viewer, and every change of it.

    `renderer`: on the window's context; `output`: where frames, settings and pictures are saved; by default
    ``glstar-saved`` in the working directory; `clock`: returns seconds from any origin.
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
        self.config = config  # The present settings
        self.output = Path.cwd() / "glstar-saved" if output is None else output
        self.loaded: loadedflight.LoadedFlight | None = None  # The flight shown; None until the first is loaded
        self.live: LiveFlight | None = None  # The flight that a link receives, if there is a link
        self.loader = loadedflight.FlightLoader()
        self.times = FrameTimes()
        self.image = SimulatedImage(renderer, self.times)
        self.notifications = Notifications(clock)
        self.notify = self.notifications.add  # Shows a message for some seconds
        self.view = ImageView()
        self.navigator = NavigatorView(self.loader.others)
        self.look = LookAround()  # The camera that the user turns, if it is on
        self.stretch = Stretch.for_sensor(config.sensor())
        self.shown_overlays: set[Overlay] = {Overlay.STAR_NAMES}
        self.night = False
        self.shows_processed = False
        self.name_vmag_limit = 3.0  # Magnitude limit of star names
        self.comparison = ComparisonState(clock)
        self.export: BackgroundExport | None = None  # The export that is running
        self.video: Video | None = None  # The video that is being recorded
        # Reason why the flight opened last could not be loaded.
        self._opening_error = ""
        self._missing_site: loadedflight.MissingInputs | None = None
        self._current_conditions = CurrentConditions(clock)
        # Keys of the config that were given for the log shown; no other log is read with them.
        self._given: Mapping[str, Any] = {}
        # Whether the link's flight is shown or awaited; its epoch; and the time for which its stars were computed.
        self._shows_link = False
        self._epoch = 0
        self._stars_utc_s = 0.0
        self._latest: LatestAttitude | None = None
        self._control: ControlledExposure | None = None
        self._measured: Scene | None = None
        self.plays: Path | None = None  # The flight that plays when it has been loaded
        # The scene to which the stretch was fitted last.
        self.followed: Scene | None = None
        # A simulator, the exposure time, s, and the gain of the control, and the simulator with them.
        self._as_set: tuple[Simulator, tuple[float, float], Simulator] | None = None

    # --- the flight shown ---

    @property
    def flight(self) -> Flight | None:
        """The flight shown; None if there is none."""
        return None if self.loaded is None else self.loaded.flight

    @property
    def head(self) -> PlayHead | None:
        """The play head of the flight shown; None if there is none."""
        return None if self.loaded is None else self.loaded.head

    @property
    def scene(self) -> Scene | None:
        """The scene of the image shown; None until there is one."""
        return self.image.scene

    @property
    def is_playing(self) -> bool:
        """Whether a flight is shown whose play head moves."""
        return self.head is not None and self.head.playing

    @contextmanager
    def errors_reported(self) -> Iterator[None]:
        """Show a `GlstarError` that is raised inside as a notification."""
        try:
            yield
        except GlstarError as error:
            self.notify(str(error), is_error=True)

    # --- frames ---

    def update(self, elapsed_s: float) -> None:
        """Advance the play head, install a flight that has been loaded, and draw the image if it changed.

        `elapsed_s`: time since the last call, s.
        """
        self._poll()
        if self.live is not None:
            self._poll_link(self.live)
        loaded = self.loaded
        if loaded is None:
            return
        if self._shows_link and self.live is not None and self.live.epoch != self._epoch:
            return  # the link's clock was set: its new flight is being loaded
        head = loaded.head
        head.advance(elapsed_s)
        exposure, number = _exposure_to_show(loaded, self.comparison)
        if self._shows_link and self.live is not None and loaded.extend(exposure, self.live.last):
            exposure, number = _exposure_to_show(loaded, self.comparison)
        simulator = self.look.of(loaded.simulator) if self.is_looking else loaded.simulator
        shot = self._exposed(Shot(simulator, exposure, control=self.config.exposure.exposure_control))
        request = ImageRequest(shot.exposure, number, shot.simulator, self.comparison.is_noiseless)
        drawn = self.image.update(request, playing=head.playing and not head.live)
        self._measure()
        _follow_image(self)
        if drawn and head.live and self.live is not None and self._latest is not None:
            self.live.drew(self._latest, self.scene, self.config.exposure.duration_s)

    def _exposed(self, shot: Shot) -> Shot:
        """Return a shot as the exposure control sets it; real images have exposures of their own."""
        if shot.control is None or self.comparison.mode is not ComparisonMode.OFF:
            self._control = None
            return shot
        if self._control is None or self._control.control != shot.control:
            self._control = ControlledExposure.begun(shot.control, shot.sensor_gain)
        settings = self._control.settings
        if self._as_set is None or self._as_set[0] is not shot.simulator or self._as_set[1] != settings:
            # The same simulator for the same settings: another one would be another image.
            self._as_set = shot.simulator, settings, shot.set_to(*settings).simulator
        return replace(shot.set_to(*settings), simulator=self._as_set[2])

    def _measure(self) -> None:
        """Measure an image that is new for the exposure control: each image that is drawn is a frame of it."""
        scene = self.scene
        if self._control is None or scene is None or self.image.is_noiseless:
            return
        if scene is self._measured:
            self._control = self._control.unmeasured()
            return
        self._measured, pixels, electrons = scene, self.image.pixels, scene.sensor.electrons
        if pixels is not None and electrons is not None:
            level = level_of(self._control.control, scene.exposure, scene.sensor, pixels)
            self._control = self._control.after(level, scene.exposure.duration_s * electrons.analogue_gain)

    def follow_image(self) -> None:
        """Fit the stretch to the image shown in the next update, unless it is held."""
        self.followed = None

    # --- live flights ---

    def follow(self, live: LiveFlight) -> None:
        """Show the flight that a link receives, as soon as its sky can be drawn; `live`: the session closes it."""
        self.live = live
        self.navigator.live = live
        self._shows_link = False
        self.go_live()

    def go_live(self) -> None:
        """Show the present sky of the link, instead of an earlier time of its flight or of a log."""
        if self.live is None:
            self.notify("there is no link: connect to one (Ctrl+L)")
        elif self._shows_link and self.loaded is not None:
            self.loaded.head.last()
        else:
            self.config = self._own_config
            self._given = {}
            self._shows_link = True
            self._epoch = 0
            self.loaded = None
            self._opening_error = ""
            self.loader.missing = None
            self.loader.drop()
            self.image.clear()

    def _poll_link(self, live: LiveFlight) -> None:
        """Take new events and attitudes of the link; load its flight when it begins, extend it later."""
        latest = live.poll(on_gimbal=self.config.gimbal.mode == "log")
        for event in live.new_events():
            self.notify(event.message)
        if not self._shows_link or latest is None or self.loader.is_busy:
            return
        begins = live.epoch != self._epoch
        if begins or abs(latest.utc_s - self._stars_utc_s) > _STARS_S:
            flight = live.last(self.config.exposure.span_s + loadedflight.BEFORE_EXPOSURE_S)
            if flight is not None:
                self._stars_utc_s = latest.utc_s
                self.loader.make(self.config, flight)
            return
        if self.loaded is None or latest.utc_s <= self.loaded.head.first_s:
            return
        self._latest = latest
        self.loaded.extend_to(latest.utc_s, live.buffered(self.loaded.head.origin_s))

    @property
    def stale_s(self) -> float | None:
        """The age of the live sky, s, if it is more than a second; None otherwise."""
        return self.live.stale_s if self.live is not None and self.head is not None and self.head.live else None

    # --- what the window shows ---

    @property
    def shown(self) -> PanelContent | None:
        """The contents of the image panel; None until there is an image, and if the exposure touches a gap."""
        image = self.image
        if not image.has_image or image.scene is None or image.gap is not None:
            return None
        real = self.real  # once: it also decodes ahead
        return PanelContent.of(image, image.scene, real and real[1], self.comparison, is_processed=self.shows_processed)

    @property
    def real(self) -> tuple[RealImage, FittedImage] | None:
        """The real image at the play head with its pixels; None until they are decoded."""
        if self.loaded is None or self.scene is None:
            return None
        return self.comparison.decoded_at(self.loaded.head.utc_s, self.scene.camera, self.scene.white_dn)

    @property
    def status(self) -> str:
        """A message about the image shown, or the reason why there is none; empty if there is nothing to report."""
        if self._opening_error or self.image.error:
            return self._opening_error or self.image.error
        loaded, live = self.loaded, self.live
        if loaded is None:
            return live.lacking if self._shows_link and live is not None else ""
        if (stale_s := self.stale_s) is not None and live is not None:
            return f"{live.stale_message(stale_s)}\n{live.status.problem or ''}".strip()
        return _status_at(loaded, self.comparison, self.image.gap)

    @property
    def is_looking(self) -> bool:
        """Whether the image is the free camera's; real images are compared with the aircraft's own."""
        return self.look.is_on and self.comparison.mode is ComparisonMode.OFF

    @property
    def conditions(self) -> Conditions | None:
        """The Sun, the Moon and the limiting magnitude of the image shown; None until there is one."""
        return self._current_conditions.of(self.scene, self.head)

    @property
    def busy(self) -> bool:
        """Whether the next frame may differ from this one without any event."""
        playing = self.is_playing and self.stale_s is None
        works = self.export is not None or self.video is not None or self.loader.works
        return playing or self.comparison.is_blinking or works or self.comparison.waiting

    # --- opening ---

    def open(self, path: Path) -> None:
        """Open a log, settings (``.toml``), a camera (``.yaml``, ``.json``), or a folder of real images."""
        if path.is_dir() and not is_bag_directory(path):
            self.comparison.open(path)
        elif path.suffix.lower() == ".toml":
            self.open_settings(path)
        elif path.suffix.lower() in _CAMERA_FILES:
            self.change(**{"camera.file": str(path.resolve())})
        else:
            self.open_flight(path)

    def open_flight(self, path: Path) -> None:
        """Begin to read a log; the present flight plays on, and stays if the log cannot be read.

        `path`: if it lacks UTC or a site, `missing` says so once it has been read.
        """
        self.loader.read(path, self._own_config, {})

    @property
    def missing(self) -> loadedflight.MissingInputs | None:
        """The missing inputs of the log opened last or of the link, until the user gives them or cancels."""
        return self.loader.missing or self._missing_site

    def ask_for_site(self) -> None:
        """Ask for the site of the link's flight: `missing` is set."""
        if self.live is not None:
            self._missing_site = loadedflight.MissingInputs.from_link(self.live.status.endpoint, self.loader.typed_site)

    def give(self, missing: loadedflight.MissingInputs, typed: Mapping[str, str]) -> None:
        """Use the inputs that the user typed: read the log again, or show the link's flight from that site.

        `typed`: by key of ``[flight]``: ``utc_start``, ``latitude_deg``, ``longitude_deg``, ``height_m``.  Raises
        ConfigError if something is missing or not valid; nothing changes then.
        """
        if missing.path is not None:
            self.loader.read_again(self._own_config, missing, typed)
            return
        site = self._own_config.override(**loadedflight.flight_keys(missing.fields, typed)).flight.site
        if self.live is not None and site is not None:
            self.live.link.set_site(site)
        self.loader.typed_site = {key: typed.get(key, "") for key in loadedflight.SITE_KEYS}
        self._missing_site = None

    def cancel_missing(self) -> None:
        """Do not open the log with missing inputs, and leave the link without a site."""
        missing = self.loader.missing
        if missing is not None and self.loaded is None and self.live is None:
            self._opening_error = f"{missing.message}\nOpen it again (Ctrl+O) to give what it lacks."
        self.loader.missing = self._missing_site = None

    def wait_for_flight(self) -> None:
        """Wait until the log that is being read has been read: for scripts.

        Raises GlstarError if the log cannot be replayed.
        """
        if self.loader.is_busy:
            self._install(self.loader.take())

    def _poll(self) -> None:
        self.comparison.poll()
        if self.comparison.error:
            self.notify(self.comparison.error, is_error=True)
            self.comparison.error = ""
        if self.loader.others.poll(self.notify):
            self.shown_overlays |= {Overlay.NAVIGATOR}
        if self.export is not None and not self.export.running:
            self.notify(self.export.summary, is_error=bool(self.export.error))
            self.export = None
        if self.loader.is_done:
            path = self.loader.path
            try:
                self._install(self.loader.take())
            except (GlstarError, OSError) as error:
                if self.loader.missing is None:
                    self.notify(str(error), is_error=True)
                    if self.loaded is not None and path == self.loaded.path:
                        self.use(self.loaded.as_read(self.config))
                if self.loaded is None:
                    self._opening_error = str(error)
            except MemoryError:
                self.notify(f"{path}: is too large for this machine's memory", is_error=True)

    def _install(self, loaded: loadedflight.LoadedFlight) -> None:
        """Show a flight that has been loaded."""
        before = self.loaded
        if loaded.given != self._given:
            own = self._own_config
            self.config = own.override(**loaded.given) if loaded.given else own
            self._given = loaded.given
        loaded.use(self.config)
        self._shows_link = loaded.is_live
        if self._shows_link and self.live is not None:
            if before is not None and self._epoch == self.live.epoch:
                loaded.head = before.head  # the same flight, with star directions computed again
            self._epoch = self.live.epoch
        elif before is not None:
            loaded.continue_from(before)
        self.loaded = loaded
        if before is None or before.path != loaded.path:
            self.loader.others.clear()
        if loaded.path is not None and loaded.path == self.plays:
            self.plays = None
            loaded.head.mode, loaded.head.playing = Mode.SLIDING, True
        self._opening_error = ""
        self.image.error = ""
        self.comparison.flight_offset_s = loaded.flight.time_offset_s
        for note in loaded.flight.notes:
            self.notify(note)

    # --- settings ---

    @property
    def _own_config(self) -> Config:
        """The settings without the inputs given for the log shown."""
        return self.config.without(*self._given) if self._given else self.config

    def open_settings(self, path: Path) -> None:
        """Take the settings of a file; the present ones stay if it is not valid.

        UTC and site that were given for the log shown stay, too, unless the file has them.
        """
        before = self._given
        try:
            config = Config.load(path)
            self._given = _still_given(before, config)
            self.use(config.override(**self._given) if self._given else config)
            self.notify(f"settings of {path.name}")
        except GlstarError as error:
            self._given = before
            self.notify(str(error), is_error=True)

    def change(self, **keys: Any) -> None:
        """Change settings; a value that is not valid changes nothing and is reported.

        `**keys`: by dotted key: ``session.change(**{"exposure.duration_s": 1.0})``.
        """
        with self.errors_reported():
            self.use(self.config.override(**keys))

    def use(self, config: Config) -> None:
        """Take settings; a `GlstarError` says that the simulator refuses them, and nothing changes then."""
        before, loaded = self.config, self.loaded
        if loaded is not None:
            loaded.use(config)
            self.stretch = self.stretch.for_white(before.sensor().saturation_dn, config.sensor().saturation_dn)
            if config.flight != before.flight or config.navigator.attitude != before.navigator.attitude:
                if loaded.path is not None:
                    self.loader.follow(loaded, config, self._given)
                elif config.flight != before.flight:
                    self.notify("[flight] of the settings is for logs; the flags of glstar live are for links")
        self.config = config

    def close(self) -> None:
        """Stop the export, keeping its complete frames, and end all threads; the renderer stays the caller's."""
        if self.export is not None:
            self.export.cancel()
            self.export.wait()
            self.export = None
        if self.video is not None:
            self.video.discard()
        self.image.close()
        self.loader.close()
        self.comparison.close()
        if self.live is not None:
            self.live.close()


def _follow_image(session: Session) -> None:
    """Fit black and white to a new image unless they are held; while the flight plays, twice a second of it."""
    scene, before = session.scene, session.followed
    if scene is None or scene is before or session.stretch.held:
        return
    if session.is_playing and before is not None and _is_near(before, scene):
        return
    pixels = session.image.pixels
    if pixels is not None:
        session.followed = scene
        session.stretch = session.stretch.following(pixels, scene.white_dn, Stretch.for_sensor(scene.sensor))


def _is_near(before: Scene, scene: Scene) -> bool:
    """Return whether an image follows another one so closely that the same stretch fits it."""
    elapsed_s = abs(scene.exposure.start_utc_s - before.exposure.start_utc_s)
    is_alike = before.sensor is scene.sensor and before.exposure.duration_s == scene.exposure.duration_s
    return is_alike and elapsed_s < _FOLLOW_S


def _exposure_to_show(loaded: loadedflight.LoadedFlight, comparison: ComparisonState) -> tuple[Exposure, int | None]:
    """Return the exposure at the play head, or of the real image there, and its number if the camera records it."""
    head = loaded.head
    # The exposures of a live flight are counted from when the viewer started: their numbers mean nothing later.
    exposure, number = head.exposure(), None if loaded.is_live else head.number
    real = comparison.image_at(head.utc_s)
    if real is not None:
        real_exposure = comparison.exposure(real, exposure)
        attitude = loaded.flight.attitude
        if not outside(real_exposure, attitude.first_s, attitude.last_s):
            exposure, number = real_exposure, None
    if number is None:
        start_s = floor((exposure.start_utc_s - head.origin_s) * _STARTS_PER_S) / _STARTS_PER_S
        exposure = replace(exposure, start_utc_s=head.origin_s + max(start_s, 0.0))
    return exposure, number


def _status_at(loaded: loadedflight.LoadedFlight, comparison: ComparisonState, gap: Gap | None) -> str:
    """Return a message about the exposure shown; empty if all is well."""
    head, attitude = loaded.head, loaded.flight.attitude
    real = comparison.image_at(head.utc_s)
    if real is not None:
        exposure = comparison.exposure(real, head.exposure())
        if message := outside(exposure, attitude.first_s, attitude.last_s):
            return message
    if gap is not None:
        return no_exposure(gap, source="link" if loaded.is_live else "log")
    # The exposure shown is the real image's, so the play head's status does not apply to it.
    return "" if real is not None else head.status(attitude) or ""


def _still_given(given: Mapping[str, Any], config: Config) -> Mapping[str, Any]:
    """Return the keys given for a log that other settings do not have themselves."""
    present: set[str] = set()
    if config.flight.utc_start is not None:
        present.add("flight.utc_start")
    if config.flight.site is not None:
        present.update(f"flight.{key}" for key in loadedflight.SITE_KEYS)
    return {key: value for key, value in given.items() if key not in present}
