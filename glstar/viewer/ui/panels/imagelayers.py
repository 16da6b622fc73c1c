"""Drawings over the image with imgui, in the colours of the table of overlays or in red by night.

The shapes of the overlays; labels of the two sides of a comparison, with the handle of the line between them; and the
borders and digital numbers of magnified pixels.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.viewer.overlays.canvas import Labels, Lines, Mark, Marks, Shapes
from glstar.viewer.overlays.table import Overlay, Rgba
from glstar.viewer.picture.comparison import LESS_RGB, MORE_RGB, ComparisonMode
from glstar.viewer.session.state import Session
from glstar.viewer.ui.theme import accent

# Left, top, right, bottom, screen px.
Edges = tuple[float, float, float, float]

_OVERLAYS: dict[str, Overlay] = {overlay.value: overlay for overlay in Overlay}

# Distance of a label from its position, half sizes of crosses, targets and rings, smallest half size of the frame of a
# pixel, screen px.
_GAP = 6.0
_CROSS = 4.0
_TARGET = 10.0
_RING = 7.0
_MIN_PIXEL = 1.5

# A dark edge around letters: four translucent copies of the text, offset by one pixel each.
_EDGE = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
_EDGE_OPACITY = 190
# Least red of a label by night: on black a contrast of 2.9 to 1; lines may be darker.
_LEAST_RED = 180

# Superscripts of Bayer letters that few fonts have, such as that of upsilon 4 Eridani.
_RARE = "\u2074\u2075\u2076\u2077\u2078\u2079"
_PLAIN = str.maketrans(_RARE, "456789")


def overlay_colour(overlay: Overlay, *, night: bool = False) -> Rgba:
    """Return the colour of an overlay; `night`: whether to use shades of red only."""
    red, green, blue, opacity = overlay.spec.colour
    return (overlay.spec.night_red, 0, 0, opacity) if night else (red, green, blue, opacity)


def label_colour(overlay: Overlay, *, night: bool = False) -> Rgba:
    """Return the colour of the labels of an overlay: by night at least as bright as can be read."""
    red, green, blue, opacity = overlay_colour(overlay, night=night)
    return max(red, _LEAST_RED) if night else red, green, blue, opacity


def draw_shapes(
    draw_list: Any, shapes: Shapes, to_screen: Callable[[Float], Float], clip: Edges, *, night: bool = False
) -> None:
    """Draw shapes into an imgui draw list.

    `draw_list`: of a window of the current frame; `to_screen`: converts positions on the image (n, 2), px, to positions
    on the screen; `clip`: the panel; nothing is drawn outside; `night`: whether to use shades of red only.
    """
    draw_list.push_clip_rect(clip[:2], clip[2:], True)
    for lines in shapes.lines:
        _draw_lines(draw_list, lines, to_screen, overlay_colour(_OVERLAYS[lines.overlay], night=night))
    for marks in shapes.marks:
        _draw_marks(draw_list, marks, to_screen, overlay_colour(_OVERLAYS[marks.overlay], night=night))
    for labels in shapes.labels:
        _draw_labels(draw_list, labels, to_screen, clip, label_colour(_OVERLAYS[labels.overlay], night=night))
    draw_list.pop_clip_rect()


def _packed(colour: Rgba, opacity: int | None = None) -> int:
    red, green, blue, own = colour
    return (own if opacity is None else opacity) << 24 | blue << 16 | green << 8 | red


def _draw_lines(draw_list: Any, lines: Lines, to_screen: Callable[[Float], Float], colour: Rgba) -> None:
    points = to_screen(lines.xy_px.astype(np.float64)).tolist()
    ends = [*lines.starts[1:].tolist(), len(points)]
    thickness, packed = _OVERLAYS[lines.overlay].spec.thickness, _packed(colour)
    for first, last in zip(lines.starts.tolist(), ends, strict=True):
        # By keyword: imgui 1.93 has changed the order of the last two.
        draw_list.add_polyline(points=points[first:last], col=packed, thickness=thickness, flags=0)


def _draw_marks(draw_list: Any, marks: Marks, to_screen: Callable[[Float], Float], colour: Rgba) -> None:
    centres = marks.xy_px.astype(np.float64)
    packed = _packed(colour)
    if marks.mark is Mark.PIXEL:
        # Neighbouring pixels of a row share a frame: a tenth as many frames around a bright star.
        step = np.diff(centres, axis=0)
        breaks = np.flatnonzero((step[:, 0] != 1) | (step[:, 1] != 0))
        first, last = np.append(0, breaks + 1), np.append(breaks, len(centres) - 1)
        corners = np.stack([to_screen(centres[first] - 0.5), to_screen(centres[last] + 0.5)])
        middle, half = corners.mean(axis=0), np.maximum(np.abs(corners[1] - corners[0]) / 2, _MIN_PIXEL)
        for low, high in zip((middle - half).tolist(), (middle + half).tolist(), strict=True):
            draw_list.add_rect(low, high, packed)
        return
    for x, y in to_screen(centres).tolist():
        if marks.mark is Mark.RING:
            draw_list.add_circle((x, y), _RING, packed)
        elif marks.mark is Mark.TARGET:
            draw_list.add_circle((x, y), _TARGET / 2, packed)
            for inner, outer in ((-_TARGET, -_TARGET / 3), (_TARGET / 3, _TARGET)):
                draw_list.add_line((x + inner, y), (x + outer, y), packed)
                draw_list.add_line((x, y + inner), (x, y + outer), packed)
        else:
            draw_list.add_line((x - _CROSS, y - _CROSS), (x + _CROSS, y + _CROSS), packed)
            draw_list.add_line((x - _CROSS, y + _CROSS), (x + _CROSS, y - _CROSS), packed)


def _draw_labels(
    draw_list: Any, labels: Labels, to_screen: Callable[[Float], Float], clip: Edges, colour: Rgba
) -> None:
    ink = _packed(colour, 255)
    left, top, right, bottom = clip
    positions = to_screen(labels.xy_px.astype(np.float64)).tolist()
    origin, clear = to_screen(np.array([[0.0, 0.0], [labels.clear_px, 0.0]]))
    gap = _GAP + float(np.linalg.norm(clear - origin))
    has_all = all(map(imgui.get_font().is_glyph_in_font, map(ord, _RARE)))
    for name, (x, y), (across, down) in zip(labels.text, positions, labels.anchor.tolist(), strict=True):
        text = name if has_all else name.translate(_PLAIN)
        width, height = imgui.calc_text_size(text)
        x0 = x - across * width + (1 - 2 * across) * gap
        y0 = y - down * height + (1 - 2 * down) * gap
        if x0 > right or y0 > bottom or x0 + width < left or y0 + height < top:
            continue
        draw_edged_text(draw_list, x0, y0, ink, text)


def draw_edged_text(draw_list: Any, x: float, y: float, ink: int, text: str) -> None:
    """Write text with a dark edge, which can be read on a bright sky; `x`, `y`: its top left; `ink`: its colour."""
    edge = _packed((0, 0, 0, _EDGE_OPACITY))
    for right_px, down_px in _EDGE:
        draw_list.add_text((x + right_px, y + down_px), edge, text)
    draw_list.add_text((x, y), ink, text)


_MARGIN = 8.0
_BACKGROUND = (0.05, 0.06, 0.08, 0.75)
_TEXT = ((0.92, 0.93, 0.95, 1.0), (0.9, 0.0, 0.0, 1.0))
# Size of the handle of a wipe, screen px.
_HANDLE = 9.0


def draw_comparison_labels(session: Session, draw_list: imgui.ImDrawList, corner: Float, clip: Edges) -> None:
    """Write which image is which, and draw the line of a wipe with its handle; `corner` (2,), `clip`: of the panel."""
    shown = session.shown
    is_compared = shown is not None and shown.real is not None and shown.comparison is not ComparisonMode.OFF
    if shown is None or not (is_compared or session.comparison.blinks_noise):
        return
    edges = session.view.edges(*shown.size_px) + corner
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


# Magnifications from which borders and digital numbers are drawn, screen px per px.
_BORDERS_FROM = 8.0
_NUMBERS_FROM = 40.0
# Red, green, blue and opacity of the borders, and of numbers on dark and on bright pixels; in night mode red only.
_BORDER = ((0.6, 0.65, 0.7, 0.25), (0.6, 0.0, 0.0, 0.3))
_ON_DARK = ((0.85, 0.87, 0.9, 0.9), (0.8, 0.0, 0.0, 0.9))
_ON_BRIGHT = ((0.05, 0.05, 0.05, 0.9), (0.0, 0.0, 0.0, 0.9))
# Brightness on the screen from which a pixel counts as bright.
_BRIGHT = 0.55


def draw_pixel_grid(session: Session, draw_list: imgui.ImDrawList, corner: Float, clip: Edges) -> None:
    """Draw the borders of the image's pixels, and their digital numbers while the flight does not play.

    `corner` (2,) and `clip`: of the panel, screen px.
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
    if view.zoom >= _NUMBERS_FROM and not session.is_playing:
        _draw_numbers(session, draw_list, corner, first, last)


def _draw_numbers(
    session: Session, draw_list: imgui.ImDrawList, corner: Float, first: NDArray[np.int_], last: NDArray[np.int_]
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
        size = imgui.calc_text_size(text)
        at = ImVec2(across[column] - size.x / 2, down[row] - size.y / 2)
        draw_list.add_text(at, colours[bool(bright[row, column])], text)
