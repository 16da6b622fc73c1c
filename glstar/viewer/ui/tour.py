"""The tour of the window: six steps, each beside the panel that it is about."""

from typing import Final, NamedTuple

from imgui_bundle import ImVec2, imgui

from glstar.viewer.keys import shown_chord
from glstar.viewer.session import Session
from glstar.viewer.ui.theme import accent, scaled_across

__all__ = ["STEPS", "Tour"]

_TITLE: Final = "Tour"
_WIDTH_PX: Final = 260.0
# At the right edge, where it covers the ends of the panels only, above the notifications: its lower edge in the window.
_MARGIN_PX: Final = 12.0
_LOWEST_FRACTION: Final = 0.82
_FLAGS: Final = int(
    imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_collapse
    | imgui.WindowFlags_.always_auto_resize
)


class _Step(NamedTuple):
    """A step of the tour; keys are written as ``{Ctrl+O}``."""

    title: str
    text: str
    panel: str


STEPS: Final = (
    _Step(
        "Open a flight",
        "Drop a log onto the window, open one ({Ctrl+O}), connect to an aircraft ({Ctrl+L}) or take the bundled"
        " flight. A log without UTC or place asks for them.",
        "Image",
    ),
    _Step(
        "Play it",
        "{Space} plays and pauses, the arrow keys go from exposure to exposure. Click on the timeline or drag the play"
        " head; type a time into its field. The wheel zooms the timeline.",
        "Time",
    ),
    _Step(
        "Look at the sky",
        "The wheel zooms, dragging moves, {0} shows the whole image. Click on a star to learn all about it; {Ctrl+F}"
        " finds stars, constellations and planets.",
        "Image",
    ),
    _Step(
        "Change the camera",
        "Each setting of exposure, camera and sensor shows at once. Rest the mouse on one to read what it does and its"
        " key in the TOML file; a right click gives it its default, {Ctrl+Z} takes a change back.",
        "Settings",
    ),
    _Step(
        "Change the display",
        "{Shift+A} makes faint stars visible, overlays name and mark what there is, {N} protects night vision."
        " None of it changes the data.",
        "View",
    ),
    _Step(
        "Keep what you see",
        "{Ctrl+S} saves the frame with its exact truth, {Ctrl+E} a range of frames, {Shift+S} the picture, {Ctrl+R} a"
        " video. {Ctrl+P} searches all commands, {F1} lists the keys, {Shift+F1} opens the manual.",
        "Image",
    ),
)


class Tour:
    """A window of its own that leads through the panels, which can be used meanwhile.

    Attributes
    ----------
    step : int or None
        The step shown, from 0; None while the tour is not shown.
    """

    def __init__(self) -> None:
        self.step: int | None = None

    def ask(self, _: Session | None = None) -> None:
        """Show the first step."""
        self.step = 0

    def draw(self) -> None:
        """Draw the step, if the tour is shown."""
        if self.step is None:
            return
        step = STEPS[self.step]
        _mark(step.panel)
        viewport = imgui.get_main_viewport()
        corner = ImVec2(
            viewport.pos.x + viewport.size.x - _MARGIN_PX, viewport.pos.y + _LOWEST_FRACTION * viewport.size.y
        )
        imgui.set_next_window_pos(corner, int(imgui.Cond_.appearing), ImVec2(1.0, 1.0))
        shown, is_open = imgui.begin(_TITLE, True, _FLAGS)
        if shown:
            imgui.text_colored(accent(), f"{self.step + 1} of {len(STEPS)}: {step.title}")
            _draw_text(step.text, scaled_across(_WIDTH_PX))
            self._draw_buttons()
        imgui.end()
        if not is_open:
            self.step = None

    def _draw_buttons(self) -> None:
        assert self.step is not None
        step, is_last = self.step, self.step == len(STEPS) - 1
        if imgui.button("Done" if is_last else "Next"):
            self.step = None if is_last else step + 1
        imgui.same_line()
        imgui.begin_disabled(step == 0)
        if imgui.button("Back"):
            self.step = step - 1
        imgui.end_disabled()
        if not is_last:
            imgui.same_line()
            if imgui.button("Skip the tour"):
                self.step = None
            imgui.set_item_tooltip("Help, Tour shows it again")


def _draw_text(text: str, width_px: float) -> None:
    """Draw the text of a step, with room for the longest: the buttons stay where they are from step to step."""
    wrap_px = width_px - imgui.get_cursor_pos().x
    highest_px = max(imgui.calc_text_size(_with_keys(step.text), wrap_width=wrap_px).y for step in STEPS)
    imgui.push_text_wrap_pos(width_px)
    imgui.text_unformatted(_with_keys(text))
    imgui.pop_text_wrap_pos()
    imgui.dummy(ImVec2(0.0, highest_px - imgui.get_item_rect_size().y))


def _mark(panel: str) -> None:
    """Draw a frame around a panel, below all dialogs, if it is there and not behind another one."""
    window = imgui.internal.find_window_by_name(panel)
    if window is not None and not window.hidden:
        last = ImVec2(window.pos.x + window.size.x, window.pos.y + window.size.y)
        colour = imgui.get_color_u32(accent())
        window.draw_list.push_clip_rect_full_screen()
        window.draw_list.add_rect(window.pos, last, colour, thickness=2.0)
        window.draw_list.pop_clip_rect()


def _with_keys(text: str) -> str:
    """Return a text with its keys as this system names them."""
    parts = text.replace("{", "}").split("}")
    return "".join(shown_chord(part) if number % 2 else part for number, part in enumerate(parts))
