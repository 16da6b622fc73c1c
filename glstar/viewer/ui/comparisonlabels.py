"""Labels of the two sides of a comparison, and the handle of the line between them."""

from typing import Final

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import NDArray

from glstar.viewer.comparisonview import LESS_RGB, MORE_RGB, ComparisonMode
from glstar.viewer.session import Session
from glstar.viewer.ui.theme import accent

__all__ = ["draw_comparison_labels"]

Float = NDArray[np.float64]

_MARGIN: Final = 8.0
_BACKGROUND: Final = (0.05, 0.06, 0.08, 0.75)
_TEXT: Final = ((0.92, 0.93, 0.95, 1.0), (0.9, 0.0, 0.0, 1.0))
# Size of the handle of a wipe, screen px.
_HANDLE: Final = 9.0


def draw_comparison_labels(
    session: Session, draw_list: imgui.ImDrawList, corner: Float, clip: tuple[float, float, float, float]
) -> None:
    """Write which image is which, and draw the line of a wipe with its handle.

    Parameters
    ----------
    session : Session
    draw_list : imgui.ImDrawList
    corner : (2,) float64
        The panel's top-left corner, screen px.
    clip : tuple of float
        Left, top, right, bottom of the panel, screen px.
    """
    shown = session.shown
    is_compared = shown is not None and shown.real is not None and shown.comparison is not ComparisonMode.OFF
    if shown is None or not (is_compared or session.comparison.blinks_noise):
        return
    width_px, height_px = shown.size_px
    edges = session.view.to_screen([[-0.5, -0.5], [width_px - 0.5, height_px - 0.5]]) + corner
    (left, top), (right, bottom) = np.clip(edges, [clip[0], clip[1]], [clip[2], clip[3]]).tolist()
    if not is_compared:
        _write(session, draw_list, "without noise" if session.image.is_noiseless else "with noise", left, top, right)
        return
    match shown.comparison:
        case ComparisonMode.SIDE_BY_SIDE | ComparisonMode.WIPE:
            fraction = shown.wipe if shown.comparison is ComparisonMode.WIPE else 0.5
            line = float(edges[0, 0] + fraction * (edges[1, 0] - edges[0, 0]))
            if line > left:
                _write(session, draw_list, "simulated", left, top, min(line, right))
            if line < right:
                _write(session, draw_list, "real", max(line, left), top, right)
            if shown.comparison is ComparisonMode.WIPE and left <= line <= right:
                _draw_line(session, draw_list, line, top, bottom)
        case ComparisonMode.BLINK:
            _write(session, draw_list, "real" if shown.phase % 1.0 >= 0.5 else "simulated", left, top, right)
        case ComparisonMode.DIFFERENCE:
            more_left = _write(session, draw_list, "real brighter", left, top, right, colour=MORE_RGB)
            _write(session, draw_list, "real fainter", more_left, top, right, colour=LESS_RGB)


def _write(
    session: Session,
    draw_list: imgui.ImDrawList,
    text: str,
    left: float,
    top: float,
    right: float,
    *,
    colour: tuple[float, float, float] | None = None,
) -> float:
    """Write a label at the top left of a part of the picture if it fits, and return where the next one begins."""
    size = imgui.calc_text_size(text)
    after = left + size.x + 3 * _MARGIN
    if after > right:
        return left
    at = ImVec2(left + 1.5 * _MARGIN, top + 1.5 * _MARGIN)
    corner = ImVec2(at.x + size.x + _MARGIN / 2, at.y + size.y + _MARGIN / 2)
    draw_list.add_rect_filled(
        ImVec2(at.x - _MARGIN / 2, at.y - _MARGIN / 2), corner, imgui.get_color_u32(_BACKGROUND), 3.0
    )
    shown = _TEXT[session.night] if colour is None or session.night else (*colour, 1.0)
    draw_list.add_text(at, imgui.get_color_u32(shown), text)
    return after


def _draw_line(session: Session, draw_list: imgui.ImDrawList, x: float, top: float, bottom: float) -> None:
    """Draw the handle of a wipe at the lower end of its line, so that it hides no star in the middle."""
    colour = imgui.get_color_u32(_TEXT[1] if session.night else accent())
    y = bottom - 2 * _HANDLE
    draw_list.add_line(ImVec2(x, bottom - 4 * _HANDLE), ImVec2(x, bottom), colour)
    for side in (-1.0, 1.0):
        tip, base = x + side * 1.6 * _HANDLE, x + side * 0.4 * _HANDLE
        draw_list.add_triangle_filled(
            ImVec2(tip, y), ImVec2(base, y - 0.7 * _HANDLE), ImVec2(base, y + 0.7 * _HANDLE), colour
        )
    draw_list.add_line(ImVec2(x, top), ImVec2(x, top + 2 * _HANDLE), colour)
