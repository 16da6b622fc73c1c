"""The display panel: stretch, colours and histogram, which change the screen and never the data."""

from dataclasses import replace
from typing import Any

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot
from numpy.typing import NDArray

from glstar.viewer.picture.view import ColourMap, Histogram, Stretch, StretchKind
from glstar.viewer.session.actions import fit_stretch, perform
from glstar.viewer.session.keys import Action
from glstar.viewer.session.state import Session
from glstar.viewer.ui.theme import accent, draw_button, draw_checkbox, draw_choice, draw_slider, scaled

# Width of the controls, of the panel's.
_WIDTH = 0.55
_PLOT_HEIGHT_PX = 130.0
# Distance of the name of a level from its line, screen px.
_BESIDE_PX = 5.0
# Smallest share of the pixels that the histogram shows.
_LEAST_FRACTION = 1e-6
_PLOT = int(implot.Flags_.no_menus | implot.Flags_.no_mouse_text | implot.Flags_.no_box_select)
_PLOT_OF_ONE = _PLOT | int(implot.Flags_.no_legend)
# Colours of the histograms of the simulated and the real image, and of the limits, by day and in night mode.
_SIMULATED = (ImVec4(0.56, 0.72, 0.93, 0.9), ImVec4(0.8, 0.0, 0.0, 0.9))
_REAL = (ImVec4(0.93, 0.68, 0.35, 0.9), ImVec4(0.5, 0.0, 0.0, 0.9))
_BLACK_HANDLE, _WHITE_HANDLE = 1, 2


class DisplayPanel:
    """Draws the settings of the display."""

    def __init__(self) -> None:
        self._counted: dict[str, tuple[NDArray[Any], Histogram]] = {}
        # The levels shown black and white to which the axis was fitted.
        self._limits: tuple[float, float] | None = None

    def draw(self, session: Session) -> None:
        """Draw the settings of the display."""
        imgui.push_item_width(imgui.get_content_region_avail().x * _WIDTH)
        self._draw_histogram(session)
        _draw_stretch(session)
        changed, limit = draw_slider("Star names to", session.name_vmag_limit, -1.5, 7.0, "V %.1f")
        imgui.set_item_tooltip("Faintest star whose name is written, V magnitude")
        if changed:
            session.name_vmag_limit = limit
        tooltip = (
            "The image as [output] writes it: defects, black level, colours, tone curve (Shift+P);"
            "\nstretch and colour map do not change it"
        )
        if draw_checkbox("Processed image", session.shows_processed, tooltip) != session.shows_processed:
            perform(Action.PROCESSED, session)
        tooltip = (
            "Borders of the image's own pixels, when it is magnified 8 times or more;"
            "\nfrom 40 times on their digital numbers (J)"
        )
        session.view.pixel_grid = draw_checkbox("Pixel grid", session.view.pixel_grid, tooltip)
        imgui.pop_item_width()

    def _draw_histogram(self, session: Session) -> None:
        """Draw the histograms of the images, with handles for the levels shown black and white."""
        size = ImVec2(-1, scaled(_PLOT_HEIGHT_PX))
        limits = session.stretch.black, session.stretch.white
        if limits != self._limits and not imgui.is_mouse_down(0):
            # A key has moved black or white, perhaps out of the levels shown; a drag leaves the axis as it is.
            self._limits = limits
            implot.set_next_axis_to_fit(int(implot.ImAxis_.x1))
        if not implot.begin_plot("##histogram", size, _PLOT if session.real else _PLOT_OF_ONE):
            return
        implot.setup_axes("DN", "", 0, int(implot.AxisFlags_.no_decorations | implot.AxisFlags_.auto_fit))
        implot.setup_axis_scale(int(implot.ImAxis_.y1), int(implot.Scale_.log10))
        white_dn = _white_dn(session)
        real = session.real
        shown = {} if real is None else {"real": (real[1].pixels, white_dn / real[1].white_dn)}
        # While the flight plays, the latest histogram stays: pixels would have to be read from the GPU in every frame.
        pixels = None if session.is_playing else session.image.pixels
        if pixels is not None:
            shown["simulated"] = pixels, 1.0
        elif "simulated" in self._counted:
            shown["simulated"] = self._counted["simulated"][0], 1.0
        for label, (counted, scale) in shown.items():
            histogram = self._histogram(label, counted)
            colour = (_SIMULATED if label == "simulated" else _REAL)[session.night]
            style = implot.Spec(line_color=colour, fill_color=colour, fill_alpha=0.35)
            fraction = np.maximum(histogram.fraction, _LEAST_FRACTION)
            implot.plot_shaded(label, histogram.level_dn * scale, fraction, _LEAST_FRACTION, style)
            implot.plot_line(label, histogram.level_dn * scale, fraction, style)
        _drag_limits(session, white_dn)
        implot.end_plot()

    def _histogram(self, label: str, pixels: NDArray[Any]) -> Histogram:
        counted = self._counted.get(label)
        if counted is None or counted[0] is not pixels:
            counted = self._counted[label] = pixels, Histogram.of(pixels)
        return counted[1]


def _white_dn(session: Session) -> int:
    """Return the largest digital number of images with the present settings."""
    return session.config.exposure.signal_factor * session.config.sensor().saturation_dn


def _drag_limits(session: Session, white_dn: int) -> None:
    """Draw the levels shown black and white as lines that can be dragged."""
    stretch, colour = session.stretch, accent()
    black_dn, shown_white_dn = stretch.black * white_dn, stretch.white * white_dn
    black_moved = implot.drag_line_x(_BLACK_HANDLE, black_dn, colour, 1.5)
    white_moved = implot.drag_line_x(_WHITE_HANDLE, shown_white_dn, colour, 1.5)
    # Beside the upper ends of the lines, in two rows: tags at the axis would cover its numbers and each other.
    for row, (text, level_dn) in enumerate((("black", black_dn), ("white", shown_white_dn))):
        _write_beside(text, level_dn, row)
    if black_moved[0] or white_moved[0]:
        session.stretch = stretch.between(max(black_moved[1], 0.0) / white_dn, white_moved[1] / white_dn)


def _write_beside(text: str, level_dn: float, row: int) -> None:
    """Write a text beside the line at a level, inside the plot; `row`: from the top, 0 or 1."""
    corner, size_px, text_px = implot.get_plot_pos(), implot.get_plot_size(), imgui.calc_text_size(text)
    x = implot.plot_to_pixels(level_dn, 1.0).x + _BESIDE_PX
    if x + text_px.x > corner.x + size_px.x:
        x -= text_px.x + 2 * _BESIDE_PX
    if corner.x <= x <= corner.x + size_px.x - text_px.x:
        colour = imgui.get_color_u32(imgui.Col_.text)
        implot.get_plot_draw_list().add_text(ImVec2(x, corner.y + 2 + row * text_px.y), colour, text)


def _draw_stretch(session: Session) -> None:
    stretch = session.stretch
    white_dn = _white_dn(session)
    if draw_button("Auto", "Fit black and white to the image: the sky is dark, and faint stars can be seen (Shift+A)"):
        fit_stretch(session)
        stretch = session.stretch
    imgui.same_line()
    if draw_button("Reset##stretch", "The stretch that suits the sensor, as at the start"):
        stretch = Stretch.for_sensor(session.config.sensor())
        session.follow_image()
    imgui.same_line()
    tooltip = "Keep black and white as they are; otherwise they follow the image, so that the sky is dark"
    if draw_checkbox("Hold", stretch.held, tooltip) != stretch.held:
        stretch = replace(stretch, held=not stretch.held)
        session.follow_image()
    imgui.same_line()
    is_asinh = stretch.kind is StretchKind.ASINH
    if draw_checkbox("Asinh", is_asinh, "Brightens faint signals without clipping bright ones (I)") != is_asinh:
        stretch = stretch.other_kind()
    if name := draw_choice("Colours", stretch.colours, dict.fromkeys(ColourMap, ""), stretch.colours):
        stretch = replace(stretch, colours=ColourMap(name))
    imgui.set_item_tooltip("Colour map of the brightness (Shift+C for the next); night vision stays red")
    highest = max(1024.0, 4.0 * white_dn)
    changed, boost = draw_slider("Boost", stretch.boost, 0.125, highest, "x%.2f", logarithmic=True)
    imgui.set_item_tooltip("Gain of the display, as of a longer exposure (Up, Down)")
    if changed:
        stretch = replace(stretch, boost=boost, held=True)
    changed, black_dn = draw_slider("Black", stretch.black * white_dn, 0.0, white_dn / 4, "%.1f DN", logarithmic=True)
    imgui.set_item_tooltip("Level shown black, DN")
    if changed:
        stretch = replace(stretch, black=black_dn / white_dn, held=True)
    session.stretch = stretch
