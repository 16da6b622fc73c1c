"""The window that calibrates a camera from a photograph of the stars.

A photograph with its identified stars, in the current imgui window.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from math import radians
from pathlib import Path

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import GlstarError
from glstar.render.opengl import Context, Texture
from glstar.viewer.overlays.canvas import arrow_strokes, residual_scale
from glstar.viewer.picture import fitting
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.content import Display, PanelContent, Picture
from glstar.viewer.picture.view import ImageView, Stretch, StretchKind
from glstar.viewer.session.state import Session
from glstar.viewer.ui.dialogs import FileChooser
from glstar.viewer.ui.theme import centre_next_window, dialog_size, error, scaled

Colour = tuple[float, float, float, float]

_IDENTIFIED: tuple[Colour, Colour] = ((0.38, 0.88, 0.66, 1.0), (0.9, 0.0, 0.0, 1.0))
_RESIDUAL: tuple[Colour, Colour] = ((1.0, 0.47, 0.25, 1.0), (1.0, 0.0, 0.0, 1.0))
_OTHER: tuple[Colour, Colour] = ((0.65, 0.70, 0.75, 0.55), (0.45, 0.0, 0.0, 0.8))
# Radius of a star's ring, distance of the mouse at which it is meant, and of a drag, screen px.
_RING_PX = 7.0
_CURSOR_PX = 10.0
_CLICK_PX = 2.0
_WHEEL = 1.2
# Names are written for this many of the brightest stars.
_NAMED = 12
# Nine of ten arrows are at most this long, screen px.
_LONG_PX = 30.0


class PhotoPanel:
    """Draws a photograph with zoom and pan, and the stars on it.

    `detected_px` (n, 2): detected stars; `corner` (2,): of the panel, screen px.
    """

    def __init__(self, context: Context) -> None:
        self.detected_px: Float = np.empty((0, 2))
        self.corner: Float = np.zeros(2)
        self._context = context
        self._display: Display | None = None
        self._texture: Texture | None = None
        self._view, self._stretch, self._white_dn = ImageView(), Stretch(StretchKind.ASINH), 1
        self._drawn: tuple[object, ...] = ()
        self._name = 0

    def show(self, pixels: NDArray[np.uint16], white_dn: int) -> None:
        """Show a photograph; `pixels` (height, width) uint16."""
        self._release()
        self.detected_px = np.empty((0, 2))
        height, width = pixels.shape
        self._texture = self._context.texture(
            (width, height), 1, np.ascontiguousarray(pixels).tobytes(), alignment=1, dtype="u2"
        )
        self._white_dn, self._drawn = white_dn, ()
        self._stretch = Stretch(StretchKind.ASINH).fitted(pixels, white_dn)
        self._view = ImageView()

    def draw(
        self, result: fitting.CalibratedPhoto | None, removed_px: list[tuple[float, float]], *, night: bool
    ) -> tuple[float, float] | None:
        """Draw the photograph.

        `removed_px` list of (float, float): detections that the user has removed, px.  Returns (float, float) or None:
        the position of an identified star that the user has clicked on, px.
        """
        available = imgui.get_content_region_avail()
        size = max(round(available.x), 1), max(round(available.y), 1)
        origin = imgui.get_cursor_screen_pos()
        corner = self.corner = np.array([origin.x, origin.y])
        if self._texture is None:
            imgui.text_disabled("reading ...")
            return None
        width_px, height_px = self._texture.size
        self._view.resize(width_px, height_px, *size)
        imgui.invisible_button("##photo", ImVec2(*size), imgui.ButtonFlags_.mouse_button_left)
        imgui.set_item_key_owner(imgui.Key.mouse_wheel_y)
        hovered = imgui.is_item_hovered()
        at = np.array([imgui.get_mouse_pos().x, imgui.get_mouse_pos().y]) - corner
        clicked = self._take_mouse(at, hovered=hovered)
        draw_list = imgui.get_window_draw_list()
        reference = imgui.ImTextureRef(self._picture(size, night=night))
        draw_list.add_image(reference, origin, ImVec2(origin.x + size[0], origin.y + size[1]))
        draw_list.push_clip_rect(origin, ImVec2(origin.x + size[0], origin.y + size[1]), True)
        self._draw_marks(draw_list, corner, self.detected_px, _OTHER[night], 4.0)
        self._draw_marks(draw_list, corner, np.reshape(removed_px, (-1, 2)), _RESIDUAL[night], _RING_PX)
        chosen = None
        if result is not None:
            chosen = self._draw_stars(draw_list, corner, result, at if hovered else None, night=night)
        draw_list.pop_clip_rect()
        if chosen is None or not clicked or result is None:
            return None
        x_px, y_px = result.xy_px[chosen].tolist()
        return x_px, y_px

    def _take_mouse(self, at: Float, *, hovered: bool) -> bool:
        """Zoom and pan; return whether the user has clicked."""
        io = imgui.get_io()
        if hovered and io.mouse_wheel:
            self._view.zoom_at(at, _WHEEL**io.mouse_wheel)
        if imgui.is_item_active() and imgui.is_mouse_dragging(0, _CLICK_PX):
            self._view.pan(io.mouse_delta.x, io.mouse_delta.y)
        if hovered and imgui.is_mouse_double_clicked(0):
            self._view.fit()
            return False
        return hovered and imgui.is_mouse_released(0) and imgui.get_mouse_drag_delta(0, _CLICK_PX) == ImVec2(0, 0)

    def _picture(self, size: tuple[int, int], *, night: bool) -> int:
        """Return the texture of the visible part, drawn again if anything has changed."""
        assert self._texture is not None
        if self._display is None:
            self._display = Display(self._context)
        scale = imgui.get_io().display_framebuffer_scale.x
        drawn = (self._texture, size, scale, night, self._view.zoom, *self._view.centre_px)
        if drawn != self._drawn:
            self._drawn = drawn
            content = PanelContent(self._texture, self._white_dn, None, ComparisonMode.OFF, 0.5, 0.0, 0.0, 1.0)
            pixels = round(size[0] * scale), round(size[1] * scale)
            picture = Picture.of(content, self._view, self._stretch, pixels, scale=scale, night=night)
            self._name = self._display.draw(picture)
        return self._name

    def _draw_marks(
        self, draw_list: imgui.ImDrawList, corner: Float, xy_px: Float, colour: Colour, half_px: float
    ) -> None:
        """Draw crosses."""
        packed = imgui.get_color_u32(colour)
        for x, y in (self._view.to_screen(xy_px) + corner).tolist():
            draw_list.add_line(ImVec2(x - half_px, y - half_px), ImVec2(x + half_px, y + half_px), packed)
            draw_list.add_line(ImVec2(x - half_px, y + half_px), ImVec2(x + half_px, y - half_px), packed)

    def _draw_stars(
        self,
        draw_list: imgui.ImDrawList,
        corner: Float,
        result: fitting.CalibratedPhoto,
        at: Float | None,
        *,
        night: bool,
    ) -> int | None:
        """Draw the identified stars with their residuals, and return the one under the mouse."""
        xy = self._view.to_screen(result.xy_px)
        ring, text = imgui.get_color_u32(_IDENTIFIED[night]), imgui.get_font_size()
        for x, y in (xy + corner).tolist():
            draw_list.add_circle(ImVec2(x, y), _RING_PX, ring)
        for star in np.argsort(result.vmag, kind="stable")[:_NAMED].tolist():
            x, y = (xy[star] + corner).tolist()
            draw_list.add_text(ImVec2(x + _RING_PX, y - text / 2), ring, result.name[star])
        towards_px = -result.residual_px  # from the detected to the predicted position
        scale = residual_scale(towards_px, 1 / self._view.zoom, _LONG_PX)
        tips = self._view.to_screen(result.xy_px + scale * towards_px)
        moved = np.any(towards_px != 0, axis=1)
        colour = imgui.get_color_u32(_RESIDUAL[night])
        for start, end in (arrow_strokes(xy[moved], tips[moved], 5.0) + corner).tolist():
            draw_list.add_line(ImVec2(*start), ImVec2(*end), colour, 1.5)
        label = f"arrows {scale:g} x: from the detected to the predicted position"
        draw_list.add_text(ImVec2(corner[0] + 6, corner[1] + 4), colour, label)
        if at is None or not len(xy):
            return None
        distance = np.linalg.norm(xy - at, axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] > _CURSOR_PX:
            return None
        right_px, down_px = result.residual_px[nearest].tolist()
        imgui.set_tooltip(
            f"{result.name[nearest]}   V {result.vmag[nearest]:.2f}\n"
            f"residual {right_px:+.2f}, {down_px:+.2f} px\nclick: remove it, and solve again"
        )
        return nearest

    def _release(self) -> None:
        if self._texture is not None:
            self._texture.release()
            self._texture = None

    def close(self) -> None:
        """Release the objects on the GPU."""
        self._release()
        if self._display is not None:
            self._display.close()
            self._display = None


# Files that can only be photographs.
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".dng", ".heic", ".heif", ".fits", ".fit")
# Size of the window and width of its controls, screen px at scale 1.
_SIZE = (1080.0, 700.0)
_CONTROLS_PX = 340.0
_FLAGS = int(imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_collapse | imgui.WindowFlags_.no_saved_settings)
_ANY_POPUP = int(imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level)


class CalibrateWindow:
    """Calibrates a camera from a photograph, and shows the identified stars on it.

    `calibrate`: how to calibrate; None if the window cannot; `run`: the calibration that runs or was made last;
    `result`: the latest result for the photograph; `removed_px` list of (float, float): detections that the user has
    removed, px.
    """

    def __init__(self, context: Context, files: FileChooser) -> None:
        self.calibrate: fitting.CalibratePhoto | None = None
        self.is_open = False
        self.run: fitting.CalibrationRun | None = None
        self.result: fitting.CalibratedPhoto | None = None
        self.removed_px: list[tuple[float, float]] = []
        self._first: fitting.CalibratedPhoto | None = None
        self._files, self._photo = files, PhotoPanel(context)
        self._path: Path | None = None
        self._typed = {"fov": "", "exposure": "", "utc": "", "latitude": "", "longitude": ""}
        self._own_camera, self._geometry_only = True, False
        self._shown: fitting.CalibrationProgress | None = None
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-save-calibration")
        self._saving: Future[list[Path]] | None = None

    def ask(self, session: Session) -> None:
        """Let the user choose a photograph."""
        start = Path.cwd() if self._path is None else self._path
        self._files.ask("open", "Open a photograph of the stars", start, lambda path: self.open(session, path))

    def open(self, session: Session, path: Path) -> None:
        """Show a photograph and calibrate with the camera of the settings, if possible."""
        if self.calibrate is None:
            session.notify("this window cannot calibrate: use glstar view, or glstar camera calibrate", is_error=True)
            return
        self.close_run()
        self._path, self.is_open, self.result, self._first = path, True, None, None
        self.removed_px = []
        self._start(session)

    @property
    def is_running(self) -> bool:
        """Whether a calibration is running or being written."""
        return self._saving is not None or (self.run is not None and self.run.running)

    def save(self, result: fitting.CalibratedPhoto, path: Path) -> None:
        """Write a result on a thread, because its report takes a second to draw; `path`: gets the suffix ``.toml``."""
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
        """Draw the window if it is open."""
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
        request = fitting.CalibrationRequest(
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
        self.run = fitting.CalibrationRun(request, self.calibrate)

    def _fov_rad(self) -> float | None:
        """Return the width of the view that was typed; None for the camera of the settings."""
        if self._own_camera:
            return None
        degrees = _number("view", self._typed["fov"])
        if degrees is None or not 1 <= degrees <= 300:
            raise ValueError("give the width of the view: 1 to 300 deg, left to right, right to 15 %")
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

    def _draw_result(self, session: Session, result: fitting.CalibratedPhoto) -> None:
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
        imgui.set_item_tooltip("with the list of stars, a report and JSON beside it, as glstar camera calibrate")
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


def _apply(session: Session, result: fitting.CalibratedPhoto) -> None:
    try:
        session.use(fitting.with_calibration(session.config, result.toml))
    except GlstarError as problem:
        session.notify(str(problem), is_error=True)
    else:
        session.notify("the settings have the calibration; Ctrl+Z takes it back")
