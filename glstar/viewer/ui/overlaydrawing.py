"""Draws the shapes of the overlays with imgui, in the colours of the table of overlays or in red by night."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from glstar.viewer.overlays import Overlay, Rgba
from glstar.viewer.shapes import Labels, Lines, Mark, Marks, Shapes

__all__ = ["draw_shapes", "overlay_colour"]

Float = NDArray[np.float64]

_OVERLAYS: Final[dict[str, Overlay]] = {overlay.value: overlay for overlay in Overlay}

# Distance of a label from its position, half sizes of crosses, targets and rings, smallest half size of the frame of a
# pixel, screen px.
_GAP: Final = 6.0
_CROSS: Final = 4.0
_TARGET: Final = 10.0
_RING: Final = 7.0
_MIN_PIXEL: Final = 1.5

# A soft dark edge around letters: four translucent copies of the text, offset by one pixel each.
_EDGE: Final = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
_EDGE_OPACITY: Final = 110

# Superscripts of Bayer letters that few fonts have, such as that of upsilon 4 Eridani.
_RARE: Final = "\u2074\u2075\u2076\u2077\u2078\u2079"
_PLAIN: Final = str.maketrans(_RARE, "456789")


def overlay_colour(overlay: Overlay, *, night: bool = False) -> Rgba:
    """Return the colour of an overlay.

    Parameters
    ----------
    overlay : Overlay
    night : bool
        Whether to use shades of red only.

    Returns
    -------
    red, green, blue, opacity : int
        0 to 255.
    """
    red, green, blue, opacity = overlay.spec.colour
    return (overlay.spec.night_red, 0, 0, opacity) if night else (red, green, blue, opacity)


def draw_shapes(
    draw_list: Any,
    shapes: Shapes,
    to_screen: Callable[[Float], Float],
    clip: tuple[float, float, float, float],
    *,
    night: bool = False,
) -> None:
    """Draw shapes into an imgui draw list.

    Parameters
    ----------
    draw_list : imgui.ImDrawList
        Of a window of the current frame.
    shapes : Shapes
    to_screen : callable
        Converts positions on the image (n, 2), px, to positions on the screen (n, 2), px.
    clip : tuple of float
        Left, top, right, bottom of the panel, screen px; nothing is drawn outside.
    night : bool
        Whether to use shades of red only.
    """
    draw_list.push_clip_rect(clip[:2], clip[2:], True)
    for lines in shapes.lines:
        _draw_lines(draw_list, lines, to_screen, overlay_colour(_OVERLAYS[lines.overlay], night=night))
    for marks in shapes.marks:
        _draw_marks(draw_list, marks, to_screen, overlay_colour(_OVERLAYS[marks.overlay], night=night))
    for labels in shapes.labels:
        _draw_labels(draw_list, labels, to_screen, clip, overlay_colour(_OVERLAYS[labels.overlay], night=night))
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
    draw_list: Any,
    labels: Labels,
    to_screen: Callable[[Float], Float],
    clip: tuple[float, float, float, float],
    colour: Rgba,
) -> None:
    ink, edge = _packed(colour, 255), _packed((0, 0, 0, _EDGE_OPACITY))
    left, top, right, bottom = clip
    positions = to_screen(labels.xy_px.astype(np.float64)).tolist()
    origin, clear = to_screen(np.array([[0.0, 0.0], [labels.clear_px, 0.0]]))
    gap = _GAP + float(np.linalg.norm(clear - origin))
    has_all = all(map(imgui.get_font().is_glyph_in_font, map(ord, _RARE)))
    for given, (x, y), (across, down) in zip(labels.text, positions, labels.anchor.tolist(), strict=True):
        text = given if has_all else given.translate(_PLAIN)
        width, height = imgui.calc_text_size(text)
        x0 = x - across * width + (1 - 2 * across) * gap
        y0 = y - down * height + (1 - 2 * down) * gap
        if x0 > right or y0 > bottom or x0 + width < left or y0 + height < top:
            continue
        for right_px, down_px in _EDGE:
            draw_list.add_text((x0 + right_px, y0 + down_px), edge, text)
        draw_list.add_text((x0, y0), ink, text)
