"""Text that the window has drawn: its letters as rectangles, and those that cover each other."""

import ctypes

import numpy as np
from imgui_bundle import imgui

_VERTEX = np.dtype([("xy", "<f4", 2), ("uv", "<f4", 2), ("rgba", "u1", 4)])
# Letters of one text touch; letters that share more than this, px, belong to two texts.
_SHARED_PX = (2.0, 4.0)
_EDGE_OPACITY = 195


def letters(drawn: imgui.ImDrawList) -> np.ndarray:
    """Return the visible letters of a window, (n, 4) left, top, right, bottom, px.

    A letter is an upright rectangle as large as its part of the font's texture, of one colour that is more opaque than
    the dark edges of labels.
    """
    texture = imgui.get_io().fonts.tex_data
    vertices = _array(drawn.vtx_buffer, _VERTEX)
    indices = _array(drawn.idx_buffer, np.dtype(f"u{imgui.INDEX_SIZE}"))
    found = [np.empty((0, 4))]
    for command in drawn.cmd_buffer:
        part = indices[command.idx_offset : command.idx_offset + command.elem_count].astype(int)
        if len(part) < 6:
            continue
        # Letters are pairs of triangles 0 1 2 and 0 2 3.
        part = np.lib.stride_tricks.sliding_window_view(part, 6)
        part = part[(part - part[:, :1] == [0, 1, 2, 0, 2, 3]).all(axis=1)]
        corner, opposite = (vertices[part[:, k] + command.vtx_offset] for k in (0, 2))
        size = opposite["xy"] - corner["xy"]
        texels = (opposite["uv"] - corner["uv"]) * [texture.width, texture.height]
        is_letter = (np.abs(size - texels) < 0.6).all(axis=1) & (size > 2.5).all(axis=1) & (size < 40).all(axis=1)
        is_letter &= (corner["rgba"][:, 3] > _EDGE_OPACITY) & corner["rgba"][:, :3].any(axis=1)
        clip = command.clip_rect
        left_top = np.maximum(corner["xy"], [clip.x, clip.y])
        right_bottom = np.minimum(opposite["xy"], [clip.z, clip.w])
        is_letter &= (right_bottom - left_top > 1).all(axis=1)
        found.append(np.hstack([left_top, right_bottom])[is_letter])
    return np.concatenate(found)


def overlaps(drawn: imgui.ImDrawList) -> list[tuple[float, float]]:
    """Return where letters of a window cover others, px."""
    boxes = letters(drawn)
    first, second = np.triu_indices(len(boxes), 1)
    shared = np.minimum(boxes[first, 2:], boxes[second, 2:]) - np.maximum(boxes[first, :2], boxes[second, :2])
    covered = (shared > _SHARED_PX).all(axis=1)
    return [tuple(np.round(at).tolist()) for at in boxes[first[covered], :2]]


def _array(buffer: object, dtype: np.dtype) -> np.ndarray:
    """Return a copy of a vector of imgui."""
    return np.frombuffer(ctypes.string_at(buffer.data_address(), buffer.size() * dtype.itemsize), dtype)
