"""The panel Compare: real images are opened, chosen and compared, clock and mount fitted, residuals measured."""

from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path

from imgui_bundle import ImVec2, ImVec4, imgui

from glstar.images import FittedImage, RealImage, RealImages
from glstar.images.times import TimeReference
from glstar.sky.place.timescale import format_utc
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import LESS_RGB, MORE_RGB, ComparisonMode, ComparisonState, span
from glstar.viewer.picture.fitting import FitRequest, FitResult, ImageFit, ResidualRequest, TrailResiduals
from glstar.viewer.session.state import Session
from glstar.viewer.ui.theme import draw_button, draw_checkbox, draw_rows, draw_slider, draw_wrapped, error

_MORE = ImVec4(*MORE_RGB, 1.0)
_LESS = ImVec4(*LESS_RGB, 1.0)
# Range of the slider of the clock offset, s, for fine adjustment; larger offsets are typed.
_FINE_S = 5.0
# Rows of the list of images.
_LIST_ROWS = 6


@dataclass(frozen=True, slots=True)
class PanelRequests:
    """Requests of the user that the caller has to perform."""

    seek_utc_s: float | None = None  # Where to move the play head, UTC seconds since 1970 of the log's clock
    save_view: bool = False  # Whether to save the comparison as an image


class ComparisonPanel:
    """Widgets for a `ComparisonState`, drawn into the current imgui window."""

    def __init__(self, state: ComparisonState) -> None:
        self._state = state
        self._folder = ""
        self._listed: RealImage | None = None

    def draw(
        self, utc_s: float, image: RealImage | None, fitted: FittedImage | None, *, status: str = ""
    ) -> PanelRequests:
        """Draw the panel, and change the state as the user does.

        `utc_s`: the play head, UTC seconds since 1970 of the log's clock; `image`: the real image that is shown;
        `fitted`: its pixels, None while they are decoded; `status`: why no simulated image belongs to the real one; see
        `glstar.viewer.picture.comparison.outside`.
        """
        state = self._state
        self._draw_opening()
        images = state.images
        if images is None:
            return PanelRequests()
        draw_wrapped(images.time_sources)
        self._draw_mode()
        seek_utc_s = self._draw_images(images, image, utc_s)
        if image is not None:
            _draw_image(image, fitted, utc_s - state.log_utc_s(image))
        if status:
            draw_wrapped(status, error())
        self._draw_clock()
        self._draw_levels()
        imgui.begin_disabled(fitted is None)
        save_view = imgui.button("Save this view")
        imgui.end_disabled()
        _draw_problems(images)
        return PanelRequests(seek_utc_s, save_view)

    def _draw_opening(self) -> None:
        state = self._state
        button_px = imgui.calc_text_size("Open").x + 2 * imgui.get_style().frame_padding.x
        imgui.set_next_item_width(-button_px - imgui.get_style().item_spacing.x)
        entered, self._folder = imgui.input_text_with_hint(
            "##folder", "folder of real images, or drop it here", self._folder, imgui.InputTextFlags_.enter_returns_true
        )
        imgui.same_line()
        if (imgui.button("Open") or entered) and self._folder.strip():
            state.open(Path(self._folder.strip()).expanduser())
        if state.opening is not None:
            imgui.text_disabled("reading names and times ...")
        if state.error:
            draw_wrapped(state.error, error())

    def _draw_mode(self) -> None:
        state = self._state
        right_px = imgui.get_cursor_screen_pos().x + imgui.get_content_region_avail().x
        for mode in ComparisonMode:
            if mode is not ComparisonMode.OFF:
                _same_line_if_it_fits(mode, right_px)
            if imgui.radio_button(mode, state.mode is mode) and state.mode is not mode:
                state.toggle(mode)
        if state.mode is ComparisonMode.WIPE:
            _, state.wipe = draw_slider("line", state.wipe, 0.0, 1.0, "%.3f")
        elif state.mode is ComparisonMode.BLINK:
            _, state.blink_period_s = draw_slider("period", state.blink_period_s, 0.2, 5.0, "%.1f s")
        elif state.mode is ComparisonMode.DIFFERENCE:
            imgui.text_colored(_MORE, "real is brighter")
            imgui.same_line()
            imgui.text_colored(_LESS, "fainter")

    def _draw_images(self, images: RealImages, image: RealImage | None, utc_s: float) -> float | None:
        """Draw the list of images; return the time of another image if the user chose one."""
        chosen = None
        here = -1 if image is None else images.index(image)
        row_px = imgui.get_text_line_height_with_spacing()
        height_px = min(len(images), _LIST_ROWS) * row_px + 2 * imgui.get_style().window_padding.y
        imgui.begin_child("##images", ImVec2(0, height_px), imgui.ChildFlags_.borders)
        rows = imgui.ListClipper()
        rows.begin(len(images))
        while rows.step():
            for row in range(rows.display_start, rows.display_end):
                ahead_s = self._state.log_utc_s(images[row]) - utc_s
                clicked, _ = imgui.selectable(f"{_signed(ahead_s):>11}  {images[row].path.name}##{row}", row == here)
                chosen = row if clicked else chosen
        if image is not None and image is not self._listed:
            # The list scrolls when the play head reaches another image; otherwise it stays where the user scrolled it.
            imgui.set_scroll_from_pos_y(imgui.get_cursor_start_pos().y + (here + 0.5) * row_px - imgui.get_scroll_y())
            self._listed = image
        imgui.end_child()
        for label, step in (("< image", -1), ("image >", 1)):
            if imgui.button(label):
                chosen = (max(here, 0) + step) % len(images)
            imgui.same_line()
        imgui.text_disabled(f"{here + 1} of {len(images)}" if here >= 0 else f"{len(images)} images")
        if chosen is None:
            return None
        self._state.preferred = images[chosen]
        return self._state.log_utc_s(images[chosen])

    def _draw_clock(self) -> None:
        state = self._state
        imgui.separator_text("Camera clock - log clock")
        _, state.offset_s = imgui.input_double("s", state.offset_s, 0.01, 1.0, "%.3f")
        imgui.same_line()
        if imgui.button("0"):
            state.offset_s = 0.0
        imgui.set_next_item_width(-1)
        _, state.offset_s = draw_slider("##fine", state.offset_s, -_FINE_S, _FINE_S, "%+.3f s")
        imgui.text_disabled(f"[flight] time_offset_s = {round(state.ahead_s, 6):g}")
        references = list(TimeReference)
        _, chosen = imgui.combo("of exposure", references.index(state.time_reference), list(references))
        state.time_reference = references[chosen]
        imgui.set_item_tooltip("the instant of its exposure to which a real image's time stamp refers")
        _, state.match_exposure = imgui.checkbox("simulate its exposure time", state.match_exposure)

    def _draw_levels(self) -> None:
        state = self._state
        imgui.separator_text("Real image")
        _, state.real_black = draw_slider("black", state.real_black, 0.0, 0.5, "%.4f of white")
        _, state.real_gain = draw_slider("gain", state.real_gain, 1 / 16, 256.0, "x %.2f", logarithmic=True)


def _draw_image(image: RealImage, fitted: FittedImage | None, behind_s: float) -> None:
    time = image.time
    length = "" if time.exposure_s is None else f", {time.exposure_s:g} s long"
    draw_wrapped(f"{image.path.name}: {format_utc(time.utc_s)[:-4]}Z by {time.source}{length}")
    if abs(behind_s) >= 0.0005:
        imgui.text_disabled(f"{span(abs(behind_s))} {'before' if behind_s > 0 else 'after'} the play head")
    if fitted is None:
        imgui.text_disabled("decoding ...")
    elif fitted.note:
        draw_wrapped(fitted.note)


def _signed(seconds: float) -> str:
    return f"{'' if seconds < 0 else '+'}{span(seconds)}"


def _draw_problems(images: RealImages) -> None:
    count = len(images.problems)
    if count and imgui.tree_node(f"{count} file{'s' * (count > 1)} not usable###problems"):
        for problem in images.problems:
            imgui.bullet()
            draw_wrapped(problem, error())
        imgui.tree_pop()


def _same_line_if_it_fits(label: str, right_px: float) -> None:
    """Stay in this line if a radio button with this label fits."""
    style = imgui.get_style()
    needed_px = imgui.calc_text_size(label).x + imgui.get_frame_height() + style.item_inner_spacing.x
    if right_px - imgui.get_item_rect_max().x > needed_px + style.item_spacing.x:
        imgui.same_line()


class FitPanel:
    """Widgets for an `ImageFit`, drawn into the current imgui window."""

    def __init__(self) -> None:
        self._fits_time = self._fits_mount = True

    def draw(self, session: Session) -> None:
        """Draw the panel; start, stop and apply fits as the user does."""
        comparison = session.comparison
        if comparison.images is None or session.loaded is None or comparison.fit_images is None:
            return
        imgui.separator_text("Fit to the images")
        fit = comparison.fit
        if fit is not None and fit.running:
            imgui.progress_bar(fit.done / fit.of if fit.of else 0.0, ImVec2(-1, 0), f"{fit.done} of {fit.of} images")
            if imgui.button("Stop fitting"):
                fit.cancel()
            return
        about = "fits camera clock - log clock, as glstar compare --fit-time-offset"
        self._fits_time = draw_checkbox("camera clock", self._fits_time, about)
        imgui.same_line()
        about = "fits yaw, pitch and roll of the camera on the aircraft, as glstar compare --fit-mount"
        self._fits_mount = draw_checkbox("mount", self._fits_mount, about)
        imgui.begin_disabled(not (self._fits_time or self._fits_mount))
        if draw_button("Fit", "moves star trails onto those of up to 48 images; nothing changes until Apply"):
            self._start(session)
        imgui.end_disabled()
        if fit is not None and fit.error:
            draw_wrapped(fit.error, error())
        if fit is not None and fit.result is not None:
            self._draw_result(session, fit.result)

    def _start(self, session: Session) -> None:
        comparison, loaded = session.comparison, session.loaded
        assert comparison.images is not None
        assert loaded is not None
        assert comparison.fit_images is not None
        flight = replace(loaded.simulator.flight, time_offset_s=comparison.ahead_s)
        request = FitRequest(
            simulator=loaded.simulator.with_flight(flight),
            images=tuple(comparison.images),
            exposure=session.config.exposure.starting_at(0.0),
            reference=comparison.time_reference,
            own_length=comparison.match_exposure,
            fits_time=self._fits_time,
            fits_mount=self._fits_mount,
        )
        comparison.fit = ImageFit(request, comparison.fit_images)

    def _draw_result(self, session: Session, result: FitResult) -> None:
        for line in fit_report(result, session.comparison.ahead_s):
            draw_wrapped(line)
        if draw_button("Apply", "takes the clock and the mount; Ctrl+Z takes back the mount"):
            session.comparison.offset_s += result.clock_change_s or 0.0
            if result.mount_keys:
                session.change(**result.mount_keys)
            session.comparison.fit = None
        imgui.same_line()
        if imgui.button("Discard"):
            session.comparison.fit = None


def fit_report(result: FitResult, ahead_s: float) -> list[str]:
    """Return what a fit found, as lines; `ahead_s`: camera clock minus log clock before the fit, s."""
    lines = []
    if result.clock_change_s is not None:
        lines.append(
            f"camera clock - log clock {ahead_s + result.clock_change_s:+.4f} s, to {result.clock_std_s:.4f} s"
        )
    if result.mount_keys:
        angles = ", ".join(
            f"{key.removeprefix('mount.').removesuffix('_deg')} {angle:.3f}" for key, angle in result.mount_keys.items()
        )
        turn = ", ".join(f"{degrees(angle):+.3f}" for angle in result.turn_rad)
        lines += [f"mount {angles} deg", f"turned by {turn} deg, to {degrees(max(result.turn_std_rad)):.3f} deg"]
    lines.append(f"{result.images} of {result.of} images, {result.stars} stars")
    distance = f"mean {result.centroid_mean_px:.2f} px, median {result.centroid_median_px:.2f} px"
    return [*lines, f"distance of centroids: {distance}", *result.notes]


def residuals_of(session: Session) -> TrailResiduals | str | None:
    """Return the residuals of the real image shown, or why there are none.

    Returns None while they are measured, without a real image, and if they are not shown.
    """
    comparison, loaded = session.comparison, session.loaded
    if Overlay.RESIDUALS not in session.shown_overlays or loaded is None or comparison.residuals.measure is None:
        return None
    image = comparison.image_at(loaded.head.utc_s)
    if image is None:
        return None
    request = ResidualRequest(
        loaded.simulator,
        comparison.ahead_s,
        image,
        session.config.exposure.starting_at(0.0),
        comparison.time_reference,
        comparison.match_exposure,
    )
    return comparison.residuals.of(request)


def draw_residual_figures(session: Session) -> None:
    """Draw the switch of the residuals and their figures into the current imgui window."""
    if session.comparison.images is None or session.comparison.residuals.measure is None:
        return
    imgui.separator_text("Residuals")
    is_shown = Overlay.RESIDUALS in session.shown_overlays
    about = "measures each trail of the real image against the simulated one, as glstar compare"
    if draw_checkbox("arrows and figures", is_shown, about) != is_shown:
        session.shown_overlays ^= {Overlay.RESIDUALS}
    residuals = residuals_of(session)
    if isinstance(residuals, TrailResiduals):
        imgui.text_disabled(f"{len(residuals.shift_px)} of {residuals.predicted} trails found; simulated minus real")
        draw_rows("##residuals", residuals.figures)
    elif residuals is not None:
        draw_wrapped(residuals, error())
    elif session.comparison.residuals.is_running:
        imgui.text_disabled("measuring ...")
