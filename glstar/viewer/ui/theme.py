"""Colours, fonts, sizes and small widgets that all panels and dialogs of the window share.

The window is dark, or red by night to preserve dark adaptation.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import log10
from pathlib import Path

import imgui_bundle
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from glstar.sky.air.skybrightness import LIGHT_LEVELS

Rgba = tuple[float, float, float, float]

FONT_PX = 15.0

_ACCENT: Rgba = (0.42, 0.66, 0.93, 1.0)
_MUTED: Rgba = (0.55, 0.58, 0.63, 1.0)
_ERROR: Rgba = (1.0, 0.55, 0.45, 1.0)

_SURFACE: Rgba = (0.086, 0.094, 0.110, 1.0)
_RAISED: Rgba = (0.125, 0.137, 0.161, 1.0)
_DEEP: Rgba = (0.055, 0.060, 0.072, 1.0)
_TEXT: Rgba = (0.86, 0.88, 0.91, 1.0)

_COLOURS: dict[str, Rgba] = {
    "text": _TEXT,
    "text_disabled": _MUTED,
    "window_bg": _SURFACE,
    "child_bg": (0.0, 0.0, 0.0, 0.0),
    "popup_bg": (0.10, 0.11, 0.13, 0.98),
    "border": (0.20, 0.22, 0.26, 0.6),
    "frame_bg": _RAISED,
    "frame_bg_hovered": (0.17, 0.19, 0.23, 1.0),
    "frame_bg_active": (0.20, 0.23, 0.28, 1.0),
    "title_bg": _DEEP,
    "title_bg_active": _DEEP,
    "title_bg_collapsed": _DEEP,
    "menu_bar_bg": _DEEP,
    "scrollbar_bg": (0.0, 0.0, 0.0, 0.0),
    "scrollbar_grab": (0.22, 0.24, 0.29, 1.0),
    "check_mark": _ACCENT,
    "slider_grab": (0.36, 0.55, 0.78, 1.0),
    "slider_grab_active": _ACCENT,
    "button": _RAISED,
    "button_hovered": (0.19, 0.25, 0.33, 1.0),
    "button_active": (0.24, 0.36, 0.50, 1.0),
    "header": (0.14, 0.17, 0.21, 1.0),
    "header_hovered": (0.18, 0.23, 0.30, 1.0),
    "header_active": (0.22, 0.31, 0.42, 1.0),
    "separator": (0.18, 0.20, 0.24, 1.0),
    "separator_hovered": (0.30, 0.42, 0.58, 1.0),
    "separator_active": _ACCENT,
    "resize_grip": (0.0, 0.0, 0.0, 0.0),
    "tab": _DEEP,
    "tab_hovered": (0.18, 0.23, 0.30, 1.0),
    "tab_selected": _SURFACE,
    "tab_selected_overline": _ACCENT,
    "tab_dimmed": _DEEP,
    "tab_dimmed_selected": _SURFACE,
    "docking_preview": (0.42, 0.66, 0.93, 0.5),
    "plot_histogram": (0.36, 0.55, 0.78, 1.0),
    "table_header_bg": _DEEP,
    "table_border_strong": (0.18, 0.20, 0.24, 1.0),
    "table_border_light": (0.14, 0.16, 0.19, 1.0),
    "table_row_bg_alt": (1.0, 1.0, 1.0, 0.02),
    "text_link": _ACCENT,
    "unsaved_marker": _ERROR,
    "text_selected_bg": (0.24, 0.36, 0.50, 1.0),
    "nav_cursor": _ACCENT,
    "modal_window_dim_bg": (0.0, 0.0, 0.0, 0.45),
}

# Flags of a window of its own: it is not docked, and its position is not stored.
DIALOG = int(imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_collapse | imgui.WindowFlags_.no_saved_settings)
# For `imgui.is_popup_open`: menus and dialogs of any name.
ANY_POPUP = int(imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level)
# Margin that a dialog leaves free in the window on each side, and above and below, px.
_DIALOG_MARGIN_PX = (20.0, 30.0)
# Width of the buttons that end a dialog, px.
_BUTTON_PX = 90.0
# Height of the bar of a slider, and half the width of its end, screen px.
_BAR_PX = 2.5
# Smallest and largest text, tenths of its first size.
_TEXT_TENTHS = (7, 25)


def accent() -> ImVec4:
    """Return the colour of highlights."""
    return imgui.get_style_color_vec4(imgui.Col_.text_link)


def error() -> ImVec4:
    """Return the colour of errors."""
    return imgui.get_style_color_vec4(imgui.Col_.unsaved_marker)


def load_font(scale: float = 1.0) -> None:
    """Load the font; called once after the imgui context has been made.

    `scale`: of the screen: 2 if it has twice the pixels.
    """
    style = imgui.get_style()
    style.font_size_base = FONT_PX
    style.font_scale_dpi = scale
    font = Path(imgui_bundle.__file__).parent / "assets" / "fonts" / "Roboto" / "Roboto-Regular.ttf"
    if font.is_file():
        imgui.get_io().fonts.add_font_from_file_ttf(str(font), FONT_PX)


def resized_text(scale: float, steps: int) -> float:
    """Return a size of the text from 0.7 to 2.5; `scale`: the present one; `steps`: in tenths; negative ones shrink."""
    return min(max(round(10 * scale) + steps, _TEXT_TENTHS[0]), _TEXT_TENTHS[1]) / 10


def scaled(px: float) -> float:
    """Return a length in px of this screen: it grows with the resolution of the screen and with the text.

    `px`: the length on a usual screen with text of the first size.
    """
    style = imgui.get_style()
    return float(px * style.font_scale_dpi * style.font_scale_main)


def scaled_across(px: float) -> float:
    """Return a width on this screen as `scaled` does, at most as wide as a dialog can be in the window."""
    return min(scaled(px), imgui.get_main_viewport().size.x - 2 * _DIALOG_MARGIN_PX[0])


def button_size() -> ImVec2:
    """Return the size of the buttons that end a dialog, on this screen."""
    return ImVec2(scaled(_BUTTON_PX), 0.0)


def dialog_size(width_px: float, height_px: float) -> ImVec2:
    """Return the size of a dialog on this screen, which leaves a margin of the window around it.

    `width_px`, `height_px`: on a usual screen with text of the first size.
    """
    free_px = imgui.get_main_viewport().size.y - 2 * _DIALOG_MARGIN_PX[1]
    return ImVec2(scaled_across(width_px), min(scaled(height_px), free_px))


def apply_theme(*, night: bool) -> None:
    """Colour the interface; `night`: whether to use shades of red only."""
    style = imgui.get_style()
    imgui.style_colors_dark(style)
    for name, colour in _COLOURS.items():
        if hasattr(imgui.Col_, name):
            style.set_color_(int(getattr(imgui.Col_, name)), colour)
    style.window_rounding = style.child_rounding = 4.0
    style.frame_rounding = style.grab_rounding = style.tab_rounding = style.popup_rounding = 4.0
    style.window_border_size = style.popup_border_size = 1.0
    style.frame_border_size = 0.0
    style.window_padding = ImVec2(10.0, 8.0)
    style.frame_padding = ImVec2(8.0, 4.0)
    style.item_spacing = ImVec2(8.0, 6.0)
    style.scrollbar_size = 11.0
    style.docking_separator_size = 2.0
    style.window_menu_button_position = imgui.Dir.none
    if night:
        for index in range(int(imgui.Col_.count)):
            red, green, blue, opacity = style.color_(index)
            style.set_color_(index, (max(red, green, blue) * 0.8, 0.0, 0.0, opacity))
    implot.style_colors_auto()
    # The window has their colour already; filling two plots takes a fifth of a frame on software OpenGL.
    for background in (implot.Col_.frame_bg, implot.Col_.plot_bg):
        implot.get_style().set_color_(int(background), (0.0, 0.0, 0.0, 0.0))


def centre_next_window() -> None:
    """Let the next window appear in the middle of the viewport."""
    centre = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(centre, int(imgui.Cond_.appearing), ImVec2(0.5, 0.5))


def draw_wrapped(text: str, colour: ImVec4 | None = None, *, wrap_px: float = 0.0) -> None:
    """Write text, which may contain percent signs, wrapped at a distance from the window's left edge.

    `colour`: by default that of text; `wrap_px`: 0 for the window's right edge.
    """
    imgui.push_text_wrap_pos(wrap_px)
    imgui.push_style_color(int(imgui.Col_.text), colour or imgui.get_style_color_vec4(int(imgui.Col_.text)))
    imgui.text_unformatted(text)
    imgui.pop_style_color()
    imgui.pop_text_wrap_pos()


def draw_rows(name: str, rows: Iterable[tuple[str, str]]) -> None:
    """Draw a table of labels and values; `name`: its identity, such as ``"##state"``."""
    if not imgui.begin_table(name, 2, int(imgui.TableFlags_.sizing_fixed_fit)):
        return
    imgui.table_setup_column("label")
    imgui.table_setup_column("value", int(imgui.TableColumnFlags_.width_stretch))
    for label, value in rows:
        imgui.table_next_column()
        imgui.text_disabled(label)
        imgui.table_next_column()
        imgui.text_wrapped(value)
    imgui.end_table()


def draw_choice(label: str, shown: str, choices: Mapping[str, str], present: str | None) -> str | None:
    """Draw a list that opens below a control, and return the name that the user has chosen in this frame.

    `shown`: text of the control; `choices`: tooltips by name; empty for none; `present`: the name chosen before.
    """
    chosen = None
    if imgui.begin_combo(label, shown):
        for name, tooltip in choices.items():
            if imgui.selectable(name, name == present)[0]:
                chosen = name
            if tooltip:
                imgui.set_item_tooltip(tooltip)
        imgui.end_combo()
    return chosen


def draw_slider(
    label: str, value: float, lowest: float, highest: float, form: str, *, logarithmic: bool = False
) -> tuple[bool, float]:
    """Draw a slider whose knob is a bar below its number, which stays readable.

    `form`: of the number, such as ``"%.2f s"``; ``"%d"`` for whole numbers.  Returns whether the user has changed the
    value in this frame, and the value.
    """
    flags = int(imgui.SliderFlags_.logarithmic) if logarithmic else 0
    width_px = imgui.calc_item_width()
    for knob in (imgui.Col_.slider_grab, imgui.Col_.slider_grab_active):
        imgui.push_style_color(int(knob), (0.0, 0.0, 0.0, 0.0))
    changed: bool
    new: float
    if form == "%d":
        changed, new = imgui.slider_int(label, int(value), int(lowest), int(highest), form, flags)
    else:
        changed, new = imgui.slider_float(label, value, lowest, highest, form, flags)
    imgui.pop_style_color(2)
    corner, bottom = imgui.get_item_rect_min(), imgui.get_item_rect_min().y + imgui.get_frame_height()
    grab_px = imgui.get_style().grab_min_size
    x = (
        corner.x
        + 2
        + grab_px / 2
        + _slider_fraction(new, lowest, highest, form, logarithmic=logarithmic) * (width_px - 4 - grab_px)
    )
    colour = imgui.get_color_u32(imgui.Col_.slider_grab_active if imgui.is_item_active() else imgui.Col_.slider_grab)
    draw_list = imgui.get_window_draw_list()
    draw_list.add_rect_filled(ImVec2(corner.x + 2, bottom - _BAR_PX), ImVec2(x, bottom), colour, 1.0)
    draw_list.add_rect_filled(ImVec2(x - _BAR_PX, bottom - 2 * _BAR_PX), ImVec2(x + _BAR_PX, bottom), colour, 1.0)
    return changed, new


def _slider_fraction(value: float, lowest: float, highest: float, form: str, *, logarithmic: bool) -> float:
    """Return where a value is on its slider, 0 to 1; a logarithmic one begins at the last digit shown if it has 0."""
    if logarithmic:
        digits = form.partition(".")[2][:1]
        least = 0.1 ** int(digits) if digits.isdigit() else 1.0
        value, lowest, highest = (log10(max(each, lowest or least)) for each in (value, lowest, highest))
    return min(max((value - lowest) / (highest - lowest), 0.0), 1.0)


def draw_button(label: str, tooltip: str) -> bool:
    """Draw a button with a tooltip; return whether it was pressed."""
    is_pressed = imgui.button(label)
    imgui.set_item_tooltip(tooltip)
    return is_pressed


def draw_checkbox(label: str, is_on: bool, tooltip: str) -> bool:
    """Draw a checkbox with a tooltip; return whether it is on now."""
    _, now_on = imgui.checkbox(label, is_on)
    imgui.set_item_tooltip(tooltip)
    return now_on


# Plain numbers, because enumerations of imgui-bundle are slow to combine in every frame.
_BEHIND = int(implot.ItemFlags_.no_legend | implot.ItemFlags_.no_fit)
_NO_MARKER = int(implot.Marker_.none)
_DOWN, _UP, _SQUARE = (int(each) for each in (implot.Marker_.down, implot.Marker_.up, implot.Marker_.square))
_MARK_PX = 3.0
# Opacity of the curves of other logs.
_FAINT = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """The styles of the timeline."""

    lines: tuple[implot.Spec, ...]  # Roll, pitch and yaw, and the rates about their axes
    faint: tuple[implot.Spec, ...]  # The same of other logs
    gap: implot.Spec
    part: implot.Spec  # Between the in and out points
    exposures: implot.Spec
    shown: implot.Spec  # The exposure shown, and the same if it touches a gap
    missing: implot.Spec
    marker: implot.Spec
    head: implot.Spec  # The play head
    mode: implot.Spec  # Flight modes
    message: implot.Spec
    trigger: implot.Spec  # Triggers of the camera
    image: implot.Spec  # Times of real images
    light: dict[str, implot.Spec]  # Day and twilight, by the names of `LIGHT_LEVELS`


def _line(colour: Rgba, *, weight: float = 1.0, flags: int = _BEHIND) -> implot.Spec:
    return implot.Spec(line_color=colour, line_weight=weight, marker=_NO_MARKER, flags=flags)


def _mark(colour: Rgba, marker: int) -> implot.Spec:
    return implot.Spec(
        marker=marker, marker_size=_MARK_PX, marker_fill_color=colour, marker_line_color=colour, flags=_BEHIND
    )


def _fill(colour: Rgba) -> implot.Spec:
    clear = (0.0, 0.0, 0.0, 0.0)
    return implot.Spec(line_color=clear, fill_color=colour, marker=_NO_MARKER, flags=_BEHIND)


def _lines(*colours: Rgba, opacity: float = 1.0) -> tuple[implot.Spec, ...]:
    return tuple(_line((*colour[:3], opacity), flags=0) for colour in colours)


def _light(*colours: Rgba) -> dict[str, implot.Spec]:
    return {name: _fill(colour) for (name, _), colour in zip(LIGHT_LEVELS, colours, strict=False)}


_DAY_LINES: tuple[Rgba, ...] = ((1.0, 0.45, 0.35, 1.0), (0.45, 0.85, 0.45, 1.0), (0.45, 0.65, 1.0, 1.0))
_NIGHT_LINES: tuple[Rgba, ...] = ((1.0, 0.0, 0.0, 1.0), (0.75, 0.0, 0.0, 1.0), (0.55, 0.0, 0.0, 1.0))

DAY_PALETTE = Palette(
    lines=_lines(*_DAY_LINES),
    faint=_lines(*_DAY_LINES, opacity=_FAINT),
    gap=_fill((0.75, 0.2, 0.2, 0.35)),
    part=_fill((0.3, 0.7, 1.0, 0.14)),
    exposures=_fill((1.0, 1.0, 1.0, 0.10)),
    shown=_fill((1.0, 0.85, 0.3, 0.40)),
    missing=_fill((1.0, 0.2, 0.2, 0.60)),
    marker=_line((0.9, 0.5, 1.0, 0.9), weight=2.0),
    head=_line((1.0, 0.85, 0.3, 1.0), weight=2.0),
    mode=_line((0.85, 0.87, 0.9, 0.45)),
    message=_mark((0.55, 0.85, 0.9, 0.9), _DOWN),
    trigger=_mark((1.0, 0.6, 0.3, 0.9), _UP),
    image=_mark((0.95, 0.95, 0.95, 0.9), _SQUARE),
    light=_light((1.0, 0.95, 0.65, 0.26), (1.0, 0.65, 0.35, 0.22), (0.45, 0.50, 1.0, 0.20), (0.35, 0.40, 0.9, 0.11)),
)
NIGHT_PALETTE = Palette(
    lines=_lines(*_NIGHT_LINES),
    faint=_lines(*_NIGHT_LINES, opacity=_FAINT),
    gap=_fill((0.6, 0.0, 0.0, 0.35)),
    part=_fill((1.0, 0.0, 0.0, 0.16)),
    exposures=_fill((1.0, 0.0, 0.0, 0.12)),
    shown=_fill((1.0, 0.0, 0.0, 0.40)),
    missing=_fill((1.0, 0.0, 0.0, 0.75)),
    marker=_line((0.8, 0.0, 0.0, 0.9), weight=2.0),
    head=_line((1.0, 0.0, 0.0, 1.0), weight=2.0),
    mode=_line((0.7, 0.0, 0.0, 0.6)),
    message=_mark((0.8, 0.0, 0.0, 0.9), _DOWN),
    trigger=_mark((1.0, 0.0, 0.0, 0.9), _UP),
    image=_mark((0.6, 0.0, 0.0, 0.9), _SQUARE),
    light=_light(*((1.0, 0.0, 0.0, opacity) for opacity in (0.26, 0.19, 0.13, 0.07))),
)
