"""The borders and the digital numbers of magnified pixels."""

from typing import Final

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import NDArray

from glstar.viewer.session import Session

__all__ = ["draw_pixel_grid"]

# Magnifications from which borders and digital numbers are drawn, screen px per px.
_BORDERS_FROM: Final = 8.0
_NUMBERS_FROM: Final = 40.0
# Red, green, blue and opacity of the borders, and of numbers on dark and on bright pixels; in night mode red only.
_BORDER: Final = ((0.6, 0.65, 0.7, 0.25), (0.6, 0.0, 0.0, 0.3))
_ON_DARK: Final = ((0.85, 0.87, 0.9, 0.9), (0.8, 0.0, 0.0, 0.9))
_ON_BRIGHT: Final = ((0.05, 0.05, 0.05, 0.9), (0.0, 0.0, 0.0, 0.9))
# Brightness on the screen from which a pixel counts as bright.
_BRIGHT: Final = 0.55


def draw_pixel_grid(
    session: Session,
    draw_list: imgui.ImDrawList,
    corner: NDArray[np.float64],
    clip: tuple[float, float, float, float],
) -> None:
    """Draw the borders of the image's pixels, and their digital numbers while the flight does not play.

    Parameters
    ----------
    session : Session
    draw_list : imgui.ImDrawList
    corner : (2,) float64
        The panel's top-left corner, screen px.
    clip : tuple of float
        Left, top, right, bottom of the panel, screen px.
    """
    view, scene = session.view, session.scene
    if scene is None or view.zoom < _BORDERS_FROM:
        return
    size = np.array([scene.camera.width_px, scene.camera.height_px])
    panel = np.array([[0.0, 0.0], [clip[2] - clip[0], clip[3] - clip[1]]])
    first, last = np.floor(view.to_picture(panel) + 0.5)
    first, last = np.clip(first, 0, size).astype(int), np.clip(last + 1, 0, size).astype(int)
    if (last <= first).any():
        return
    (left, top), (right, bottom) = view.to_screen([first - 0.5, last - 0.5]) + corner
    colour = imgui.get_color_u32(_BORDER[session.night])
    for x in (np.floor(np.linspace(left, right, last[0] - first[0] + 1)) + 0.5).tolist():
        draw_list.add_line(ImVec2(x, top), ImVec2(x, bottom), colour)
    for y in (np.floor(np.linspace(top, bottom, last[1] - first[1] + 1)) + 0.5).tolist():
        draw_list.add_line(ImVec2(left, y), ImVec2(right, y), colour)
    playing = session.head is not None and session.head.playing
    if view.zoom >= _NUMBERS_FROM and not playing:
        _draw_numbers(session, draw_list, corner, first, last)


def _draw_numbers(
    session: Session,
    draw_list: imgui.ImDrawList,
    corner: NDArray[np.float64],
    first: NDArray[np.int_],
    last: NDArray[np.int_],
) -> None:
    """Write the digital numbers of the pixels from a first (column, row) to before a last one."""
    pixels, scene = session.image.pixels, session.scene
    if pixels is None or scene is None:
        return
    shown = pixels[first[1] : last[1], first[0] : last[0]]
    bright = session.stretch(shown.astype(np.float32) / np.float32(scene.white_dn)) > _BRIGHT
    colours = [imgui.get_color_u32(which[session.night]) for which in (_ON_DARK, _ON_BRIGHT)]
    (left, top), (right, bottom) = session.view.to_screen([first, last - 1]) + corner
    across, down = (
        np.linspace(left, right, shown.shape[1]).tolist(),
        np.linspace(top, bottom, shown.shape[0]).tolist(),
    )
    for (row, column), value in np.ndenumerate(shown):
        text = str(value)
        size, x, y = imgui.calc_text_size(text), across[column], down[row]
        draw_list.add_text(ImVec2(x - size.x / 2, y - size.y / 2), colours[bool(bright[row, column])], text)
