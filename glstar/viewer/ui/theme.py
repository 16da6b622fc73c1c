"""Colours and fonts of the window: dark, or red by night to preserve dark adaptation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import imgui_bundle
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from glstar.sky.air.skybrightness import LIGHT_LEVELS

Rgba = tuple[float, float, float, float]

FONT_PX: Final = 15.0

_ACCENT: Final[Rgba] = (0.42, 0.66, 0.93, 1.0)
_MUTED: Final[Rgba] = (0.55, 0.58, 0.63, 1.0)
_ERROR: Final[Rgba] = (1.0, 0.55, 0.45, 1.0)

_SURFACE: Final[Rgba] = (0.086, 0.094, 0.110, 1.0)
_RAISED: Final[Rgba] = (0.125, 0.137, 0.161, 1.0)
_DEEP: Final[Rgba] = (0.055, 0.060, 0.072, 1.0)
_TEXT: Final[Rgba] = (0.86, 0.88, 0.91, 1.0)

_COLOURS: Final[dict[str, Rgba]] = {
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

# Of the window that a dialog leaves free on each side, and above and below, px.
_DIALOG_MARGIN_PX: Final = (20.0, 30.0)
# Width of the buttons that end a dialog, px.
_BUTTON_PX: Final = 90.0
# Smallest and largest text, tenths of its first size.
_TEXT_TENTHS: Final = (7, 25)


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
    """Return a size of the text.

    `scale`: the present one; 1 at first; `steps`: steps of a tenth; negative ones shrink.  Returns: 0.7 to 2.5.
    """
    return min(max(round(10 * scale) + steps, _TEXT_TENTHS[0]), _TEXT_TENTHS[1]) / 10


def scaled(px: float) -> float:
    """Return a length on this screen: it grows with the resolution of the screen and with the text.

    `px`: the length on a usual screen with text of the first size.  Returns: px of this screen.
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


# Plain numbers, because enumerations of imgui-bundle are slow to combine in every frame.
_BEHIND: Final = int(implot.ItemFlags_.no_legend | implot.ItemFlags_.no_fit)
_NO_MARKER: Final = int(implot.Marker_.none)
_DOWN, _UP, _SQUARE = (int(each) for each in (implot.Marker_.down, implot.Marker_.up, implot.Marker_.square))
_MARK_PX: Final = 3.0


class Palette:
    """The colours of the timeline.

    `lines`: of roll, pitch and yaw, and of the rates about their axes; `gap`, `part`, `exposures`, `shown`, `missing`,
    `marker`, `head`: of gaps, the part between the in and out points, exposures, the exposure shown, the same if it
    touches a gap, markers, and the play head; `mode`, `message`, `trigger`, `image`: of flight modes, messages,
    triggers of the camera and times of real images; `light`: of day and of civil, nautical and astronomical twilight.
    """

    def __init__(
        self,
        lines: tuple[Rgba, Rgba, Rgba],
        gap: Rgba,
        part: Rgba,
        exposures: Rgba,
        shown: Rgba,
        missing: Rgba,
        marker: Rgba,
        head: Rgba,
        mode: Rgba,
        message: Rgba,
        trigger: Rgba,
        image: Rgba,
        light: Sequence[Rgba],
    ) -> None:
        self.lines, self.line_colours = [_line(colour, flags=0) for colour in lines], lines
        self.gap, self.part, self.exposures = _fill(gap), _fill(part), _fill(exposures)
        self.shown, self.missing = _fill(shown), _fill(missing)
        self.marker, self.head = _line(marker, weight=2.0), _line(head, weight=2.0)
        self.mode = _line(mode)
        self.message, self.trigger, self.image = _mark(message, _DOWN), _mark(trigger, _UP), _mark(image, _SQUARE)
        names = (name for name, _ in LIGHT_LEVELS)
        self.light = dict(zip(names, map(_fill, light), strict=False))


def _line(colour: Rgba, *, weight: float = 1.0, flags: int = _BEHIND) -> implot.Spec:
    return implot.Spec(line_color=colour, line_weight=weight, marker=_NO_MARKER, flags=flags)


def _mark(colour: Rgba, marker: int) -> implot.Spec:
    return implot.Spec(
        marker=marker, marker_size=_MARK_PX, marker_fill_color=colour, marker_line_color=colour, flags=_BEHIND
    )


def _fill(colour: Rgba) -> implot.Spec:
    clear = (0.0, 0.0, 0.0, 0.0)
    return implot.Spec(line_color=clear, fill_color=colour, marker=_NO_MARKER, flags=_BEHIND)


DAY_PALETTE: Final = Palette(
    lines=((1.0, 0.45, 0.35, 1.0), (0.45, 0.85, 0.45, 1.0), (0.45, 0.65, 1.0, 1.0)),
    gap=(0.75, 0.2, 0.2, 0.35),
    part=(0.3, 0.7, 1.0, 0.14),
    exposures=(1.0, 1.0, 1.0, 0.10),
    shown=(1.0, 0.85, 0.3, 0.40),
    missing=(1.0, 0.2, 0.2, 0.60),
    marker=(0.9, 0.5, 1.0, 0.9),
    head=(1.0, 0.85, 0.3, 1.0),
    mode=(0.85, 0.87, 0.9, 0.45),
    message=(0.55, 0.85, 0.9, 0.9),
    trigger=(1.0, 0.6, 0.3, 0.9),
    image=(0.95, 0.95, 0.95, 0.9),
    light=((1.0, 0.95, 0.65, 0.26), (1.0, 0.65, 0.35, 0.22), (0.45, 0.50, 1.0, 0.20), (0.35, 0.40, 0.9, 0.11)),
)
NIGHT_PALETTE: Final = Palette(
    lines=((1.0, 0.0, 0.0, 1.0), (0.75, 0.0, 0.0, 1.0), (0.55, 0.0, 0.0, 1.0)),
    gap=(0.6, 0.0, 0.0, 0.35),
    part=(1.0, 0.0, 0.0, 0.16),
    exposures=(1.0, 0.0, 0.0, 0.12),
    shown=(1.0, 0.0, 0.0, 0.40),
    missing=(1.0, 0.0, 0.0, 0.75),
    marker=(0.8, 0.0, 0.0, 0.9),
    head=(1.0, 0.0, 0.0, 1.0),
    mode=(0.7, 0.0, 0.0, 0.6),
    message=(0.8, 0.0, 0.0, 0.9),
    trigger=(1.0, 0.0, 0.0, 0.9),
    image=(0.6, 0.0, 0.0, 0.9),
    light=tuple((1.0, 0.0, 0.0, opacity) for opacity in (0.26, 0.19, 0.13, 0.07)),
)
