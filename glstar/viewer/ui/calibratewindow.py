"""The window that calibrates a camera from a photograph of the stars."""

from concurrent.futures import Future, ThreadPoolExecutor
from math import radians
from pathlib import Path
from typing import Final

from imgui_bundle import ImVec2, imgui

from glstar.errors import GlstarError
from glstar.render.opengl.objects import Context
from glstar.viewer.photocalibration import (
    CalibratedPhoto,
    CalibratePhoto,
    CalibrationProgress,
    CalibrationRequest,
    CalibrationRun,
    with_calibration,
)
from glstar.viewer.session import Session
from glstar.viewer.ui.filedialogs import FileChooser
from glstar.viewer.ui.photopanel import PhotoPanel
from glstar.viewer.ui.theme import centre_next_window, dialog_size, error, scaled

__all__ = ["PHOTO_SUFFIXES", "CalibrateWindow"]

# Files that can only be photographs.
PHOTO_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".dng", ".heic", ".heif", ".fits", ".fit")
# Size of the window and width of its controls, screen px at scale 1.
_SIZE: Final = (1080.0, 700.0)
_CONTROLS_PX: Final = 340.0
_FLAGS: Final = int(
    imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_collapse | imgui.WindowFlags_.no_saved_settings
)
_ANY_POPUP: Final = int(imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level)


class CalibrateWindow:
    """Calibrates a camera from a photograph, and shows the identified stars on it.

    Parameters
    ----------
    context : Context
    files : FileChooser

    Attributes
    ----------
    calibrate : callable or None
        How to calibrate; None if the window cannot.
    is_open : bool
    run : CalibrationRun or None
        The calibration that runs or was made last.
    result : CalibratedPhoto or None
        The latest result for the photograph.
    removed_px : list of (float, float)
        Detections that the user has removed, px.
    """

    def __init__(self, context: Context, files: FileChooser) -> None:
        self.calibrate: CalibratePhoto | None = None
        self.is_open = False
        self.run: CalibrationRun | None = None
        self.result: CalibratedPhoto | None = None
        self.removed_px: list[tuple[float, float]] = []
        self._first: CalibratedPhoto | None = None
        self._files, self._photo = files, PhotoPanel(context)
        self._path: Path | None = None
        self._typed = {"fov": "", "exposure": "", "utc": "", "latitude": "", "longitude": ""}
        self._own_camera, self._geometry_only = True, False
        self._shown: CalibrationProgress | None = None
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-save-calibration")
        self._saving: Future[list[Path]] | None = None

    def ask(self, session: Session) -> None:
        """Let the user choose a photograph.

        Parameters
        ----------
        session : Session
        """
        start = Path.cwd() if self._path is None else self._path
        self._files.ask("open", "Open a photograph of the stars", start, lambda path: self.open(session, path))

    def open(self, session: Session, path: Path) -> None:
        """Show a photograph and calibrate with the camera of the settings, if possible.

        Parameters
        ----------
        session : Session
        path : Path
        """
        if self.calibrate is None:
            session.notify("this window cannot calibrate: use glstar view, or glstar calibrate", is_error=True)
            return
        self.close_run()
        self._path, self.is_open, self.result, self._first = path, True, None, None
        self.removed_px = []
        self._start(session)

    @property
    def is_running(self) -> bool:
        """Whether a calibration is running or being written."""
        return self._saving is not None or (self.run is not None and self.run.running)

    def save(self, result: CalibratedPhoto, path: Path) -> None:
        """Write a result on a thread, because its report takes a second to draw.

        Parameters
        ----------
        result : CalibratedPhoto
        path : Path
            With the suffix ``.toml``.
        """
        self._saving = self._writer.submit(result.save, path)

    def _report_saved(self, session: Session) -> None:
        """Say what has been saved."""
        if self._saving is None or not self._saving.done():
            return
        saved, self._saving = self._saving, None
        try:
            written = saved.result()
        except (GlstarError, OSError) as problem:
            session.notify(str(problem), is_error=True)
        else:
            session.notify(f"{written[0]} and {len(written) - 1} files beside it")

    def close_run(self) -> None:
        """Stop the calibration."""
        if self.run is not None:
            self.run.close()
            self.run = None

    def close(self) -> None:
        """Stop the calibration and release the photograph's texture."""
        self.close_run()
        self._writer.shutdown(wait=True)
        self._photo.close()

    def draw(self, session: Session) -> None:
        """Draw the window if it is open.

        Parameters
        ----------
        session : Session
        """
        self._report_saved(session)
        if not self.is_open:
            return
        self._take()
        centre_next_window()
        imgui.set_next_window_size(dialog_size(*_SIZE), int(imgui.Cond_.appearing))
        expanded, stays = imgui.begin("Calibrate", True, _FLAGS)
        if expanded:
            imgui.begin_child("##controls", ImVec2(scaled(_CONTROLS_PX), 0))
            self._draw_controls(session)
            imgui.end_child()
            imgui.same_line()
            imgui.begin_child("##photo", ImVec2(0, 0), 0, int(imgui.WindowFlags_.no_scroll_with_mouse))
            clicked = self._photo.draw(self.result, self.removed_px, night=session.night)
            imgui.end_child()
            if clicked is not None and not self.is_running:
                self.removed_px.append(clicked)
                self._start(session)
        imgui.end()
        closes = imgui.is_key_pressed(imgui.Key.escape) and not imgui.is_popup_open("", _ANY_POPUP)
        self.is_open = bool(stays) and not closes
        if not self.is_open and self.run is not None:
            self.run.cancel()

    def _take(self) -> None:
        """Take the photograph when it has been read, and the result when the run has ended."""
        run = self.run
        if run is None:
            return
        if run.progress.pixels is not None and self._shown is not run.progress:
            self._shown = run.progress
            self._photo.show(run.progress.pixels, run.progress.white_dn)
        self._photo.detected_px = run.progress.detected_px if len(run.progress.detected_px) else self._photo.detected_px
        if not run.running and run.result is not None and run.result is not self.result:
            self.result = run.result
            self._first = self._first or run.result

    def _start(self, session: Session) -> None:
        """Calibrate with the inputs typed, or solve again without the stars that the user removed."""
        assert self.calibrate is not None
        assert self._path is not None
        try:
            fov_rad, site_rad = self._fov_rad(), self._site_rad()
            exposure_s = _number("exposure", self._typed["exposure"])
        except ValueError as problem:
            session.notify(str(problem), is_error=True)
            return
        request = CalibrationRequest(
            self._path,
            session.config,
            fov_rad,
            exposure_s,
            self._typed["utc"].strip(),
            site_rad,
            self._geometry_only,
            self._first if self.removed_px else None,
            tuple(self.removed_px),
        )
        self.run = CalibrationRun(request, self.calibrate)

    def _fov_rad(self) -> float | None:
        """Return the width of the view that was typed; None for the camera of the settings."""
        if self._own_camera:
            return None
        degrees = _number("view", self._typed["fov"])
        if degrees is None or not 1 <= degrees < 180:
            raise ValueError("give the width of the view: 1 to 180 deg, left to right, right to 15 %")
        return radians(degrees)

    def _site_rad(self) -> tuple[float, float] | None:
        """Return the latitude and longitude that were typed; None if there are none."""
        latitude, longitude = (_number(name, self._typed[name]) for name in ("latitude", "longitude"))
        if latitude is None and longitude is None:
            return None
        if latitude is None or longitude is None:
            raise ValueError("latitude and longitude belong together")
        return radians(latitude), radians(longitude)

    # --- controls ---

    def _draw_controls(self, session: Session) -> None:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_unformatted("" if self._path is None else self._path.name)
        imgui.begin_disabled(self.is_running)
        self._draw_inputs()
        if imgui.button("Calibrate"):
            self.result = self._first = None
            self.removed_px = []
            self._start(session)
        imgui.same_line()
        if imgui.button("Other photograph"):
            self.ask(session)
        imgui.end_disabled()
        run = self.run
        if run is not None and run.running:
            steps = run.progress.STEPS
            imgui.progress_bar(run.progress.done / steps, ImVec2(-1, 0), run.progress.step)
            if imgui.button("Stop"):
                run.cancel()
        elif run is not None and run.error:
            imgui.text_colored(error(), run.error)
        if self.result is not None:
            self._draw_result(session, self.result)
        imgui.pop_text_wrap_pos()

    def _draw_inputs(self) -> None:
        imgui.separator_text("Photograph")
        if imgui.radio_button("camera of the settings", self._own_camera):
            self._own_camera = True
        imgui.set_item_tooltip("the photograph is of the camera of [camera], perhaps binned or turned by 90 deg")
        if imgui.radio_button("another one, with a view of", not self._own_camera):
            self._own_camera = False
        imgui.begin_disabled(self._own_camera)
        self._input("fov", "deg wide", "", "width of the view, left to right, to 15 %")
        imgui.end_disabled()
        self._input("exposure", "exposure, s", "as the file states", "exposure time, s: the brightness depends on it")
        self._input("utc", "UTC", "unknown", "time at mid-exposure, ISO 8601; with the site it removes refraction")
        self._input("latitude", "latitude", "unknown", "deg, north positive")
        self._input("longitude", "longitude", "unknown", "deg, east positive")
        _, self._geometry_only = imgui.checkbox("camera only, no sensor", self._geometry_only)
        imgui.set_item_tooltip("for stars that are blurred or saturated; needs no exposure time")

    def _input(self, name: str, label: str, hint: str, tooltip: str) -> None:
        imgui.set_next_item_width(scaled(150.0))
        _, self._typed[name] = imgui.input_text_with_hint(label, hint, self._typed[name])
        imgui.set_item_tooltip(tooltip)

    def _draw_result(self, session: Session, result: CalibratedPhoto) -> None:
        imgui.separator_text("Result")
        for line in result.report:
            imgui.text_unformatted(line)
        imgui.text_disabled("click on a star that is wrong to remove it and solve again")
        if self.removed_px:
            imgui.text_unformatted(f"{len(self.removed_px)} removed")
            imgui.same_line()
            if imgui.button("Use all again") and not self.is_running:
                self.removed_px, self.result = [], self._first
                self.run = None
        if imgui.button("Save calibration.toml"):
            path = session.output / "calibration.toml"
            self._files.ask("save", "Save the calibration", path, lambda chosen: self.save(result, chosen))
        imgui.set_item_tooltip("with the list of stars, a report and JSON beside it, as glstar calibrate")
        imgui.same_line()
        if imgui.button("Apply to the camera"):
            _apply(session, result)
        imgui.set_item_tooltip("takes [camera], and [sensor] if it was fitted, into the settings; Ctrl+Z takes it back")
        for note in result.notes:
            imgui.bullet()
            imgui.text_unformatted(note)


def _number(name: str, text: str) -> float | None:
    """Return the number typed, None for an empty field."""
    if not text.strip():
        return None
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{name} is no number: {text.strip()!r}") from None


def _apply(session: Session, result: CalibratedPhoto) -> None:
    try:
        session.use(with_calibration(session.config, result.toml))
    except GlstarError as problem:
        session.notify(str(problem), is_error=True)
    else:
        session.notify("the settings have the calibration; Ctrl+Z takes it back")
