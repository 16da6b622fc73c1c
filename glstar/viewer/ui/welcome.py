"""What the window shows before there is a flight: recent flights, flights to try, and how to open one's own."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from imgui_bundle import ImVec2, imgui

from glstar.system.resources import bundled_flight
from glstar.viewer.keys import Action, AnyAction
from glstar.viewer.session import Session
from glstar.viewer.ui.theme import accent, scaled

__all__ = ["draw_welcome"]

_WIDTH: Final = 420.0
# Of the panels on the right of the image, in the initial layout: it needs to stay free, also in a small window.
_RIGHT_FRACTION: Final = 0.26
_RIGHT_PX: Final = 300.0
_FLAGS: Final = int(
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.always_auto_resize
)
# Flights that everybody has.
_ORBIT: Final = Path("fly:orbit?radius_m=300&gusts=light")


def draw_welcome(session: Session, recent: list[str], perform: Callable[[AnyAction], None]) -> None:
    """Draw the panel if there is neither a flight nor a link, and none is being opened.

    Parameters
    ----------
    session : Session
    recent : list of str
        The flights opened last, the latest first.
    perform : callable
        Performs an action of the table of keys.
    """
    if session.loaded is not None or session.live is not None or session.loader.is_busy or session.status:
        return
    viewport = imgui.get_main_viewport()
    free_px = viewport.size.x - max(_RIGHT_FRACTION * viewport.size.x, scaled(_RIGHT_PX))
    image = ImVec2(viewport.pos.x + free_px / 2, viewport.pos.y + viewport.size.y * 0.36)
    imgui.set_next_window_pos(image, int(imgui.Cond_.always), ImVec2(0.5, 0.5))
    imgui.begin("##welcome", None, _FLAGS)
    width = min(scaled(_WIDTH), free_px - 4 * imgui.get_style().window_padding.x)
    imgui.text_colored(accent(), "glstar")
    imgui.text("What a camera fixed to an aircraft records of the night sky.")
    imgui.separator_text("Open")
    _button("Open a flight log  (Ctrl+O)", width, lambda: perform(Action.OPEN))
    _button("Connect to a telemetry link  (Ctrl+L)", width, lambda: perform(Action.CONNECT))
    imgui.text_disabled("or drop a log onto the window")
    imgui.separator_text("Try")
    _button("The bundled flight over Adelaide", width, lambda: session.open_flight(bundled_flight()))
    _button("An orbit of 300 m radius in light gusts", width, lambda: session.open_flight(_ORBIT))
    if recent:
        imgui.separator_text("Recent flights")
        for index, entry in enumerate(recent):
            if imgui.selectable(f"{Path(entry).name}##{index}", False)[0]:
                session.open_flight(Path(entry))
            imgui.set_item_tooltip(entry.replace("%", "%%"))
    imgui.end()


def _button(label: str, width: float, act: Callable[[], None]) -> None:
    if imgui.button(label, ImVec2(width, 0)):
        act()
